"""What a shell does not grant is one line, and nobody waits for what never comes."""

import subprocess
import threading
from pathlib import Path

import pytest
from running import TIMEOUT_S, TINY, assert_one_line, command

from pliant_services import cli

pytestmark = pytest.mark.system


@pytest.mark.parametrize(
    ("limit", "says"),
    [
        ("-n 30", "pliant: only 30 open files are allowed: run ulimit -n 1024"),
        ("-v 1500000", "pliant: only 1464 MiB of address space are allowed, but a service needs"),
    ],
)
def test_limits_that_are_too_low_are_one_line(limit: str, says: str, tmp_path: Path) -> None:
    words = command("run", TINY, "--output", tmp_path / "tiny")
    done = subprocess.run(
        ["bash", "-c", f'ulimit {limit}; exec "$@"', "bash", *words],
        capture_output=True, text=True, timeout=TIMEOUT_S,
    )  # fmt: skip
    assert (done.returncode, done.stderr.count("\n")) == (1, 1), done.stderr
    assert done.stderr.startswith(says)
    assert not (tmp_path / "tiny").exists()


def test_a_shell_in_a_folder_that_was_deleted_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "gone").mkdir()
    words = command("run", TINY, "--output", tmp_path / "tiny")
    done = subprocess.run(
        ["bash", "-c", 'cd "$0"; rmdir "$0"; exec "$@"', tmp_path / "gone", *words],
        capture_output=True, text=True, timeout=TIMEOUT_S,
    )  # fmt: skip
    assert_one_line(done, "the current folder is not accessible")


@pytest.mark.parametrize("error", [SystemExit(1), RuntimeError("a fault of ours")])
def test_a_failure_does_not_wait_for_threads_that_it_left(
    error: BaseException, monkeypatch: pytest.MonkeyPatch
) -> None:
    class LeftError(BaseException):
        pass

    def fail(application: object) -> None:
        raise error

    def leave(code: int) -> None:
        raise LeftError(code)

    over = threading.Event()
    left = threading.Thread(target=over.wait)
    left.start()
    monkeypatch.setattr(cli, "run_and_exit", fail)
    monkeypatch.setattr(cli.os, "_exit", leave)
    monkeypatch.setattr(cli, "_INTERRUPTIONS", ())
    try:
        with pytest.raises(LeftError, match="1"):
            cli.main()
    finally:
        over.set()
        left.join()
