"""Fixtures of all tests."""

import os
import signal
import subprocess
import threading
from collections.abc import Generator, Iterator
from contextlib import suppress
from pathlib import Path

import pytest
from hypothesis import HealthCheck, settings

import pliant  # noqa: F401  (fixes the arithmetic before any test loads numpy)
from pliant.bus.session import free_endpoint, open_router

ROOT = Path(__file__).parents[1]
SHARED_DATA = ROOT.parent / "shared" / "data"

# A busy machine is no fault of the tests, and what fails once fails always.
settings.register_profile(
    "any machine",
    deadline=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.too_slow],
)
settings.load_profile("any machine")

PATIENCE_S = 1500.0  # the longest installs all on a bare machine: ten minutes beside others


@pytest.hookimpl(wrapper=True)
def pytest_runtest_protocol() -> Generator[None, object, object]:
    """A test whose processes wait for each other fails, rather than hold up all that follow.

    What it waits for is killed.  One that waits for its own threads ends all: faulthandler_timeout.
    """
    watch = threading.Timer(PATIENCE_S, kill_descendants)
    watch.daemon = True
    watch.start()
    try:
        return (yield)
    finally:
        watch.cancel()


def kill_descendants() -> None:
    """Kill the processes that this one has started, and those that they have."""
    listed = subprocess.run(["ps", "-eo", "pid=,ppid="], capture_output=True, text=True)
    parents = {int(pid): int(parent) for pid, parent in map(str.split, listed.stdout.splitlines())}
    family = {os.getpid()}
    while more := {pid for pid, parent in parents.items() if parent in family} - family:
        family |= more
    for pid in family - {os.getpid()}:
        with suppress(ProcessLookupError, PermissionError):
            os.kill(pid, signal.SIGKILL)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Files with long tests first: begun last, the longest would go on when all others are done."""

    def takes_long(item: pytest.Item) -> bool:
        return any(item.get_closest_marker(mark) for mark in ("slow", "system"))

    long = {item.path for item in items if takes_long(item)}
    items.sort(key=lambda item: item.path not in long)


ALLOWED_SKIPS = (
    "the real sequences are not here",
    "the stereo pair of the shared data is not here",
    "no ../shared/data",
    "no public problems in",
    "shared/data is not here",
    "GTSAM has no wheel here",
    "the command of rerun",  # not in each of its packages
    "no Docker engine answers",
    "no base image",
    "neither docker-compose nor docker compose is installed",
    "docker-compose is not installed",
    "docker compose is not installed",
    "open3d is installed but cannot be loaded",  # without root nobody installs its libraries
    "containers do not reach Debian's packages here",
    "hosts need root and",
    "no network namespaces here",
    "a small file system can be mounted by root only",
    "takes minutes: scripts/soak",
    "chromium is not installed",
    "xvfb is not installed",
    "systemd-analyze is not installed",
    "there is a camera, which never ends",
)
"""What may lack on a machine on which all tests pass.  A test that skips for another reason is one
that nobody runs: CI fails of it."""
_unexpected: list[str] = []


def pytest_runtest_logreport(report: pytest.TestReport) -> None:
    """Keep the skips that nobody has allowed."""
    _note_skip(report)


def pytest_collectreport(report: pytest.CollectReport) -> None:
    """The same for a file that is skipped as a whole."""
    _note_skip(report)


def _note_skip(report: pytest.TestReport | pytest.CollectReport) -> None:
    if report.skipped and isinstance(report.longrepr, tuple):
        _, _, reason = report.longrepr
        if not any(allowed in reason for allowed in ALLOWED_SKIPS):
            _unexpected.append(f"{report.nodeid}: {reason}")


def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail where CI would otherwise pass without a test."""
    is_worker = hasattr(session.config, "workerinput")
    if _unexpected and os.environ.get("CI") and not is_worker:
        for line in _unexpected:
            print(f"\nskipped, and not in ALLOWED_SKIPS: {line}")
        session.exitstatus = pytest.ExitCode.TESTS_FAILED


@pytest.fixture(scope="session", autouse=True)
def no_waiting_for_the_disk() -> Iterator[None]:
    """Thousands of files are synchronised here, each for milliseconds in which nothing else runs.

    tests/services/test_power_cut.py checks what is synchronised, and when.
    """
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(os, "fsync", lambda descriptor: None)
        yield


@pytest.fixture(scope="session")
def rigid_data() -> Path:
    """The real sequences, where they are at hand."""
    folder = SHARED_DATA / "rigid"
    if not folder.is_dir():
        pytest.skip("the real sequences are not here (../shared/data/rigid)")
    return folder


@pytest.fixture
def precious(tmp_path: Path) -> Path:
    """A file that no link may lead a writer to."""
    file = tmp_path / "elsewhere" / "precious"
    file.parent.mkdir()
    file.write_text("precious")
    return file


@pytest.fixture
def endpoint() -> Iterator[str]:
    """Where a router of this process listens."""
    found = free_endpoint()
    router = open_router(found)
    yield found
    router.close()
