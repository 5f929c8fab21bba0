"""Who may write a result folder: nobody what he reads."""

import json
import os
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from result_room import evaluation, refused

from pliant.datasets.source_spec import SourceSpec
from pliant.errors import ResultError
from pliant.export.export import export_result
from pliant.results.folder import (
    commit_of,
    keep_apart,
)
from pliant_services.calibrate.command import check_file
from pliant_services.cli.commands import app
from pliant_services.mesh.command import run_mesh
from pliant_services.replay.command import ReplayRequest, run_replay
from pliant_services.run.command import RunRequest, run_pipeline

READ = "is read from there"


def test_a_run_does_not_destroy_what_it_reads(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "results").symlink_to(tmp_path)
    (tmp_path / "link").symlink_to(room)
    (tmp_path / "source.mcap").symlink_to(room / "recording.mcap")
    in_room = tmp_path / "other" / "video.mp4"
    in_room.parent.mkdir()
    in_room.symlink_to(room / "recording.mcap")
    for source, output in (
        ("results/room", None),  # as the default output is named
        ("room", "room"),
        ("room/recording.mcap", "link"),
        ("link", "room/../room"),
        ("source.mcap", "room"),
        ("other/video.mp4", "room"),
        ("other/video.mp4", "other"),
        ("room", "."),
    ):
        request = RunRequest(
            source=SourceSpec(location=source), output=Path(output) if output else None, force=True
        )
        refused(lambda request=request: run_pipeline(request), room)
    monkeypatch.chdir(room)
    refused(
        lambda: run_pipeline(
            RunRequest(source=SourceSpec(location="."), output=Path("."), force=True)
        ),
        room,
    )


def test_a_run_does_not_destroy_the_calibration_that_it_is_given(room: Path) -> None:
    """What a run has found is for the next one: not into the same folder."""
    found = room / "calibration.yaml"
    found.write_text("found by an earlier run")
    run = RunRequest(
        source=SourceSpec(location="built-in:tiny", calibration=found), output=room, force=True
    )
    refused(lambda: run_pipeline(run), room, f"{READ}: choose another --output")


def test_parts_are_read_wherever_they_are(room: Path, tmp_path: Path) -> None:
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "part_00000.mcap").symlink_to(room / "recording.mcap")
    request = RunRequest(source=SourceSpec(location=str(folder)), output=room, force=True)
    refused(lambda: run_pipeline(request), room)


@pytest.mark.parametrize("save", ["recording.mcap", "report.json", "../room/config.yaml"])
def test_a_view_is_not_saved_over_the_run_that_it_shows(room: Path, save: str) -> None:
    request = RunRequest(
        source=SourceSpec(location="built-in:tiny"), output=room, save=room / save, force=True
    )
    refused(lambda: run_pipeline(request), room, f"{READ}: choose another --save")


def test_no_command_destroys_what_it_reads(room: Path, tmp_path: Path) -> None:
    recording, link = room / "recording.mcap", tmp_path / "link"
    link.symlink_to(room)
    os.link(recording, tmp_path / "same.mcap")
    for output in (room, link, tmp_path):
        request = ReplayRequest(recording=recording, services=(), output=output, force=True)
        refused(lambda request=request: run_replay(request), room)
        mesh = run_mesh(recording, output=output, force=True, overrides=())
        refused(lambda mesh=mesh: list(mesh), room)
    for output in (recording, link / "recording.mcap", tmp_path / "same.mcap", room, tmp_path):
        for kind in ("tum", "images"):
            refused(
                lambda kind=kind, output=output: export_result(room, kind, output, force=True), room
            )
    for file in ("recording.mcap", "report.json", "trajectory.txt"):
        for option in ("json", "plot"):
            written = {"results": [link], "force": True, option: room / file}
            refused(evaluation(room / "trajectory.txt", **written), room)


@pytest.fixture
def truth(tmp_path: Path) -> Path:
    """A sequence with true poses, and a trajectory to evaluate."""
    folder = tmp_path / "sequence"
    folder.mkdir()
    poses = "".join(f"{i} {i} {i * i} 0 0 0 0 1\n" for i in range(5))
    for name in ("groundtruth.txt", "result.txt", "times.txt", "0000.png"):
        (folder / name).write_text(poses)
    return folder


@pytest.mark.parametrize("file", ["groundtruth.txt", "times.txt", "0000.png", "result.txt"])
@pytest.mark.parametrize("option", ["json", "plot"])
def test_an_evaluation_replaces_no_truth(truth: Path, file: str, option: str) -> None:
    for groundtruth in (truth, truth / "groundtruth.txt"):
        if groundtruth == truth or file != "0000.png":  # nothing of that is read with a file
            command = evaluation(
                truth, groundtruth=str(groundtruth), force=True, **{option: truth / file}
            )
            refused(command, truth, f"choose another --{option}")
    times = truth.with_name("times")
    times.touch()
    refused(
        evaluation(truth, times=times, force=True, **{option: times}), truth, "choose another --"
    )


def test_an_evaluation_replaces_what_is_there_with_force_alone(truth: Path) -> None:
    figures = truth.with_name("figures.json")
    figures.write_text("precious")
    refused(evaluation(truth, json=figures), truth, "exists: choose another --json, or --force")
    assert figures.read_text() == "precious"
    evaluation(truth, json=figures, force=True)()
    evaluation(truth, json=truth / "figures.json")()
    assert figures.read_text() == (truth / "figures.json").read_text()
    both = evaluation(truth, json=figures, plot=figures, force=True)
    refused(both, truth, "choose another --plot")


def test_an_evaluation_against_the_truth_of_another_recording(truth: Path) -> None:
    """Where no stamps meet it is an error, and nothing is written; where some do it is said."""
    groundtruth = truth / "groundtruth.txt"
    poses = groundtruth.read_text()
    groundtruth.write_text("".join(f"{100 + i} {i} {i * i} 0 0 0 0 1\n" for i in range(5)))
    says = r"^.*/result.txt: no accuracy, only 0 of 5 poses .* within 0.004 s in .*--groundtruth"
    refused(evaluation(truth, json=truth / "figures.json"), truth, says)
    groundtruth.write_text("".join(poses.splitlines(keepends=True)[:3]))
    [said] = evaluation(truth)()
    warning = "warning: only 3 of 5 poses have a ground-truth pose: check that "
    assert said.splitlines()[-1] == f"{warning}{truth} belongs to this recording"
    groundtruth.write_text(poses)
    [said] = evaluation(truth)()
    assert "warning" not in said


@pytest.mark.parametrize(
    ("output", "says"),
    [
        ("cal/000005.yaml", "is in the source folder"),
        ("cal/calib.yaml", "is in the source folder"),
        ("clip.yaml", READ),  # its picture would be what is filmed
        ("mask.yaml", READ),
        ("found.png", "a calibration needs a .yaml file"),
    ],
)
def test_a_calibration_and_its_picture_replace_nothing(
    output: str, says: str, tmp_path: Path
) -> None:
    (tmp_path / "cal").mkdir()
    for name in ("cal/000005.png", "clip.png", "mask.png", "there.png"):
        (tmp_path / name).write_text("precious")
    source = str(tmp_path / ("clip.png" if output == "clip.yaml" else "cal"))
    mask = tmp_path / "mask.png"

    def check(output: str, *, force: bool) -> None:
        check_file(tmp_path / output, source=source, mask=mask, force=force)

    for force in (True, False):
        with pytest.raises(ResultError, match=says):
            check(output, force=force)
    with pytest.raises(ResultError, match=r"there\.png exists: .*--force"):
        check("there.yaml", force=False)
    check("there.yaml", force=True)
    check("results/calib.yaml", force=False)


@pytest.mark.parametrize(
    "command",
    [
        ("recover", "room", "--output", "room/recording.mcap"),
        ("recover", "room/recording.mcap", "--output", "same.mcap"),
        ("view", "room", "--save", "link/recording.mcap"),
        ("view", "room/recording.mcap", "--save", "room/../room/recording.mcap"),
    ],
)
def test_a_file_is_not_written_over_what_it_is_made_of(
    room: Path, command: tuple[str, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(room.parent)
    Path("link").symlink_to(room)
    os.link(room / "recording.mcap", "same.mcap")
    refused(lambda: app([*command, "--force"], standalone_mode=False), room)


def test_what_lies_apart_is_written(tmp_path: Path) -> None:
    source = tmp_path / "clip.mp4"
    source.write_bytes(b"")
    for output in ("clip", "clip.mp4.out", "results/clip.mp4", "../clip.mp4"):
        keep_apart(tmp_path / output, [source, tmp_path / "none"])


def git(folder: Path, *arguments: str) -> str:
    name = ("-c", "user.name=a", "-c", "user.email=a@b")
    done = subprocess.run(
        ["git", *name, *arguments], cwd=folder, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.mark.parametrize(
    ("package", "tracked", "told"),
    [
        ("shared/pliant", True, True),
        ("shared/pliant", False, False),
        (".venv/lib/site-packages/pliant", False, False),
        ("vendor/pliant", True, False),
    ],
)
def test_the_commit_is_that_of_our_own_sources(
    package: str, tracked: bool, told: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    git(tmp_path, "init", "-q")
    (tmp_path / package).mkdir(parents=True)
    (tmp_path / package / "__init__.py").touch()
    (tmp_path / "readme").touch()
    git(tmp_path, "add", *(["-A"] if tracked else ["readme"]))
    git(tmp_path, "commit", "-q", "-m", "one")
    head = git(tmp_path, "rev-parse", "HEAD")
    assert commit_of(tmp_path / package) == (head if told else "")
    monkeypatch.setenv("GIT_DIR", str(tmp_path / "none"))  # as in a hook of another checkout
    assert commit_of(tmp_path / package) == (head if told else "")


def test_the_figures_of_all_surfel_results_are_kept(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def judged(result: Path, _: str, figures: dict[str, Any]) -> Iterator[str]:
        figures["surfels"] = result.name
        yield result.name

    monkeypatch.setattr("pliant.evaluation.recorded_surfels.surfels_against_truth", judged)
    other, kept = tmp_path / "other", tmp_path / "kept.json"
    other.mkdir()
    for results in ([room], [room, other]):
        evaluation(room, results=results, surfels=True, json=kept, force=True)()
        each = [{"result": str(result), "surfels": result.name} for result in results]
        assert json.loads(kept.read_text()) == (each[0] if len(each) == 1 else {"results": each})
