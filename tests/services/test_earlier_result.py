"""A result stays until the one that replaces it has begun, whatever ends that before."""

import os
from contextlib import suppress
from pathlib import Path

import pytest
from result_room import contents

from pliant.config import config_yaml, load_config
from pliant.errors import ResultError
from pliant.files import make_folder
from pliant.recording.parts import PART
from pliant.results import earlier
from pliant.results.folder import prepare, written
from pliant_services.run.command import RunRequest, run_pipeline
from pliant_services.runtime.launcher import Fleet, ServiceDiedError

CONFIG = config_yaml(load_config())


class KilledError(BaseException):
    """The process is gone: nothing after it is done."""


@pytest.fixture
def result(room: Path) -> Path:
    """With all that a result may have, and what is not of a result."""
    (room / "recording.mcap").unlink()
    make_folder(room / "recording")
    for number in range(2):
        (room / "recording" / PART.format(number)).write_text(f"part {number}")
    (room / "recording" / "recovered.mcap").write_text("somebody's")
    make_folder(room / "state" / "tracking")
    (room / "state" / "tracking" / "7.state").write_text("a checkpoint")
    (room / "trajectory_segment_0.txt").write_text("poses")
    (room / "notes").write_text("somebody's")
    return room


def begin(output: Path) -> None:
    """A run that replaces a result, before its first frame."""
    prepare(output, CONFIG)
    assert not (output / "trajectory.txt").exists()
    (output / "recording.mcap").write_text("no frame in it")


def test_what_was_there_comes_back_or_goes_when_another_has_begun(result: Path) -> None:
    before = contents(result)
    with written(result, force=True):
        begin(result)
    assert contents(result) == before
    with written(result, force=True):
        begin(result)
        earlier.replace(result)
        earlier.replace(result)
    after = {str(p.relative_to(result)) for p in result.rglob("*") if p.is_file()}
    kept = {"notes", "recording/recovered.mcap"}
    assert after == kept | {"config.yaml", "recording.mcap", "logs/metadata.json"}


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
        with written(result, force=True):
            pass
        assert contents(result) == before, steps
        if left >= 0:
            break
        steps += 1
    assert steps > 2 * len(before) - 6


def test_a_run_that_ends_before_its_first_frame_leaves_a_result_as_it_was(
    room: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (room / "overlay.mp4").write_text("an export")
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
        for output in (room, tmp_path / "new"):
            with pytest.raises((KeyboardInterrupt, ResultError, ServiceDiedError)) as raised:
                run_pipeline(RunRequest(source="built-in:tiny", output=output, force=True))
            assert raised.type is type(error)
        assert {**contents(room), "metadata.json": before["metadata.json"]} == before
        assert (tmp_path / "new").exists() == (getattr(error, "crashed", False))


def test_a_full_disk_leaves_a_result_as_it_was(room: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = contents(room)

    def full(*_: object) -> None:
        raise OSError(28, os.strerror(28))

    monkeypatch.setattr("pliant.results.folder.write_whole", full)
    with pytest.raises(ResultError, match="the disk is full"), written(room, force=True):
        prepare(room, CONFIG)
    assert contents(room) == before
