"""Where the clocks of poses and truth differ: a proposal, and --offset."""

import json
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

from pliant.algorithms.geometry import so3_exp
from pliant.errors import ResultError
from pliant.evaluation.criteria import Similarity
from pliant.evaluation.run_evaluation import evaluate_result
from pliant.evaluation.time_offset import better_offset, offset_ns, shifted
from pliant.formats.tum import write_tum
from pliant.trajectory import Trajectory
from pliant_services.cli.commands import app

FRAME_NS = 33_333_333


def path_at(times_s: np.ndarray, seed: int = 0) -> np.ndarray:
    """(N, 4, 4) poses of a hand-held camera."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (len(times_s), 1, 1))
    for axis in range(3):
        for _ in range(6):
            rate, phase, size = rng.uniform(0.5, 6.0), rng.uniform(0, 6.3), rng.uniform(0.05, 0.3)
            T[:, axis, 3] += size * np.sin(rate * times_s + phase)
    return T


def filmed(count: int, aside_s: float, noise: float = 0.001, start_s: float = 2.0) -> Trajectory:
    """What was found of a camera whose clock is behind by so much, in a world of its own."""
    times = start_s + np.arange(count) * 1e-9 * FRAME_NS
    T = path_at(times)
    T[:, :3, 3] += np.random.default_rng(1).normal(size=(count, 3)) * noise
    other = Similarity(scale=0.4, R=so3_exp(np.array([0.2, 1.0, -0.4])), t=np.ones(3))
    stamps = np.rint(1e9 * (times - aside_s)).astype(np.int64)
    return Trajectory(stamps_ns=stamps, T_world_camera=other.apply_poses(T))


def truth_at(rate_hz: float, length_s: float = 12.0) -> Trajectory:
    times = np.arange(0.0, length_s, 1.0 / rate_hz)
    return Trajectory(
        stamps_ns=np.rint(1e9 * times).astype(np.int64), T_world_camera=path_at(times)
    )


@pytest.mark.parametrize("aside_s", [0.1, -0.1, 0.033, 0.25, -0.42])
@pytest.mark.parametrize("rate_hz", [30.0, 200.0])
def test_an_offset_is_found(aside_s: float, rate_hz: float) -> None:
    found = better_offset(filmed(240, aside_s), truth_at(rate_hz))
    assert found is not None
    assert found.seconds == pytest.approx(aside_s, abs=0.003)
    assert found.frames == pytest.approx(aside_s / 0.0333333, abs=0.1)
    assert found.rmse_m < 0.01 < 0.02 < found.before_m


@pytest.mark.parametrize("aside_s", [0.0, 0.004, -0.01])
def test_where_the_clocks_agree_nothing_is_proposed(aside_s: float) -> None:
    assert better_offset(filmed(240, aside_s), truth_at(200.0)) is None


def test_what_is_wrong_for_other_reasons_is_not_explained_by_an_offset() -> None:
    wrong = filmed(240, 0.0)
    other = Trajectory(
        stamps_ns=wrong.stamps_ns, T_world_camera=path_at(1e-9 * wrong.stamps_ns, seed=5)
    )
    assert better_offset(other, truth_at(200.0)) is None
    assert better_offset(filmed(240, 0.0, noise=0.1), truth_at(200.0)) is None
    assert better_offset(filmed(5, 0.1), truth_at(200.0)) is None
    still = np.tile(np.eye(4), (240, 1, 1))
    standing = Trajectory(stamps_ns=wrong.stamps_ns, T_world_camera=still)
    assert better_offset(standing, truth_at(200.0)) is None
    assert better_offset(wrong, truth_at(30.0, 0.4)) is None


def test_other_clocks_altogether() -> None:
    truth = shifted(truth_at(200.0), 1_403_636_579_000_000_000)
    found = better_offset(filmed(240, 2.0, start_s=0.0), truth)
    assert found is not None
    assert found.seconds == pytest.approx(1_403_636_581.0, abs=1e-3)
    assert found.before_m == float("inf")


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("0.1", 100_000_000), ("-0.1s", -100_000_000), ("3f", 3 * FRAME_NS),
        ("+2 frames", 2 * FRAME_NS), ("-.5 frame", -round(0.5 * FRAME_NS)), ("1e-3", 10**6),
        ("0", 0),
    ],
)  # fmt: skip
def test_offsets_are_in_seconds_or_frames(text: str, expected: int) -> None:
    assert offset_ns(text, filmed(10, 0.0)) == pytest.approx(expected, abs=2)


@pytest.mark.parametrize("text", ["x", "3x", "", "1e99", "nan", "9" * 5000])
def test_an_offset_that_is_none_is_one_short_line(text: str) -> None:
    with pytest.raises(ResultError) as caught:
        offset_ns(text, filmed(10, 0.0))
    assert len(str(caught.value)) < 200


def test_eval_proposes_an_offset_and_takes_it(tmp_path: Path) -> None:
    write_tum(tmp_path / "poses.txt", filmed(240, 0.1))
    write_tum(tmp_path / "truth.txt", truth_at(200.0))
    command = ["eval", str(tmp_path / "poses.txt"), "-g", str(tmp_path / "truth.txt")]
    plain = CliRunner().invoke(app, command)
    assert plain.exit_code == 0, plain.output
    (line,) = [each for each in plain.output.splitlines() if "fits far better" in each]
    assert line.startswith("ground truth fits far better 0.100 s (3.0 frames) later: ATE ")
    assert line.endswith("if the clocks differ, use --offset 0.100")
    for offset in ("0.100", "3f"):
        file = tmp_path / f"{offset}.json"
        taken = CliRunner().invoke(app, [*command, "--offset", offset, "--json", str(file)])
        assert taken.exit_code == 0, taken.output
        assert "fits far better" not in taken.output
        figures = json.loads(file.read_text())
        assert figures["offset_s"] == pytest.approx(0.1)
        assert figures["better_offset"] is None
        assert figures["final"]["ate_m"]["rmse"] < 0.005
    negative = CliRunner().invoke(app, [*command, "--offset", "-0.1"])
    assert "--offset 0.100" in negative.output
    refused = CliRunner().invoke(app, [*command, "--offset", "soon"])
    assert isinstance(refused.exception, ResultError)


def test_without_common_times_the_error_proposes_an_offset(tmp_path: Path) -> None:
    write_tum(tmp_path / "poses.txt", filmed(240, 2.0, start_s=2.0))
    truth = truth_at(200.0)
    late = Trajectory(
        stamps_ns=truth.stamps_ns[400:] + 10**18, T_world_camera=truth.T_world_camera[400:]
    )
    write_tum(tmp_path / "truth.txt", late)
    command = ["eval", str(tmp_path / "poses.txt"), "-g", str(tmp_path / "truth.txt")]
    done = CliRunner().invoke(app, command)
    assert isinstance(done.exception, ResultError)
    assert "(both start together: try --offset 1000000002.000)" in str(done.exception)
    taken = evaluate_result(
        tmp_path / "poses.txt", groundtruth=tmp_path / "truth.txt", offset="1000000002"
    )
    assert taken.final.ate_m is not None
    assert taken.final.ate_m.rmse < 0.005
