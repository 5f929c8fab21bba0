"""How a session without a launcher ends."""

import threading
from pathlib import Path
from typing import Any

import pytest

from pliant.bus.peers import OVER_KEY, STOP_KEY, token_key
from pliant.bus.session import free_endpoint, open_router, open_session
from pliant.config import load_config
from pliant.exit_codes import DONE
from pliant_services.runtime import session_end
from pliant_services.runtime import status as fleet_status
from pliant_services.runtime.host import ServiceOptions


class Told:
    """A connection, and whether anything has been sent by it."""

    def __init__(self, connection: Any, sent: threading.Event) -> None:
        self._connection = connection
        self._sent = sent
        self.info = connection.info
        self.liveliness = connection.liveliness

    def put(self, key: str, data: bytes) -> None:
        self._connection.put(key, data)
        self._sent.set()

    def __enter__(self) -> "Told":
        return self

    def __exit__(self, *_: object) -> None:
        self._connection.close()


def test_a_router_that_does_not_yet_listen_to_all_hears_that_the_session_is_over(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    sent, heard = threading.Event(), threading.Event()
    monkeypatch.setattr(
        session_end, "open_session", lambda *arguments: Told(open_session(*arguments), sent)
    )
    state = tmp_path / "state"
    (state / "recorder").mkdir(parents=True)
    recording = tmp_path / "recording.mcap"
    recording.touch()  # in one piece: the recorder has done everything
    endpoint = free_endpoint()
    options = ServiceOptions(
        endpoints=[endpoint],
        session="lab",
        fleet=("recorder",),
        arguments={"output": recording},
        state=state,
    )
    router = open_router(endpoint)
    codes: list[int] = []
    recorder = threading.Thread(
        target=lambda: codes.append(
            session_end.run_alone("recorder", load_config(), options, results=True)
        )
    )
    recorder.start()
    assert sent.wait(30)
    held = router.declare_subscriber(f"pliant/*/{OVER_KEY}", lambda _: heard.set())
    assert heard.wait(30)
    held.undeclare()
    router.close()
    recorder.join()
    assert codes == [DONE]


def test_a_source_that_is_still_coming_up_hears_that_it_is_to_stop(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sent, heard = threading.Event(), threading.Event()
    monkeypatch.setattr(
        fleet_status, "open_session", lambda *arguments: Told(open_session(*arguments), sent)
    )
    endpoint = free_endpoint()
    router = open_router(endpoint)
    token = router.liveliness().declare_token(f"pliant/lab/{token_key('tracking', 1)}")
    left: list[list[str]] = []
    stop = threading.Thread(
        target=lambda: left.append(fleet_status.stop_session([endpoint], "lab", 30.0))
    )
    stop.start()
    assert sent.wait(30)
    held = router.declare_subscriber(f"pliant/lab/{STOP_KEY}", lambda _: heard.set())
    assert heard.wait(30)
    token.undeclare()
    stop.join()
    held.undeclare()
    router.close()
    assert left == [[]]
