"""Who may write a result folder: nobody what he reads, and one at a time."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from pliant.algorithms.tracks import FrameTracks
from pliant.config import config_yaml, load_config
from pliant.errors import PliantError, RecordingError, ResultError
from pliant.evaluation.evaluate import EvaluationRequest, run_evaluation
from pliant.export.export import export_result
from pliant.messages import codec, topics
from pliant.messages.types import CameraStream, Extrema, Header, StreamEnd
from pliant.recording.writer import RecordingWriter
from pliant.results.folder import commit_of, keep_apart, prepare, run_metadata, settle, written
from pliant_services.calibrate.command import check_file
from pliant_services.cli.commands import app
from pliant_services.mesh.command import run_mesh
from pliant_services.replay.command import ReplayRequest, run_replay
from pliant_services.run.command import RunRequest, run_pipeline

READ = "is read from there"


@pytest.fixture
def room(tmp_path: Path) -> Path:
    """A result folder with a recording of one frame."""
    folder = tmp_path / "room"
    prepare(folder, config_yaml(load_config()))
    header = Header(frame=0, stamp_ns=0, frame_id="camera")
    stream = CameraStream(
        frame=0, stamp_ns=0, frame_id="camera", source="fake", mode="lossless", frames=1,
        calibration="", width=24, height=16, fx=20.0, fy=20.0, cx=12.0, cy=8.0,
    )  # fmt: skip
    messages = (
        (topics.STREAM, stream),
        (topics.EXTREMA, Extrema.of(header, FrameTracks.empty())),
    )
    metadata = run_metadata(config_yaml(load_config()))
    with RecordingWriter(folder / "recording.mcap", metadata) as writer:
        for topic, message in messages:
            end = StreamEnd(
                frame=1, stamp_ns=0, frame_id="", topic=topic.key, messages=1, complete=True
            )
            for sequence, (to, what) in enumerate([(topic, message), (topics.STREAM_END, end)]):
                data = codec.encode(what)
                writer.write(to, data, sequence=sequence, log_time_ns=1, publish_time_ns=0)
    for name in ("trajectory.txt", "report.json", "points.ply"):
        (folder / name).write_text(f"{name} of an earlier run")
    return folder


def contents(folder: Path) -> dict[str, bytes]:
    return {p.name: p.read_bytes() for p in sorted(folder.rglob("*")) if p.is_file()}


def refused(command: Callable[[], object], folder: Path, says: str = READ) -> None:
    before = contents(folder)
    with pytest.raises(PliantError, match=says):
        command()
    assert contents(folder) == before


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
        request = RunRequest(source=source, output=Path(output) if output else None, force=True)
        refused(lambda request=request: run_pipeline(request), room)
    monkeypatch.chdir(room)
    refused(lambda: run_pipeline(RunRequest(source=".", output=Path("."), force=True)), room)


def test_a_run_does_not_destroy_the_calibration_that_it_is_given(room: Path) -> None:
    """What a run has found is for the next one: not into the same folder."""
    found = room / "calibration.yaml"
    found.write_text("found by an earlier run")
    run = RunRequest(source="built-in:tiny", output=room, calibration=found, force=True)
    refused(lambda: run_pipeline(run), room, f"{READ}: choose another --output")


def test_earlier_results_are_there_until_those_that_replace_them_have_begun(room: Path) -> None:
    (room / "recording").mkdir()
    for name in ("recording/part_00000.mcap", "recording/mine", "points_segment_1.ply", "notes"):
        (room / name).write_text(name)
    (room / "state" / "tracking").mkdir(parents=True)
    (room / "state" / "tracking" / "1.state").touch()
    before = contents(room)
    for _ in range(2):
        with written(room, force=True):
            prepare(room, "seed: 1\n")
            assert not (room / "recording.mcap").exists()
            (room / "recording.mcap").write_text("no frame")
            (room / "recording" / "part_00001.mcap").write_text("no frame")
        assert {**contents(room), "metadata.json": b""} == {**before, "metadata.json": b""}
    prepare(room, "seed: 1\n")  # killed at this point
    with written(room, force=True):
        prepare(room, "seed: 2\n")
    assert {**contents(room), "metadata.json": b""} == {**before, "metadata.json": b""}
    with written(room, force=True):
        prepare(room, "seed: 2\n")
        settle(room)
    assert set(contents(room)) == {"config.yaml", "metadata.json", "mine", "notes"}


def test_a_replay_that_fails_leaves_what_was_there(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    other = tmp_path / "other.mcap"
    os.link(room / "recording.mcap", other)
    (room / "recording.mcap").unlink()
    (room / "recording.mcap").write_text("another run's")
    before = contents(room)

    def fails(*_: object) -> None:
        raise RecordingError("it ends here")

    monkeypatch.setattr("pliant_services.replay.command.require_inputs", lambda *_: None)
    monkeypatch.setattr("pliant_services.replay.command.Replay.run", fails)
    replay = ReplayRequest(recording=other, services=["bundle_adjustment"], output=room, force=True)
    with pytest.raises(PliantError, match="ends here"):
        run_replay(replay)
    assert {**contents(room), "metadata.json": b""} == {**before, "metadata.json": b""}


def test_parts_are_read_wherever_they_are(room: Path, tmp_path: Path) -> None:
    folder = tmp_path / "elsewhere"
    folder.mkdir()
    (folder / "part_00000.mcap").symlink_to(room / "recording.mcap")
    request = RunRequest(source=str(folder), output=room, force=True)
    refused(lambda: run_pipeline(request), room)


@pytest.mark.parametrize("save", ["recording.mcap", "report.json", "../room/config.yaml"])
def test_a_view_is_not_saved_over_the_run_that_it_shows(room: Path, save: str) -> None:
    request = RunRequest(source="built-in:tiny", output=room, save=room / save, force=True)
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
            request = EvaluationRequest(
                results=[link], groundtruth=str(room / "trajectory.txt"), times=None, frames=None,
                tracks=False, points=False, mesh=False, surfels=False, force=True,
                **{"json": None, "plot": None, option: room / file},
            )  # fmt: skip
            refused(lambda request=request: list(run_evaluation(request)), room)


def evaluation(truth: Path, **outputs: object) -> Callable[[], object]:
    request: dict[str, Any] = {
        "results": [truth / "result.txt"], "groundtruth": str(truth), "times": None, "frames": None,
        "tracks": False, "points": False, "mesh": False, "surfels": False, "json": None,
        "plot": None, **outputs,
    }  # fmt: skip
    return lambda: list(run_evaluation(EvaluationRequest(**request)))


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


@pytest.mark.parametrize(
    ("output", "says"),
    [
        ("cal/000005.yaml", "lies in"),
        ("cal/calib.yaml", "lies in"),
        ("clip.yaml", READ),  # its picture would be what is filmed
        ("mask.yaml", READ),
        ("found.png", "is no picture"),
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


HOLD = """
import sys
from pathlib import Path
from pliant.results.folder import written
with written(Path(sys.argv[1]), force=True):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_one_process_writes_a_result_folder_and_a_dead_one_holds_nobody_up(room: Path) -> None:
    command = [sys.executable, "-c", HOLD, str(room)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        says = f"is being written by process {holder.pid}: wait"
        run = RunRequest(source="built-in:tiny", output=room, force=True)
        refused(lambda: run_pipeline(run), room, says)
        resumed = RunRequest(source="built-in:tiny", output=room, resume=True)
        refused(lambda: run_pipeline(resumed), room, says)
        other = room.with_name("other.mcap")
        os.link(room / "recording.mcap", other)
        replay = ReplayRequest(recording=other, services=["tracking"], output=room, force=True)
        refused(lambda: run_replay(replay), room, says)
        holder.kill()
    with written(room, force=True):
        assert (room / ".lock").read_text() == f"{os.getpid()}\n"
    assert not (room / ".lock").exists()


def test_a_folder_that_nothing_came_of_goes(tmp_path: Path) -> None:
    output = tmp_path / "results" / "none"
    with pytest.raises(PliantError, match="no such"):
        run_pipeline(RunRequest(source=str(tmp_path / "none.mp4"), output=output))
    assert not output.parent.exists()
    with (
        written(output, force=False),
        pytest.raises(ResultError, match="being written"),
        written(output, force=False),
    ):
        pass
    with written(output, force=False):
        (output / "mine").touch()
    with pytest.raises(ResultError, match="--force"), written(output, force=False):
        pass


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
