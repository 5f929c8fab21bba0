"""A recording on the bus: who reads it sees the run that was recorded."""

import os
import pty
import termios
import threading
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pliant.bus.replay_bus import ReplayBus
from pliant.bus.zenoh_bus import ZenohBus
from pliant.config import Config
from pliant.datasets import open_source
from pliant.errors import RecordingError
from pliant.messages import codec, topics
from pliant.messages.types import Image
from pliant.recording.playback import Playback
from pliant_services.nodes import ingest, recorder
from pliant_services.replay import play as play_command
from pliant_services.replay import player as player_module
from pliant_services.replay.play import Pace, PlayRequest, run_play, take_keys
from pliant_services.replay.player import Played, chosen_topics, play
from pliant_services.runtime.monitor import SilentMonitor

FRAMES = 8
PATIENCE_S = 60.0


@pytest.fixture(scope="module")
def ingested() -> ReplayBus:
    bus = ReplayBus({})
    dataset = open_source(f"built-in:tiny?frames={FRAMES}")
    ingest.run(bus, Config(), SilentMonitor(), dataset, stopping=lambda: False)
    return bus


@pytest.fixture(scope="module")
def path(ingested: ReplayBus, tmp_path_factory: pytest.TempPathFactory) -> Path:
    file = tmp_path_factory.mktemp("played") / "recording.mcap"
    logged = {t: m for t, m in ingested.outputs.items() if t.logged}
    recorder.run(ReplayBus(logged), Config(), file, {"config": {"yaml": ""}})
    return file


def tracking_bus(endpoint: str) -> ZenohBus:
    return ZenohBus(
        endpoints=[endpoint],
        session="replay",
        service="tracking",
        inputs={topics.STREAM: "ingest", topics.IMAGE: "ingest"},
        outputs={},
        window=4,
    )


def test_a_service_reads_the_images_that_were_sent_in_the_run(
    endpoint: str, path: Path, ingested: ReplayBus
) -> None:
    request = PlayRequest(recording=path, rate=0.0, readers=["tracking"], connect=[endpoint])
    player = threading.Thread(target=run_play, args=[request])
    player.start()  # before its reader: it waits
    with tracking_bus(endpoint) as bus:
        streams = [codec.encode(m) for m in bus.receive(topics.STREAM)]
        images = [codec.encode(m) for m in bus.receive(topics.IMAGE)]
    player.join(PATIENCE_S)
    assert streams == [codec.encode(m) for m in ingested.outputs[topics.STREAM]]
    assert images == [codec.encode(m) for m in ingested.outputs[topics.IMAGE]]


def test_playing_begins_and_ends_as_requested(endpoint: str, path: Path) -> None:
    playback = Playback(path)
    times: list[int] = []

    def wait_until(stamp_ns: int) -> bool:
        times.append(stamp_ns)
        return len(times) < 4

    what = Played(start_s=0.06, readers={topics.IMAGE: ["tracking"]})
    done: list[int] = []

    def run() -> None:
        done.append(
            play(
                playback, what, endpoints=[endpoint], session="replay",
                window=4, windows={}, wait_until=wait_until,
            )
        )  # fmt: skip

    player = threading.Thread(target=run)
    player.start()
    with tracking_bus(endpoint) as bus:
        images = list(bus.receive(topics.IMAGE))
    player.join(PATIENCE_S)
    assert [type(image) for image in images] == [Image] * 3
    assert [image.frame for image in images] == [2, 3, 4]
    assert all(np.diff(times) > 0)
    assert 0 <= times[0] < 40_000_000
    assert done == [1 + 3 + 3]


def test_topics_are_chosen_by_key(path: Path) -> None:
    playback = Playback(path)
    assert [t.key for t in chosen_topics(playback, Played(readers={}))] == [
        "camera/depth",
        "camera/image",
        "camera/source",
        "camera/stream",
    ]
    some = Played(readers={}, topics=["camera/stream"])
    assert chosen_topics(playback, some) == [topics.STREAM]
    with pytest.raises(RecordingError, match="choose from camera/depth"):
        chosen_topics(playback, Played(readers={}, topics=["nothing"]))


def test_a_pause_stops_time_and_q_ends() -> None:
    pace = Pace(1.0)
    assert pace.wait_until(0)
    take_keys(pace, " ")
    results: list[bool] = []
    waiter = threading.Thread(target=lambda: results.append(pace.wait_until(1_000_000)))
    waiter.start()
    waiter.join(0.1)
    assert waiter.is_alive()  # long due, and paused
    take_keys(pace, " ")
    waiter.join(PATIENCE_S)
    assert results == [True]
    take_keys(pace, "xq")
    assert not pace.wait_until(0)


def test_ctrl_c_at_the_very_start_leaves_the_terminal_as_it_was(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def interrupt(line: str) -> None:
        raise KeyboardInterrupt

    terminal, inside = pty.openpty()
    before = termios.tcgetattr(inside)
    with os.fdopen(terminal), os.fdopen(inside) as stdin:
        monkeypatch.setattr("sys.stdin", stdin)
        monkeypatch.setattr(play_command, "_say", interrupt)
        with pytest.raises(KeyboardInterrupt), play_command._keys(Pace(1.0)):
            pass
        assert termios.tcgetattr(inside) == before


def test_a_rate_is_a_share_of_the_pace_of_capture(monkeypatch: pytest.MonkeyPatch) -> None:
    class Clock(threading.Condition):
        now_s = 0.0

        def monotonic(self) -> float:
            return self.now_s

        def wait(self, timeout: float | None = None) -> bool:
            assert timeout is not None
            self.now_s += timeout
            return False

    clock = Clock()
    monkeypatch.setattr(play_command, "time", clock)
    pace = Pace(4.0)
    pace._changed = clock
    assert pace.wait_until(200_000_000)
    assert clock.now_s == 0.05
    assert pace.wait_until(100_000_000)  # late: no wait
    assert clock.now_s == 0.05
    unbounded = Pace(0.0)
    assert unbounded.wait_until(10**18)


def test_a_loop_stays_in_one_session_without_an_end(
    endpoint: str, path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """A session that is closed leaves some memory behind, and a compose profile loops for ever."""

    class Thrice(Pace):
        loops = 0

        def restart(self) -> None:
            super().restart()
            self.loops += 1
            if self.loops == 4:
                self.stop()

    opened: list[str] = []

    class Counted(ZenohBus):
        def __init__(self, *, service: str, **options: Any) -> None:
            opened.append(service)
            super().__init__(service=service, **options)

    monkeypatch.setattr(play_command, "Pace", Thrice)
    monkeypatch.setattr(player_module, "ZenohBus", Counted)
    request = PlayRequest(recording=path, rate=0.0, loop=True, connect=[endpoint])
    assert run_play(request) == 0
    assert opened == ["ingest"]
    said = capsys.readouterr().err.splitlines()
    assert [line for line in said if "played" in line] == [f"{1 + 3 * FRAMES} messages played"] * 3
    with pytest.raises(RecordingError, match="--loop is for viewers"):
        run_play(PlayRequest(recording=path, loop=True, readers=["tracking"]))


def test_an_end_before_the_start_is_one_line(path: Path) -> None:
    with pytest.raises(RecordingError, match=r"--end 0.5 is not after --start 1"):
        run_play(PlayRequest(recording=path, start_s=1.0, end_s=0.5))


def test_an_unknown_reader_is_one_line(path: Path) -> None:
    with pytest.raises(RecordingError, match="choose from bundle_adjustment"):
        run_play(PlayRequest(recording=path, readers=["nobody"]))
