"""A result stays until the one that replaces it has begun, whatever ends that before."""

import os
import shutil
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path

import pytest
from result_room import contents

from pliant.config import config_yaml, load_config
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import RecordingError, ResultError
from pliant.files import make_folder
from pliant.recording.parts import PART
from pliant.results import earlier
from pliant.results.folder import prepare, recorded_into, replace_by, settle_killed, written
from pliant_services.run import command as pipeline
from pliant_services.run.command import RunRequest, run_pipeline
from pliant_services.runtime.launcher import Fleet, ServiceDiedError

CONFIG = config_yaml(load_config())


class KilledError(BaseException):
    """The process is gone: nothing after it is done."""


@pytest.fixture
def one_frame(room: Path) -> bytes:
    """A recording."""
    return (room / "recording.mcap").read_bytes()


@pytest.fixture
def result(room: Path, one_frame: bytes) -> Path:
    """With all that a result may have, and what is not of a result."""
    assert one_frame
    (room / "recording.mcap").unlink()
    make_folder(room / "recording")
    for number in range(2):
        (room / "recording" / PART.format(number)).write_text(f"part {number}")
    (room / "recording" / "recovered.mcap").write_text("somebody's")
    make_folder(room / "state" / "tracking")
    make_folder(room / "state" / "ingest")
    (room / "state" / "tracking" / "7.state").write_text("a checkpoint")
    make_folder(room / "points_segment_2.ply")
    (room / "points_segment_2.ply" / "notes").write_text("somebody's")
    (room / "my_segment_1.txt").write_text("somebody's")
    (room / "trajectory_segment_0.txt").write_text("poses")
    (room / "notes").write_text("somebody's")
    return room


def begin(output: Path) -> None:
    """A run that replaces a result, before its first frame."""
    prepare(output, CONFIG)
    assert not (output / "trajectory.txt").exists()
    (output / "recording.mcap").write_text("no frame in it")


def test_what_was_there_comes_back_or_goes_when_another_has_begun(
    result: Path, one_frame: bytes
) -> None:
    before = contents(result)
    with written(result, force=True):
        begin(result)
    assert contents(result) == before
    with written(result, force=True):
        begin(result)
        (result / "recording.mcap").write_bytes(one_frame)
    after = {str(p.relative_to(result)) for p in result.rglob("*") if p.is_file()}
    kept = {"notes", "recording/recovered.mcap", "my_segment_1.txt", "points_segment_2.ply/notes"}
    assert after == kept | {"config.yaml", "recording.mcap", "logs/metadata.json"}


def test_what_cannot_be_deleted_costs_no_new_result(
    room: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    one_frame = (room / "recording.mcap").read_bytes()

    def left(folder: Path, ignore_errors: bool = False) -> None:
        assert ignore_errors

    monkeypatch.setattr(shutil, "rmtree", left)
    for _ in range(2):
        with written(room, force=True):
            prepare(room, CONFIG)
            (room / "recording.mcap").write_bytes(one_frame)
            (room / "report.json").write_text("new")
        assert (room / "report.json").read_text() == "new"
        assert not earlier.is_aside(room)
    monkeypatch.undo()
    with written(room, force=True):
        pass
    assert not list(room.glob(".*"))


def test_what_cannot_be_read_is_not_taken_for_nothing(
    room: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Neither result goes, and the one who comes next is told."""
    prepare(room, CONFIG)
    (room / "recording.mcap").write_bytes(b"a recording")

    def unreadable(*_: object) -> None:
        raise RecordingError("recording.mcap: Input/output error")

    monkeypatch.setattr("pliant.results.folder.Recording", unreadable)
    before = contents(room)
    with pytest.raises(RecordingError, match="Input/output error"):
        settle_killed(room)
    with pytest.raises(RecordingError, match="Input/output error"):
        pipeline._finish(room, interrupted=False, failure=None)
    assert contents(room) == before


def test_one_part_with_a_frame_is_enough(result: Path, one_frame: bytes) -> None:
    prepare(result, CONFIG)
    make_folder(result / "recording")
    for number, data in enumerate((b"", b"no recording", one_frame)):
        (result / "recording" / PART.format(number)).write_bytes(data)
    settle_killed(result)
    assert (result / "recording" / PART.format(2)).read_bytes() == one_frame
    assert not (result / "trajectory.txt").exists()


def test_what_was_put_back_by_hand_stays(room: Path) -> None:
    (room / "recording.mcap").unlink()
    prepare(room, CONFIG)
    (aside,) = room.glob("earlier_result.*")
    for path in aside.iterdir():
        path.rename(room / path.name)
    before = contents(room)
    settle_killed(room)
    with written(room, force=True):
        pass
    assert contents(room) == before
    assert not aside.exists()


def test_a_recording_behind_a_link_is_not_touched(result: Path, tmp_path: Path) -> None:
    elsewhere = (result / "recording").rename(tmp_path / "elsewhere")
    (result / "recording").symlink_to(elsewhere)
    before = contents(result), contents(elsewhere)
    with pytest.raises(ResultError, match="is a link"), written(result, force=True):
        prepare(result, CONFIG)
    assert (contents(result), contents(elsewhere)) == before


def test_a_recorder_finds_the_folder_as_it_was_before_a_run_that_was_killed(room: Path) -> None:
    before = contents(room)
    prepare(room, CONFIG)
    with recorded_into(room):
        pass
    assert {**contents(room), "metadata.json": before["metadata.json"]} == before


def test_a_kill_at_any_point_costs_nothing(result: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(result)
    rename, steps = Path.rename, 0
    while True:
        left = steps

        def killed(path: Path, target: Path) -> Path:
            nonlocal left
            left -= 1
            if left < 0:
                raise KilledError
            return rename(path, target)

        # All of it by one process, which is killed at one point; another one comes after it.
        with monkeypatch.context() as patch, suppress(KilledError):
            patch.setattr(Path, "rename", killed)
            begin(result)
            earlier.put_back(result, [result / "config.yaml", result / "recording.mcap"])
        settle_killed(result)
        assert contents(result) == before, steps
        if left >= 0:
            break
        steps += 1
    assert steps > 15
    assert (result / "state" / "ingest").is_dir()


def test_a_run_that_ends_before_its_first_frame_leaves_a_result_as_it_was(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (room / "overlay.webm").write_text("an export")
    before, ends = contents(room), list[BaseException]()

    def start(fleet: Fleet, arguments: object) -> None:
        raise ends[-1]

    monkeypatch.setattr(Fleet, "start", start)
    for error in (
        KeyboardInterrupt(),
        ServiceDiedError("ingest: its camera is gone", crashed=False),
        ServiceDiedError("tracking was killed", crashed=True),
    ):
        ends.append(error)
        others = tmp_path / "others"
        make_folder(others / "logs")
        (others / "logs" / "diary.txt").write_text("somebody's")
        for output in (room, tmp_path / "new", others):
            with pytest.raises((KeyboardInterrupt, ResultError, ServiceDiedError)) as raised:
                run_pipeline(
                    RunRequest(
                        source=SourceSpec(location="built-in:tiny"), output=output, force=True
                    )
                )
            assert raised.type is type(error)
        assert {**contents(room), "metadata.json": before["metadata.json"]} == before
        assert (tmp_path / "new").exists() == (getattr(error, "crashed", False))
        assert (others / "logs" / "diary.txt").exists()


def test_a_full_disk_leaves_a_result_as_it_was(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(room)

    def full(*_: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr("pliant.results.folder.write_whole", full)
    with pytest.raises(ResultError, match="the disk is full"), written(room, force=True):
        prepare(room, CONFIG)
    assert contents(room) == before


def test_a_kill_while_a_whole_result_takes_the_place_of_another_leaves_one_of_both(
    result: Path, one_frame: bytes, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In parts before, in one file then; what is of no result stays."""
    before, came, steps = contents(result), list[bool](), 0
    after = {
        **{name: before[name] for name in ("notes", "recovered.mcap", "my_segment_1.txt")},
        "recording.mcap": one_frame,
        "config.yaml": b"new",
        "report.json": b"new",
        "metadata.json": b"new",
    }
    while True:
        output = Path(shutil.copytree(result, tmp_path / str(steps)))
        made, left = output / ".partial-x" / "result", steps
        make_folder(made / "logs")
        (made / "recording.mcap").write_bytes(one_frame)
        for name in ("config.yaml", "report.json", "logs/metadata.json"):
            (made / name).write_text("new")

        def counted(name: str) -> Callable[..., object]:
            original = getattr(Path, name)

            def step(*arguments: object, **options: object) -> object:
                nonlocal left
                left -= 1
                if left < 0:
                    raise KilledError
                return original(*arguments, **options)

            return step

        with monkeypatch.context() as patch, suppress(KilledError):
            for name in ("rename", "replace", "unlink", "rmdir"):
                patch.setattr(Path, name, counted(name))
            replace_by(output, made)
        shutil.rmtree(output / ".partial-x")
        settle_killed(output)
        found = contents(output)
        assert found in (before, after), steps
        came.append(found == after)
        if left >= 0:
            break
        steps += 1
    assert came == sorted(came)
    assert not came[0]
    assert steps > 5
