"""A run that was recorded to its end, and was killed before its results stood."""

import os
import shutil
import signal
from pathlib import Path

import pytest
from running import (
    FILES,
    NO_MESH,
    TINY,
    assert_one_line,
    digests,
    in_this_process,
    running,
    services_of,
)

from pliant.datasets.source_spec import SourceSpec
from pliant.recording.recover import recover
from pliant.results.folder import STATE_FOLDER
from pliant_services.run.command import run_pipeline
from pliant_services.run.request import RunRequest

pytestmark = pytest.mark.system


class KilledError(BaseException):
    """The process is gone."""


def unwritten(tiny_run: Path, folder: Path) -> Path:
    """As a kill leaves it: results on their way, and a session that answers no more."""
    shutil.copytree(tiny_run, folder)
    for path in folder.iterdir():
        if path.is_file() and path.name not in ("recording.mcap", "config.yaml"):
            path.unlink()
    (folder / ".partial-abc" / "results").mkdir(parents=True)
    (folder / ".partial-abc" / "results" / "points.ply").write_text("half of them")
    (folder / "session.json").write_text('{"endpoint": "tcp/127.0.0.1:1", "session": "run-1"}')
    (folder / ".lock").write_text("1\n")
    return folder


def test_results_are_made_of_what_was_recorded(tiny_run: Path, tmp_path: Path) -> None:
    folder = unwritten(tiny_run, tmp_path / "tiny")
    done = in_this_process("run", TINY, "--resume", "--output", folder)
    assert done.returncode == 0, done.stderr
    assert "results are written again" in done.stderr
    assert digests(folder) == digests(tiny_run)
    assert (folder / "mesh.ply").read_bytes() == (tiny_run / "mesh.ply").read_bytes()
    assert {p.name for p in folder.iterdir()} == {p.name for p in tiny_run.iterdir()}
    over = in_this_process("run", TINY, "--resume", "--output", folder)
    assert_one_line(over, "there is nothing to resume")


def test_what_was_cut_off_cannot_be_resumed(tiny_run: Path, tmp_path: Path) -> None:
    folder = unwritten(tiny_run, tmp_path / "tiny")
    whole = (folder / "recording.mcap").read_bytes()
    (folder / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    recover(folder / "cut.mcap", folder / "recording.mcap")
    (folder / "cut.mcap").unlink()
    done = in_this_process("run", TINY, "--resume", "--output", folder)
    assert_one_line(done, "started without --on-crash restart, and cannot resume")


def test_a_run_of_another_release_names_what_it_does_not_know(
    tiny_run: Path, tmp_path: Path
) -> None:
    folder = unwritten(tiny_run, tmp_path / "tiny")
    (folder / "config.yaml").write_text("tracking: {no_such_key: true}\n")
    done = in_this_process("run", TINY, "--resume", "--output", folder)
    assert_one_line(done, "no_such_key")
    assert "resume with the release that began" in done.stderr


def test_a_service_that_is_killed_while_it_starts_is_started_again(
    tiny_run: Path, tmp_path: Path
) -> None:
    with running(TINY, *NO_MESH, "--on-crash", "restart", "--output", tmp_path / "tiny") as run:
        while "recorder" not in (services := services_of(run.process.pid)):
            assert run.process.poll() is None
        os.kill(services["recorder"], signal.SIGKILL)
        code, _, errors = run.finish()
    assert code == 0, errors
    assert digests(tmp_path / "tiny") == digests(tiny_run)


def test_what_resumes_a_run_stays_until_its_results_stand(
    tiny_run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def killed(output: Path) -> None:
        raise KilledError

    request = RunRequest(
        source=SourceSpec(location=TINY),
        output=tmp_path / "tiny",
        on_crash="restart",
        overrides=NO_MESH[1:],
    )
    with monkeypatch.context() as patch:
        patch.setattr("pliant.results.write.write_results", killed)
        with pytest.raises(KilledError):
            run_pipeline(request)
    assert (tmp_path / "tiny" / STATE_FOLDER).is_dir()
    done = in_this_process("run", TINY, "--resume", "--output", tmp_path / "tiny")
    assert done.returncode == 0, done.stderr
    assert digests(tmp_path / "tiny") == digests(tiny_run)
    assert not (tmp_path / "tiny" / STATE_FOLDER).exists()
    assert all((tmp_path / "tiny" / name).exists() for name in FILES)
