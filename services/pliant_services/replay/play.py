"""Behind ``pliant replay`` without services: the recording on the bus, at its own pace."""

import select
import sys
import termios
import threading
import time
import tty
from collections.abc import Generator, Iterable, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path

from pliant.bus.session import Identity, free_endpoint, open_router, session_name
from pliant.config import recorded_config
from pliant.errors import RecordingError
from pliant.messages.topics import Topic
from pliant.recording.playback import Playback
from pliant.recording.reader import Recording
from pliant.wording import counted
from pliant_services.processes import BY_NAME, inputs_of, outputs_of
from pliant_services.replay.player import Played, chosen_topics, play, senders
from pliant_services.runtime.host import observer_windows

_KEYS_S = 0.1


@dataclass(frozen=True, kw_only=True)
class PlayRequest:
    """Options of a playback.  rate: multiple of the capture speed, 0 for as fast as possible."""

    recording: Path
    rate: float = 1.0
    start_s: float = 0.0
    end_s: float | None = None
    topics: Sequence[str] = ()
    readers: Sequence[str] = ()
    loop: bool = False
    connect: Sequence[str] = ()
    tls: Path | None = None
    session: str = "replay"
    port: int | None = None


def run_play(request: PlayRequest) -> int:
    """Play until the end or the key for it; returns the exit code.  Raises PliantError."""
    session_name(request.session)
    playback = Playback(request.recording)
    config = recorded_config(Recording(request.recording).metadata(), [])
    required, left_out = _required(playback, request.readers)
    if request.end_s is not None and request.end_s <= request.start_s:
        raise RecordingError(f"--end {request.end_s:g} is not after --start {request.start_s:g}")
    if request.loop and request.readers:
        raise RecordingError("--loop is for viewers: leave it out, or --readers")
    what = Played(
        start_s=request.start_s,
        end_s=request.end_s,
        # Services join topics by frame; viewers need the map.
        lead_frames=0 if request.readers else config.bundle_adjustment.snapshot_frames,
        topics=request.topics,
        readers=required,
        left_out=left_out,
    )
    chosen_topics(playback, what)
    fleet = [*sorted(set(senders(playback.topics).values()) & BY_NAME.keys()), *request.readers]
    with ExitStack() as stack:
        endpoints = list(request.connect)
        if not endpoints:
            endpoint = f"tcp/127.0.0.1:{request.port}" if request.port else free_endpoint()
            router = open_router(endpoint)
            stack.callback(router.close)
            endpoints = [endpoint]
        _say(f"playing on {endpoints[0]}, session {request.session}")
        pace = stack.enter_context(_keys(Pace(request.rate)))

        def again(count: int) -> bool:
            _say(f"{counted(count, 'message')} played")
            pace.restart()
            return not pace.stopped

        pace.restart()
        count = play(
            playback,
            what,
            endpoints=endpoints,
            session=request.session,
            identity=lambda name: _identity(request.tls, name),
            window=config.bus.window,
            windows=observer_windows(config, fleet),
            wait_until=pace.wait_until,
            again=again if request.loop else None,
        )
        if not request.loop:
            _say(f"{counted(count, 'message')} played")
        return 0


def _identity(tls: Path | None, name: str) -> Identity | None:
    return Identity.in_folder(tls, name) if tls is not None else None


def _required(
    playback: Playback, readers: Sequence[str]
) -> tuple[dict[Topic, list[str]], set[Topic]]:
    """The readers of each topic, and the topics that readers publish themselves, so not played."""
    able = sorted(name for name, process in BY_NAME.items() if process.inputs or process.observer)
    wrong = [name for name in readers if name not in able]
    if wrong:
        raise RecordingError(f"--readers {','.join(wrong)}: choose from {', '.join(able)}")
    own: set[Topic] = set()
    for name in readers:
        own |= set(outputs_of(name))
    fleet = [*dict.fromkeys([*senders(playback.topics).values(), *readers])]
    fleet = [name for name in fleet if name in BY_NAME]
    required: dict[Topic, list[str]] = {}
    for name in readers:
        for topic in inputs_of(name, fleet):
            required.setdefault(topic, []).append(name)
    return required, own


class Pace:
    """When a message is due: at a rate, with pauses."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._changed = threading.Condition()
        self._paused = self.stopped = False
        self._start_s = self._paused_at_s = time.monotonic()

    def restart(self) -> None:
        """Time begins now."""
        with self._changed:
            self._start_s = self._paused_at_s = time.monotonic()

    def wait_until(self, stamp_ns: int) -> bool:
        """Return when a message is due that many nanoseconds after the start; False to stop."""
        with self._changed:
            while not self.stopped:
                left_s = 0.0
                if self._rate > 0.0:
                    left_s = self._start_s + stamp_ns * 1e-9 / self._rate - time.monotonic()
                if self._paused:
                    self._changed.wait()
                elif left_s <= 0.0:
                    return True
                else:
                    self._changed.wait(left_s)
            return False

    def toggle(self) -> bool:
        """Pause or continue; whether it is paused now."""
        with self._changed:
            now = time.monotonic()
            if self._paused:
                self._start_s += now - self._paused_at_s
            self._paused, self._paused_at_s = not self._paused, now
            self._changed.notify_all()
            return self._paused

    def stop(self) -> None:
        """End playing before the next frame."""
        with self._changed:
            self.stopped = True
            self._changed.notify_all()


@contextmanager
def _keys(pace: Pace) -> Generator[Pace]:
    """On a terminal the space bar pauses and q ends; Ctrl-C ends anywhere."""
    if not sys.stdin.isatty():
        yield pace
        return
    descriptor = sys.stdin.fileno()
    before = termios.tcgetattr(descriptor)
    over = threading.Event()

    def watch() -> None:
        while not over.is_set():
            if select.select([sys.stdin], [], [], _KEYS_S)[0]:
                take_keys(pace, sys.stdin.read(1))

    watcher = threading.Thread(target=watch, daemon=True)
    watcher.start()
    try:
        tty.setcbreak(descriptor)
        _say("space pauses, q ends")
        yield pace
    finally:
        over.set()
        watcher.join()
        termios.tcsetattr(descriptor, termios.TCSADRAIN, before)


def take_keys(pace: Pace, keys: Iterable[str]) -> None:
    """The functions of the keys."""
    for key in keys:
        if key == " ":
            _say("paused" if pace.toggle() else "going on")
        elif key in "qQ":
            pace.stop()


def _say(line: str) -> None:
    print(line, file=sys.stderr, flush=True)
