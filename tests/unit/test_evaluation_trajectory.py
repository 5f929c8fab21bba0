"""The criteria: matching in time, alignment, segments, success, and equality with evo."""

import json
import subprocess
import sys
import zipfile
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from pliant.algorithms.geometry import so3_exp
from pliant.errors import ResultError
from pliant.evaluation.criteria import (
    ErrorStatistics,
    Similarity,
    absolute_errors,
    align,
    frame_pairs,
    relative_errors,
    second_pairs,
)
from pliant.evaluation.plots import plot_errors
from pliant.evaluation.presentation import (
    evaluation_to_json,
    format_evaluation,
    format_summary,
    metres,
    summarise,
    summary_to_json,
    write_json,
)
from pliant.evaluation.run_evaluation import evaluate_result, evaluate_trajectory
from pliant.formats.tum import read_tum, write_tum
from pliant.trajectory import Trajectory, associate

FRAME_NS = 33_333_333


def walk(count: int = 100, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = so3_exp(np.cumsum(rng.normal(size=(count, 3)) * 0.02, axis=0))
    T[:, :3, 3] = np.cumsum(rng.normal(size=(count, 3)) * 0.1, axis=0)
    return Trajectory(stamps_ns=np.arange(count, dtype=np.int64) * FRAME_NS, T_world_camera=T)


def moved(trajectory: Trajectory, *, noise: float = 0.0, scale: float = 0.3) -> Trajectory:
    """The same motion in another world and scale, with noise on the positions."""
    rng = np.random.default_rng(9)
    similarity = Similarity(
        scale=scale, R=so3_exp(np.array([0.3, -2.0, 0.7])), t=np.array([1.0, 2.0, 3.0])
    )
    T = trajectory.T_world_camera.copy()
    T[:, :3, 3] += rng.normal(size=(len(T), 3)) * noise
    return Trajectory(stamps_ns=trajectory.stamps_ns, T_world_camera=similarity.apply_poses(T))


def test_a_similar_trajectory_has_no_error() -> None:
    truth = walk()
    part = evaluate_trajectory(moved(truth), truth, frames=100)
    assert part.success
    assert part.ate_m is not None
    assert part.ate_m.rmse < 1e-12
    assert part.alignment is not None
    assert part.alignment.scale == pytest.approx(1 / 0.3)
    assert part.rpe_frame is not None
    assert part.rpe_second is not None
    assert part.rpe_frame.rotation_deg.max < 1e-5
    assert part.rpe_frame.translation_m.count == 99
    assert part.rpe_second.translation_m.count == 70
    assert part.rpe_second.translation_m.max < 1e-12


def test_known_errors() -> None:
    truth = walk()
    errors = absolute_errors(truth.T_world_camera, truth.T_world_camera)
    assert not errors.any()
    statistics = ErrorStatistics.of(np.array([3.0, 4.0, 0.0]))
    assert statistics.rmse == pytest.approx(np.sqrt(25 / 3))
    assert (statistics.median, statistics.max, statistics.count) == (3.0, 4.0, 3)
    # One pose shifted by 0.5 m along its own x and turned by 10 degrees: two pairs see it.
    estimate = truth.T_world_camera.copy()
    change = np.eye(4)
    change[0, 3], change[:3, :3] = 0.5, so3_exp(np.array([0, 0, np.radians(10.0)]))
    estimate[50] = estimate[50] @ change
    relative = relative_errors(
        estimate, truth.T_world_camera, frame_pairs(truth.stamps_ns), step="frame"
    )
    assert relative is not None
    assert relative.rotation_deg.max == pytest.approx(10.0)
    assert relative.rotation_deg.rmse == pytest.approx(np.sqrt(2 * 100 / 99))
    assert relative.translation_m.max >= 0.5 - 1e-9


def test_ate_and_rpe_equal_evo(tmp_path: Path) -> None:
    truth, estimate = tmp_path / "truth.txt", tmp_path / "estimate.txt"
    write_tum(truth, walk())
    write_tum(estimate, moved(walk(), noise=0.05))
    ours = evaluate_trajectory(read_tum(estimate), read_tum(truth), frames=100)
    assert ours.ate_m is not None
    assert ours.rpe_frame is not None
    step = ("--delta", "1", "--delta_unit", "f", "--pose_relation")
    for (program, *options), value in (
        (("evo_ape", "--pose_relation", "trans_part"), ours.ate_m.rmse),
        (("evo_rpe", *step, "trans_part"), ours.rpe_frame.translation_m.rmse),
        (("evo_rpe", *step, "angle_deg"), ours.rpe_frame.rotation_deg.rmse),
    ):
        saved = tmp_path / f"{len(list(tmp_path.iterdir()))}.zip"
        subprocess.run(
            [
                *(Path(sys.executable).parent / program, "tum", truth, estimate, *options),
                *("--align", "--correct_scale", "--no_warnings", "--save_results", saved),
            ],
            check=True,
            env={"HOME": str(tmp_path), "PATH": "/usr/bin:/bin"},  # its settings are written there
        )
        with zipfile.ZipFile(saved) as results:
            theirs = json.loads(results.read("stats.json"))
        assert value == pytest.approx(theirs["rmse"], abs=1e-9)


stamp_lists = st.lists(st.integers(0, 200), unique=True, max_size=30).map(sorted)


@given(stamp_lists, stamp_lists, st.integers(0, 20))
def test_association_is_one_to_one_and_close(a: list[int], b: list[int], limit: int) -> None:
    stamps_a, stamps_b = np.array(a, np.int64), np.array(b, np.int64)
    rows_a, rows_b = associate(stamps_a, stamps_b, max_difference_ns=limit)
    assert np.all(np.diff(rows_a) > 0)
    assert np.all(np.diff(rows_b) > 0)
    assert np.all(np.abs(stamps_a[rows_a] - stamps_b[rows_b]) <= limit)
    # Equal stamps always find each other.
    assert set(a) & set(b) <= set(stamps_a[rows_a].tolist())


def test_association_limit_is_inclusive() -> None:
    a, b = np.array([0, 100_000_000]), np.array([4_000_000, 104_000_001])
    assert associate(a, b)[0].tolist() == [0]


def test_pairs_do_not_span_lost_frames() -> None:
    stamps = np.array([0, 1, 2, 5, 6], np.int64) * FRAME_NS
    first, second = frame_pairs(stamps)
    assert first.tolist() == [0, 1, 3]
    assert second.tolist() == [1, 2, 4]
    seconds = np.arange(5, dtype=np.int64) * 500_000_000
    assert [x.tolist() for x in second_pairs(seconds)] == [[0, 1, 2], [2, 3, 4]]
    assert not len(second_pairs(seconds[:1])[0])


def test_below_ninety_percent_is_a_failure_without_accuracy() -> None:
    truth = walk()
    estimate = moved(truth).select(np.arange(89))
    part = evaluate_trajectory(estimate, truth, frames=100)
    assert part.success is False
    assert part.ate_m is None
    assert part.rpe_frame is None
    assert len(part.errors_m) == 89
    assert "89.0 % is below 90 %" in part.reason
    assert evaluate_trajectory(estimate, truth, frames=98).ate_m is not None
    unknown = evaluate_trajectory(estimate, truth)
    assert unknown.success is None
    assert unknown.ate_m is not None


@pytest.mark.parametrize(
    ("rows", "reason"), [([], "no frame was localised"), ([0, 1], "only 2 of 2 poses")]
)
def test_too_few_poses_are_reported(rows: list[int], reason: str) -> None:
    truth = walk()
    part = evaluate_trajectory(truth.select(np.array(rows, np.int64)), truth)
    assert part.ate_m is None
    assert part.reason.startswith(reason)


@pytest.mark.parametrize(("compared", "apart", "partly"), [(2, True, False), (89, False, True)])
def test_poses_that_the_truth_does_not_meet(compared: int, apart: bool, partly: bool) -> None:
    truth = walk()
    part = evaluate_trajectory(truth, truth.select(np.arange(compared)), frames=100)
    assert (part.apart, part.partly_compared) == (apart, partly)


def test_poses_that_are_not_those_of_the_truth() -> None:
    truth = walk()
    assert not evaluate_trajectory(truth, truth).unlike
    other = Trajectory(stamps_ns=truth.stamps_ns, T_world_camera=truth.T_world_camera.copy())
    generator = np.random.default_rng(0)
    other.T_world_camera[:, :3, 3] = generator.normal(size=(len(truth), 3))
    assert evaluate_trajectory(other, truth).unlike


def test_a_failure_or_a_short_map_is_not_apart_from_the_truth() -> None:
    truth = walk()
    later = truth.select(np.arange(60, 100))
    failure = evaluate_trajectory(truth.select(np.arange(50)), later, frames=100)
    assert (failure.apart, failure.partly_compared) == (False, True)
    for count in (0, 2):
        short = evaluate_trajectory(truth.select(np.arange(count)), later)
        assert (short.apart, short.partly_compared) == (False, False)
    whole = evaluate_trajectory(truth, truth.select(np.arange(90)), frames=100)
    assert (whole.apart, whole.partly_compared) == (False, False)


def test_a_static_camera_has_no_accuracy() -> None:
    truth = walk()
    still = Trajectory(
        stamps_ns=truth.stamps_ns, T_world_camera=np.tile(np.eye(4), (len(truth), 1, 1))
    )
    assert "extent" in evaluate_trajectory(still, truth).reason
    assert "moving camera" in evaluate_trajectory(truth, still).reason
    with pytest.raises(ValueError, match="at least 3"):
        align(still.T_world_camera[:2], truth.T_world_camera[:2])


def result_folder(path: Path, estimate: Trajectory, report: object) -> Path:
    path.mkdir()
    write_tum(path / "trajectory.txt", estimate)
    write_tum(path / "trajectory_online.txt", estimate.select(np.arange(5, len(estimate))))
    (path / "report.json").write_text(json.dumps(report))
    return path


def segments(*counts: int) -> list[dict[str, int]]:
    firsts = np.cumsum([0, *counts])
    return [
        {"id": i, "first_frame": int(firsts[i]), "frames": count} for i, count in enumerate(counts)
    ]


def test_only_the_longest_segment_counts(tmp_path: Path) -> None:
    truth = walk()
    longest = moved(truth, scale=2.0).select(np.arange(6, 100))
    report = {"frames": 100, "initialisation_retries": 1, "segments": segments(6, 94)}
    evaluation = evaluate_result(result_folder(tmp_path / "r", longest, report), groundtruth=truth)
    final, online = evaluation.final, evaluation.online
    assert (final.localised, final.other_segments, final.segments) == (94, 6, 2)
    assert final.ate_m is not None
    assert final.ate_m.rmse < 1e-6
    assert online is not None
    assert (online.localised, online.other_segments) == (89, 6)
    assert final.times_s[0] == 0.0
    assert evaluation.initialisation_retries == 1
    text = format_evaluation(evaluation)
    assert "Sim(3)" in text
    assert "2 (6 poses left out)" in text


@pytest.mark.parametrize(
    ("report", "message"),
    [
        ([], "expected a JSON object"),
        ({"frames": "many"}, "frames must be a count"),
        ({"frames": True}, "frames must be a count"),
        ({"frames": 50}, "100 poses for a sequence of 50 frames"),
        ({"segments": {}}, "segments must be a list"),
        ({"segments": [3]}, "expected an object"),
        ({"segments": [{"id": 0, "frames": 100}]}, "first_frame is missing"),
        ({"segments": segments(6, 93)}, "belong to different runs"),
        ({"segments": segments(6, 94)[::-1]}, "in the order"),
    ],
)
def test_a_report_is_not_trusted(tmp_path: Path, report: object, message: str) -> None:
    truth = walk()
    folder = result_folder(tmp_path / "r", truth, report)
    with pytest.raises(ResultError, match=message) as caught:
        evaluate_result(folder, groundtruth=truth)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "{", "[" * 100_000, "\x00"])
def test_a_report_that_is_not_json(tmp_path: Path, text: str) -> None:
    truth = walk()
    folder = result_folder(tmp_path / "r", truth, {})
    (folder / "report.json").write_text(text)
    with pytest.raises(ResultError, match=r"report.json: is not JSON"):
        evaluate_result(folder, groundtruth=truth)


def test_a_run_without_a_map_and_a_missing_trajectory(tmp_path: Path) -> None:
    truth = walk()
    report = {"frames": 100, "initialisation_retries": 0, "segments": []}
    folder = tmp_path / "r"
    folder.mkdir()
    with pytest.raises(ResultError, match="no such file"):
        evaluate_result(folder, groundtruth=truth)
    write_tum(folder / "trajectory.txt", Trajectory.empty())
    (folder / "report.json").write_text(json.dumps(report))
    evaluation = evaluate_result(folder, groundtruth=truth)
    assert evaluation.final.success_rate == 0.0
    assert evaluation.final.reason == "no frame was localised"
    assert "no frame was localised" in format_evaluation(evaluation)
    with pytest.raises(ResultError, match="no error over time"):
        plot_errors(tmp_path / "p.png", evaluation)


def test_summary_json_and_plot(tmp_path: Path) -> None:
    truth = walk()
    runs = []
    for seed, noise in enumerate((0.01, 0.02, 0.03)):
        estimate = moved(truth, noise=noise).select(np.arange(100 if seed else 80))
        report = {"frames": 100, "initialisation_retries": seed}
        folder = result_folder(tmp_path / str(seed), estimate, report)
        runs.append(evaluate_result(folder, groundtruth=truth))
    summary = summarise(runs)
    values = [run.final.ate_m.rmse for run in runs[1:] if run.final.ate_m]
    assert (summary.runs, summary.failures) == (3, 1)
    assert summary.ate_m is not None
    assert summary.ate_m.runs == 2
    assert summary.ate_m.mean == pytest.approx(np.mean(values))
    assert summary.ate_m.deviation == pytest.approx(np.std(values, ddof=1))
    assert summary.initialisation_retries is not None
    assert summary.initialisation_retries.mean == 1.0
    assert "failures" in format_summary(summary)
    assert json.loads(json.dumps(summary_to_json(summary)))["failures"] == 1
    write_json(tmp_path / "e.json", evaluation_to_json(runs[1]))
    data = json.loads((tmp_path / "e.json").read_text())
    assert data["final"]["ate_m"]["rmse"] == values[0]
    assert len(data["online"]["errors_m"]) == 95
    with pytest.raises(ResultError, match="no runs"):
        summarise([])
    pytest.importorskip("matplotlib")
    plot_errors(tmp_path / "a.png", runs[1])
    plot_errors(tmp_path / "b.png", runs[1])
    assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()


def test_plot_without_matplotlib_names_the_package(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    truth = walk()
    write_tum(tmp_path / "t", truth)
    evaluation = evaluate_result(tmp_path / "t", groundtruth=truth)
    monkeypatch.setitem(__import__("sys").modules, "matplotlib.figure", None)
    with pytest.raises(ResultError, match=r"pip install pliant\[plot\]"):
        plot_errors(tmp_path / "p.png", evaluation)


def test_lengths_are_shown_in_fitting_units() -> None:
    assert [metres(x) for x in (None, 1e-5, 0.0033, 0.0326, 1.5)] == [
        "-",
        "10 um",
        "3.3 mm",
        "3.26 cm",
        "1.5 m",
    ]


def test_trajectories_refuse_nonsense() -> None:
    good = walk(3)
    with pytest.raises(ValueError, match="increase"):
        Trajectory(stamps_ns=good.stamps_ns[::-1].copy(), T_world_camera=good.T_world_camera)
    with pytest.raises(ValueError, match="finite"):
        Trajectory(stamps_ns=good.stamps_ns, T_world_camera=good.T_world_camera * np.nan)
