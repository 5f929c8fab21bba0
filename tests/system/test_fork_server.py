"""Services are forks of one process; they behave as programs, and become them where that fails."""

import os
import signal
import subprocess
from collections.abc import Callable, Generator
from contextlib import ExitStack
from pathlib import Path

import pytest
from running import NO_MESH, TIMEOUT_S, TINY, UP, children, digests, has_ended, running
from watched_runs import REQUEST, SERVICES, run

from pliant import __version__
from pliant.config import config_yaml, load_config
from pliant.results.folder import prepare
from pliant.results.write import write_results
from pliant_services.run.command import service_arguments
from pliant_services.runtime.fork_server import ForkedProcess, ForkServer
from pliant_services.runtime.launcher import Fleet

pytestmark = pytest.mark.system

SERVER = "fork_server"


def is_fork(pid: int) -> bool:
    """Whether a process shows its command line in the server's room, longer than any of its own."""
    return len(Path(f"/proc/{pid}/cmdline").read_bytes()) > 4096


@pytest.fixture
def server() -> Generator[ForkServer]:
    with ForkServer(()) as server:
        yield server


@pytest.fixture
def start(server: ForkServer) -> Generator[Callable[..., ForkedProcess]]:
    with ExitStack() as opened:

        def start(*arguments: str) -> ForkedProcess:
            process = server.start(arguments)
            assert process is not None
            opened.enter_context(process.stdin)
            opened.enter_context(process.stdout)
            return process

        yield start


def test_services_are_forks_of_a_server_that_leaves(tmp_path: Path) -> None:
    with running(TINY, "--output", tmp_path / "run", "--mode", "live", *NO_MESH) as run:
        run.wait_for(UP)
        assert set(run.services) == set(SERVICES)
        assert all(map(is_fork, run.services.values()))
        assert all(os.getsid(pid) == pid for pid in run.services.values())
        assert not children(run.process.pid, SERVER)


def test_a_server_that_is_killed_changes_nothing(tmp_path: Path) -> None:
    """What it has not forked is started as programs."""
    output = tmp_path / "killed"
    prepare(output, config_yaml(load_config()))
    fleet = Fleet(SERVICES, log_folder=output / "logs", on_status=lambda _: None)

    def arguments(name: str) -> list[str]:
        if name == "bundle_adjustment":  # those before it have been started
            (server,) = children(os.getpid(), SERVER)
            os.kill(server, signal.SIGKILL)
        return service_arguments(name, REQUEST, output)

    try:
        fleet.start(arguments)
        forked = {name for name, pid in fleet.pids.items() if is_fork(pid)}
        fleet.wait()
    finally:
        fleet.close()
    assert forked == set(SERVICES) - {"bundle_adjustment"}
    write_results(output)
    assert digests(output) == run(tmp_path / "whole")


@pytest.mark.parametrize("kind", [signal.SIGKILL, signal.SIGINT])
def test_nothing_is_left_of_a_launcher_that_ends_during_the_start(
    kind: signal.Signals, tmp_path: Path
) -> None:
    with running(TINY, "--output", tmp_path / "run", *NO_MESH) as run:
        while not (servers := children(run.process.pid, SERVER)):
            assert run.process.poll() is None
        run.send(kind)
        assert all(has_ended(pid, TIMEOUT_S) for pid in servers)
        assert run.process.wait(TIMEOUT_S) == (130 if kind == signal.SIGINT else -kind)


def test_exit_codes_and_output_reach_the_launcher(
    server: ForkServer, start: Callable[..., ForkedProcess]
) -> None:
    good, bad = start("--version"), start("--no-such-option")
    server.close()
    assert good.stdout.read() == f"pliant {__version__}\n".encode()
    assert b"No such option" in bad.stdout.read()
    assert (good.wait(TIMEOUT_S), bad.wait(TIMEOUT_S)) == (0, 2)


def test_a_signal_reaches_the_launcher(
    server: ForkServer, start: Callable[..., ForkedProcess]
) -> None:
    at_once, later = (start("router", "--listen", "tcp/127.0.0.1:0") for _ in range(2))
    os.kill(at_once.pid, signal.SIGKILL)  # while it is the server's child
    server.close()
    with pytest.raises(subprocess.TimeoutExpired):
        later.wait(0.0)
    later.kill()
    assert [each.wait(TIMEOUT_S) for each in (at_once, later)] == [-signal.SIGKILL] * 2


def test_a_closed_server_starts_nothing(server: ForkServer) -> None:
    server.close()
    server.load(["tracking"])
    assert server.start(["--version"]) is None
