"""Behind ``pliant view``: a running session or a recording, drawn by Rerun."""

import os
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import zenoh

from pliant.bus.links import received
from pliant.bus.peers import misfit
from pliant.bus.session import Identity, open_session, session_name
from pliant.errors import BusError, MessageError, PliantError, ResultError
from pliant.export.images import camera_of
from pliant.export.models import MESH_NAME, draw
from pliant.messages import codec, topics
from pliant.messages.topics import Topic, by_key
from pliant.recording import parts
from pliant.recording.reader import Recording
from pliant.results.folder import RECORDING_NAME, files_read, keep_apart
from pliant.staging import put_tree_in_place, staging
from pliant.viewers.canvas import Canvas
from pliant.viewers.drawn_scene import Scene
from pliant.viewers.rerun import RerunCanvas, Where
from pliant_services.runtime.announced import running_session

_WAITING = 512  # messages between the network and the drawing; beyond, the oldest are dropped
_WAITING_BYTES = 256 << 20
_ASK_S = 0.5
_GONE_S = 0.2  # what is on the way when the last service has gone


class WatchedCanvas(Canvas, Protocol):
    """A canvas whose viewer may be closed."""

    @property
    def is_watched(self) -> bool:
        """Whether anything is left to draw."""
        ...


@dataclass(frozen=True, kw_only=True)
class ViewRequest:
    """The data to view, and the viewer."""

    source: Path | None
    endpoints: list[str]
    session: str
    identity: Identity | None = None
    web: bool = False
    save: Path | None = None
    force: bool = False
    web_port: int | None = None
    patience_s: float = 0.0
    open3d: bool = False


def run_view(request: ViewRequest) -> None:
    """Show it.  Raises PliantError."""
    if request.open3d:
        _show_in_open3d(request)
        return
    where = place(web=request.web, save=request.save, force=request.force)
    if not isinstance(where, Path):
        _show(request, where)
        return
    if request.source is not None:
        keep_apart(where, files_read(request.source), option="--save")
    try:
        with staging(where.parent) as partial:
            made = partial / where.name
            try:
                _show(request, made)
            except PliantError:  # nothing came to be seen
                raise
            except BaseException:  # of an interruption: what came so far
                if made.exists():
                    put_tree_in_place(made, where)
                raise
            put_tree_in_place(made, where)
    except OSError as error:
        raise ResultError(f"{where}: cannot be written ({error.strerror})") from None
    print(where)


def _show_in_open3d(request: ViewRequest) -> None:
    """A result that is over.  Raises PliantError."""
    if request.web or request.save is not None or request.endpoints:
        raise ResultError(
            "--open3d shows a result in a window: leave out --web, --save and --connect"
        )
    if request.source is None:
        raise ResultError("nothing to view: pass a result or a recording")
    if request.source.is_dir() and running_session(request.source)[0]:
        raise ResultError(
            f"{request.source}: the run is still active; --open3d shows only finished results"
        )
    check_display("--web or --save FILE.rrd of Rerun")
    from pliant.api.result import Result
    from pliant_services.view.open3d_window import show

    show(Result(request.source))


def _show(request: ViewRequest, where: Where) -> None:
    """Draw it there.  Raises PliantError."""
    endpoints, session = request.endpoints, request.session
    if not endpoints and request.source is not None and request.source.is_dir():
        endpoints, session = running_session(request.source)
    if not endpoints and request.source is None:
        raise ResultError("nothing to view: pass a result, a recording, or --connect and --session")
    if endpoints and not session:
        raise ResultError("--connect needs --session: `pliant status` lists the sessions")
    recording = None if endpoints else _recording(request.source)
    name = session or (request.source.stem if request.source else "pliant")
    canvas = RerunCanvas(where, name=name, web_port=request.web_port)
    try:
        if canvas.address:
            print(f"open {canvas.address} in a browser", flush=True)
        if endpoints:
            follow(endpoints, session, canvas, request.patience_s, request.identity)
        elif recording is not None and request.source is not None:
            draw(recording, canvas, request.source / MESH_NAME)
        if request.web:
            canvas.send()
            _stay()
    finally:
        if not canvas.is_watched:
            print("the Rerun window was closed, or could not open", file=sys.stderr)
        canvas.close()


def follow(
    endpoints: list[str],
    session: str,
    canvas: WatchedCanvas,
    patience_s: float = 0.0,
    identity: Identity | None = None,
) -> None:
    """Draw a running session until it ends.  The session never waits for it.

    patience_s: for a session that is about to start.     identity: for tls/ endpoints.

    Raises BusError if nothing listens or what runs is of another version, ResultError if the
    session does not run.
    """
    prefix = f"pliant/{session_name(session)}/view/"
    waiting = Backlog(_WAITING, _WAITING_BYTES)

    def on_sample(sample: zenoh.Sample) -> None:
        topic = by_key(str(sample.key_expr).removeprefix(prefix))
        heard = None if topic is None else received(topic, sample)
        if heard is not None and not heard.is_end:
            waiting.put(Arrived(heard.topic, heard.sequence, time.monotonic_ns(), heard.data))

    with open_session(endpoints, identity) as connection:
        held: list[Any] = [
            connection.declare_subscriber(f"{prefix}**", on_sample),
            connection.liveliness().declare_token(f"pliant/{session}/viewer/{os.getpid()}"),
        ]
        deadline = time.monotonic() + patience_s
        while not _runs(connection, session):
            if time.monotonic() > deadline:
                check_versions(_tokens(connection, session))
                raise ResultError("no such session: `pliant status` lists the sessions")
            time.sleep(0.1)
        _draw_while(canvas, waiting, lambda: canvas.is_watched and _runs(connection, session))
        held.clear()


@dataclass(frozen=True)
class Arrived:
    """A message as it came, and when."""

    topic: Topic
    sequence: int
    arrived_ns: int
    data: bytes


class Backlog:
    """Messages that are not drawn yet, bounded in number and size: the oldest are dropped."""

    def __init__(self, most: int, most_bytes: int) -> None:
        self._most, self._most_bytes = most, most_bytes
        self._items: deque[Arrived] = deque()
        self._bytes = 0
        self._lock = threading.Lock()

    def __len__(self) -> int:
        return len(self._items)

    def put(self, item: Arrived) -> None:
        """Add the newest."""
        with self._lock:
            self._items.append(item)
            self._bytes += len(item.data)
            while len(self._items) > self._most or (
                self._bytes > self._most_bytes and len(self._items) > 1
            ):
                self._bytes -= len(self._items.popleft().data)

    def take(self) -> Arrived | None:
        """The oldest, None if there is nothing."""
        with self._lock:
            if not self._items:
                return None
            item = self._items.popleft()
            self._bytes -= len(item.data)
            return item


def _draw_while(canvas: Canvas, waiting: Backlog, goes_on: Callable[[], bool]) -> None:
    """Draw until nothing more comes and all is drawn: the final mesh comes last of all.

    goes_on: whether a service still runs, and a viewer is open.
    """
    scene = Scene(canvas)
    looked_at, is_over = time.monotonic(), False
    while True:
        if not is_over and time.monotonic() - looked_at > _ASK_S:
            is_over, looked_at = not goes_on(), time.monotonic()
        arrived = waiting.take()
        if arrived is None:
            if is_over and time.monotonic() - looked_at > _GONE_S:
                break
            time.sleep(0.005)
            continue
        topic = arrived.topic
        behind = len(waiting) > _WAITING // 8
        if behind and topic in (topics.SOURCE, topics.EXTREMA, topics.SURFELS):
            continue  # newest wins; updates of the map and mesh are kept while there is room
        try:
            message = codec.decode(topic.message, arrived.data, max_bytes=topic.max_bytes)
        except MessageError:
            continue
        scene.take(topic, message, arrived.sequence, arrived.arrived_ns)
    scene.close()
    if scene.missed_updates:
        print(
            f"{scene.missed_updates} updates of the map did not reach the viewer", file=sys.stderr
        )


def _tokens(connection: zenoh.Session, session: str) -> list[str]:
    """Liveliness tokens of all services present, also of other versions."""
    replies = connection.liveliness().get(f"pliant/{session}/ready/**")
    return [str(reply.ok.key_expr) for reply in replies if reply.ok is not None]


def _runs(connection: zenoh.Session, session: str) -> bool:
    """Whether a service is there that speaks as we do."""
    return any(not misfit(token, "") for token in _tokens(connection, session))


def check_versions(tokens: Iterable[str]) -> None:
    """Raise BusError if a service is of another version: its messages would not be read."""
    for words in filter(None, (misfit(token, "this viewer") for token in tokens)):
        raise BusError(f"{words}: use the same release for the viewer")


def _recording(source: Path | None) -> Recording | None:
    """The recording of a result folder, or the file itself; looked for before a file is made."""
    if source is None:
        return None
    result = source.is_dir() and parts.exists(source / RECORDING_NAME)
    recording = Recording(source / RECORDING_NAME if result else source)
    camera_of(recording)
    return recording


def place(*, web: bool, save: Path | None, force: bool) -> Where:
    """Where a view goes.  Raises ResultError if it cannot."""
    if web and save is not None:
        raise ResultError("--web and --save exclude each other: pass only one")
    if save is not None:
        if save.exists() and not force:
            raise ResultError(f"{save} exists: choose another --save, or --force")
        return save
    if web:
        return "web"
    check_display("--web, or --save FILE.rrd")
    return "window"


def check_display(instead: str) -> None:
    """Raise ResultError if no window can be seen."""
    has_one = os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")
    if sys.platform == "linux" and not has_one:
        raise ResultError(f"there is no display here: use {instead}")


def _stay() -> None:
    """A browser may come, or look on, until Ctrl-C."""
    while True:
        time.sleep(3600.0)
