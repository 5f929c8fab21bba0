"""A session from its parts: a router of its own, services started one by one, status and stop."""

import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

from pliant.bus.session import free_endpoint
from pliant_services.processes import PROFILES

pytestmark = pytest.mark.system

PLIANT = [sys.executable, "-m", "pliant_services.cli"]


def start(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [*PLIANT, *arguments], stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True
    )


def call(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run([*PLIANT, *arguments], capture_output=True, text=True, timeout=120)


@pytest.fixture
def endpoint() -> Iterator[str]:
    found = free_endpoint()
    router = start("router", "--listen", found)
    assert router.stdout is not None
    assert "router on" in router.stdout.readline()
    yield found
    router.terminate()
    assert router.wait(20) == 0
    router.stdout.close()


def test_status_and_stop_of_a_session_in_parts(endpoint: str, tmp_path) -> None:
    extra = {
        "ingest": ["--source", "built-in:room"],
        "recorder": ["--output", str(tmp_path / "recording.mcap")],
    }
    with ExitStack() as running:
        services = {
            name: running.enter_context(
                start(
                    "service", name, "--connect", endpoint, "--session", "lab", *extra.get(name, [])
                )
            )
            for name in PROFILES["points"]
        }
        rows: dict[str, str] = {}
        while not set(services) <= set(rows):  # they come up by and by
            shown = call("status", "--connect", endpoint, "--session", "lab")
            rows = {line.split()[1]: line for line in shown.stdout.splitlines()[1:]}
            assert all(service.poll() is None for service in services.values())
        assert rows["tracking"].startswith("lab ")
        stopped = call("stop", "--connect", endpoint, "--session", "lab")
        assert stopped.returncode == 0, stopped.stderr
        assert {name: service.wait(60) for name, service in services.items()} == dict.fromkeys(
            services, 0
        )
    info = call("info", str(tmp_path / "recording.mcap"))
    assert info.returncode == 0, info.stderr


def test_an_empty_router_has_no_services_and_no_session(endpoint: str) -> None:
    shown = call("status", "--connect", endpoint, "--seconds", "1.5")
    assert (shown.returncode, "no services" in shown.stderr) == (1, True)
    stopped = call("stop", "--connect", endpoint, "--session", "none")
    assert (stopped.returncode, "no session none" in stopped.stderr) == (1, True)
