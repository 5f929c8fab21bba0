"""One at a time writes a result folder."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
from result_room import evaluation, refused

from pliant.config import load_config
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import PliantError, ResultError, SourceLostError
from pliant.export.export import export_result
from pliant.results.folder import (
    is_being_written,
    recorded_into,
    written,
)
from pliant.scale.command import Known, scale_result
from pliant_services.cli.commands import app
from pliant_services.replay.command import ReplayRequest, run_replay
from pliant_services.run.command import RunRequest, run_pipeline
from pliant_services.runtime.host import ServiceOptions
from pliant_services.runtime.session_end import run_alone

HOLD = """
import sys
from pathlib import Path
from pliant.results.folder import written
with written(Path(sys.argv[1]), force=True):
    print("held", flush=True)
    sys.stdin.read()
"""


def test_one_process_writes_a_result_folder_and_a_dead_one_blocks_no_other(room: Path) -> None:
    command = [sys.executable, "-c", HOLD, str(room)]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as holder:
        assert holder.stdout is not None
        holder.stdout.readline()
        waits = f"is being written by process {holder.pid}: wait until it ends$"
        says = f"{waits[:-1]}, or choose another --output$"
        run = RunRequest(source=SourceSpec(location="built-in:tiny"), output=room, force=True)
        refused(lambda: run_pipeline(run), room, says)
        resumed = RunRequest(source=SourceSpec(location="built-in:tiny"), output=room, resume=True)
        refused(lambda: run_pipeline(resumed), room, says)
        other = room.with_name("other.mcap")
        os.link(room / "recording.mcap", other)
        replay = ReplayRequest(recording=other, services=["tracking"], output=room, force=True)
        refused(lambda: run_replay(replay), room, says)
        for output in (None, room / "new"):
            refused(lambda output=output: export_result(room, "tum", output), room, says)
        refused(evaluation(room, results=[room], groundtruth=str(other)), room, waits)
        refused(lambda: list(scale_result(room, Known(marker=0.1))), room, waits)
        recover = ["recover", str(room), "--output", str(room / "whole.mcap")]
        refused(lambda: app(recover, standalone_mode=False), room, says)
        holder.kill()
    with written(room, force=True):
        assert (room / ".lock").read_text() == f"{os.getpid()}\n"
    assert not (room / ".lock").exists()


def test_recorders_of_several_sessions_hold_one_folder_against_a_run(room: Path) -> None:
    says = f"is being written by process {os.getpid()}"
    run = RunRequest(source=SourceSpec(location="built-in:tiny"), output=room, force=True)
    with recorded_into(room):
        with recorded_into(room):
            refused(lambda: run_pipeline(run), room, says)
        refused(lambda: run_pipeline(run), room, says)
    assert not (room / ".lock").exists()
    with written(room, force=True), pytest.raises(ResultError, match=says), recorded_into(room):
        pass


@pytest.mark.parametrize("results", [True, False])
def test_every_recorder_holds_its_folder(
    results: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    output, held = tmp_path / "room" / "recording.mcap", list[bool]()

    def record(*_: object) -> None:
        held.append(is_being_written(output.parent))
        raise SourceLostError("the source went away")

    monkeypatch.setattr("pliant_services.runtime.session_end.run_service", record)
    options = ServiceOptions(
        endpoints=[], session="s", fleet=("recorder",), arguments={"output": output}
    )
    with pytest.raises(SourceLostError):
        run_alone("recorder", load_config(), options, results=results)
    assert held == [True]
    assert not is_being_written(output.parent)


def test_a_folder_that_nothing_came_of_goes(tmp_path: Path) -> None:
    output = tmp_path / "results" / "none"
    with pytest.raises(PliantError, match="no such"):
        run_pipeline(
            RunRequest(source=SourceSpec(location=str(tmp_path / "none.mp4")), output=output)
        )
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
