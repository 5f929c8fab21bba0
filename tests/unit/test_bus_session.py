"""Where the services of a run meet: a socket of its user, or a port."""

import subprocess
import sys
import tempfile
import threading
from contextlib import ExitStack
from pathlib import Path

import pytest

from pliant.bus import session
from pliant.bus.session import LocalRouter, free_endpoint, open_router, open_session
from pliant.errors import BusError


def meets(local: LocalRouter) -> bool:
    """Whether two sessions meet at a router, which is closed then."""
    came = threading.Event()
    with open_session([local.endpoint]) as first, open_session([local.endpoint]) as second:
        held = first.declare_subscriber("x", lambda _: came.set())
        while not came.wait(0.05):  # until the router knows of the subscriber
            second.put("x", b"")
        held.undeclare()
    local.close()
    return came.is_set()


def test_a_run_of_one_machine_meets_at_a_socket_of_its_user(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    local = LocalRouter()
    (folder,) = tmp_path.iterdir()
    assert local.endpoint == f"unixsock-stream/{folder}/bus"
    assert folder.stat().st_mode & 0o777 == 0o700
    assert not local.note
    assert meets(local)
    assert not list(tmp_path.iterdir())


_ROUTER = """
import sys, tempfile
tempfile.tempdir = sys.argv[1]
from pliant.bus.session import LocalRouter
local = LocalRouter()
print(local.endpoint, flush=True)
sys.stdin.read()
"""


def test_what_routers_that_were_killed_have_left_goes(tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    (tmp_path / "pliant-results").mkdir()
    (tmp_path / "pliant-results" / "bus").touch()
    folders: list[Path] = []
    with ExitStack() as running:
        for _ in range(2):
            process = running.enter_context(
                subprocess.Popen(
                    [sys.executable, "-c", _ROUTER, str(tmp_path)],
                    stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True,
                )
            )  # fmt: skip
            running.callback(process.kill)
            assert process.stdout is not None
            endpoint = process.stdout.readline().strip()
            folders.append(Path(endpoint.partition("/")[2]).parent)
            if len(folders) == 1:
                process.kill()
                process.wait()
        assert [folder.exists() for folder in folders] == [False, True]
        local = LocalRouter()
        assert folders[1].exists()
        assert meets(local)
    assert (tmp_path / "pliant-results" / "bus").exists()


@pytest.mark.parametrize("why", ["too long", "No such file", "is the port in use"])
def test_without_a_socket_a_run_uses_loopback_with_a_note(why: str, tmp_path, monkeypatch) -> None:
    folder = tmp_path / ("x" * (100 if why == "too long" else 1))
    if why != "No such file":
        folder.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(folder))
    if why == "is the port in use":  # no link of that kind in this Zenoh
        monkeypatch.setattr(session, "_SOCKET", "nosuchlink")
    local = LocalRouter()
    assert local.endpoint.startswith("tcp/127.0.0.1:")
    assert why in local.note
    assert "every user of this machine" in local.note
    assert meets(local)
    assert not folder.exists() or not list(folder.iterdir())


def test_a_port_is_a_port_of_loopback(endpoint: str) -> None:
    port = int(free_endpoint().rsplit(":", 1)[1])
    local = LocalRouter(port)
    assert local.endpoint == f"tcp/127.0.0.1:{port}"
    assert meets(local)
    with pytest.raises(BusError, match="in use"):
        LocalRouter(int(endpoint.rsplit(":", 1)[1]))


def test_a_port_in_use_is_one_line(endpoint: str) -> None:
    with pytest.raises(BusError, match="in use") as caught:
        open_router(endpoint)
    assert "\n" not in str(caught.value)
