"""Names of sessions are checked where they enter, and a session keeps its first recorder."""

from collections.abc import Callable
from contextlib import closing

import pytest
from zenoh_buses import die

from pliant.bus import zenoh_bus
from pliant.bus.session import free_endpoint, open_router
from pliant.bus.zenoh_bus import ZenohBus
from pliant.errors import BusError
from pliant_services.runtime.status import listen, stop_session

NAMES = ["**", "a/b", "../../x", "@x", "a\nb", "", "a#b", "$*", "/x", "x" * 65, "-x", "*"]


def recorder(
    endpoint: str, on_fault: Callable[[str], None] = lambda line: None, session: str = "s"
) -> ZenohBus:
    return ZenohBus(
        endpoints=[endpoint],
        session=session,
        service="recorder",
        inputs={},
        outputs={},
        window=1,
        stays=True,
        on_fault=on_fault,
    )


@pytest.mark.parametrize("name", NAMES)
def test_a_name_that_can_be_no_sessions_is_one_line(name: str) -> None:
    with pytest.raises(BusError, match="--session") as said:
        recorder("tcp/127.0.0.1:1", session=name)
    assert len(str(said.value).splitlines()) == 1
    with pytest.raises(BusError, match="--session"):
        stop_session(["tcp/127.0.0.1:1"], name, 0.0)
    if name != "*":  # all of them
        with pytest.raises(BusError, match="--session"):
            listen(["tcp/127.0.0.1:1"], name, 0.0)


def test_the_first_recorder_of_a_session_stays(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(zenoh_bus, "TOKEN_LEASE_S", 0.0)
    endpoint, said = free_endpoint(), list[str]()
    with closing(open_router(endpoint)), recorder(endpoint) as first:
        with pytest.raises(BusError, match="session s already has a recorder: choose"):
            recorder(endpoint, said.append)
        with recorder(endpoint, said.append, session="other"):
            pass
        first._peers.raise_if_refused()
    assert said == ["recorder: session s already has a recorder: waiting until it ends"]


def test_a_recorder_begins_once_the_one_that_died_is_gone() -> None:
    endpoint, died = free_endpoint(), list[str]()
    with closing(open_router(endpoint)):
        first = recorder(endpoint)

        def on_fault(line: str) -> None:
            die(first)
            died.append(line)

        with recorder(endpoint, on_fault):
            assert died
