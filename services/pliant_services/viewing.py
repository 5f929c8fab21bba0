"""Behind ``pliant view``: a running session or a recording, drawn by Rerun."""

import json
import os
import sys
import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import zenoh

from pliant.bus.session import Identity, open_session
from pliant.errors import MessageError, ResultError
from pliant.messages import codec, topics
from pliant.messages.topics import Topic, by_key
from pliant.messages.types import MapUpdate, StreamEnd
from pliant.recording import parts
from pliant.recording.reader import Recording
from pliant.viewers.rerun import RerunCanvas, Where
from pliant.viewers.scene import Scene
from pliant_services.export_models import MESH_NAME, camera_of, draw
from pliant_services.results import RECORDING_NAME

SESSION_NAME = "session.json"
"""In the result folder while a run goes on: how to reach it."""
_ENVELOPE_BYTES = 9
_WAITING = 512  # messages between the network and the drawing; the oldest give way
_GONE_S = 1.0


@dataclass(frozen=True, kw_only=True)
class ViewRequest:
    """What is to be seen, and where."""

    source: Path | None
    endpoints: list[str]
    session: str
    identity: Identity | None = None
    web: bool = False
    save: Path | None = None
    force: bool = False
    web_port: int = 9090
    patience_s: float = 0.0


def run_view(request: ViewRequest) -> None:
    """Show it.  Raises PliantError."""
    where = _where(request)
    endpoints, session = request.endpoints, request.session
    if not endpoints and request.source is not None and request.source.is_dir():
        endpoints, session = running_session(request.source)
    if not endpoints and request.source is None:
        raise ResultError("nothing to view: give a result, a recording, or --connect and --session")
    if endpoints and not session:
        raise ResultError("--connect needs --session: `pliant status` lists what runs there")
    recording = None if endpoints else _recording(request.source)
    name = session or (request.source.stem if request.source else "pliant")
    canvas = RerunCanvas(where, name=name, web_port=request.web_port)
    if canvas.address:
        print(f"open {canvas.address} in a browser", flush=True)
    try:
        if endpoints:
            follow(endpoints, session, canvas, request.patience_s, request.identity)
        elif recording is not None and request.source is not None:
            draw(recording, canvas, request.source / MESH_NAME)
    finally:
        canvas.close()
    if request.save is not None:
        print(request.save)
    if request.web:
        _stay()


def running_session(result: Path) -> tuple[list[str], str]:
    """The endpoint and name of the run that is writing this result; ([], "") if none is."""
    try:
        content = json.loads((result / SESSION_NAME).read_text(encoding="utf-8"))
        return [str(content["endpoint"])], str(content["session"])
    except (OSError, ValueError, KeyError, TypeError):
        return [], ""


def follow(
    endpoints: list[str],
    session: str,
    canvas: RerunCanvas,
    patience_s: float = 0.0,
    identity: Identity | None = None,
) -> None:
    """Draw a running session until it ends.  Never asks it to wait.

    patience_s: for a session that is about to start.     identity: for tls/ endpoints.

    Raises BusError where nothing listens, ResultError where the session does not run.
    """
    prefix = f"pliant/{session}/view/"
    waiting: deque[tuple[Topic, int, bytes]] = deque(maxlen=_WAITING)

    def on_sample(sample: zenoh.Sample) -> None:
        envelope = sample.attachment.to_bytes() if sample.attachment is not None else b""
        topic = by_key(str(sample.key_expr).removeprefix(prefix))
        if (
            topic is None
            or len(envelope) != _ENVELOPE_BYTES
            or len(sample.payload) > topic.max_bytes
        ):
            return
        kind = topics.STREAM_END if envelope[-1] else topic
        waiting.append((kind, int.from_bytes(envelope[:8], "little"), sample.payload.to_bytes()))

    with open_session(endpoints, identity) as connection:
        held: list[Any] = [
            connection.declare_subscriber(f"{prefix}**", on_sample),
            connection.liveliness().declare_token(f"pliant/{session}/viewer/{os.getpid()}"),
        ]
        deadline = time.monotonic() + patience_s
        while not _runs(connection, session):
            if time.monotonic() > deadline:
                raise ResultError("no such session runs there: `pliant status` lists what does")
            time.sleep(0.1)
        _draw_while(canvas, waiting, lambda: _runs(connection, session))
        held.clear()


def _draw_while(
    canvas: RerunCanvas, waiting: deque[tuple[Topic, int, bytes]], runs: Callable[[], bool]
) -> None:
    scene = Scene(canvas)
    asked = time.monotonic()
    over = False
    while not over:
        if not waiting:
            if time.monotonic() - asked > _GONE_S:
                asked, over = time.monotonic(), not runs()
            time.sleep(0.005)
            continue
        topic, sequence, data = waiting.popleft()
        behind = len(waiting) > _WAITING // 8
        if behind and topic in (topics.SOURCE, topics.EXTREMA):
            continue  # newest wins; updates of the map are kept while there is room
        try:
            message = codec.decode(topic.message, data, max_bytes=topic.max_bytes)
        except MessageError:
            continue
        if isinstance(message, StreamEnd):
            over = message.topic == topics.MAP_FINAL.key
        else:
            scene.take(topic, message, sequence)
            over = isinstance(message, MapUpdate) and topic == topics.MAP_FINAL
    scene.close()
    if scene.missed_updates:
        print(
            f"{scene.missed_updates} updates of the map did not reach the viewer", file=sys.stderr
        )


def _runs(connection: zenoh.Session, session: str) -> bool:
    return any(True for _ in connection.liveliness().get(f"pliant/{session}/ready/**"))


def _recording(source: Path | None) -> Recording | None:
    """The recording of a result folder, or the file itself; looked for before a file is made."""
    if source is None:
        return None
    result = source.is_dir() and parts.exists(source / RECORDING_NAME)
    recording = Recording(source / RECORDING_NAME if result else source)
    camera_of(recording)
    return recording


def _where(request: ViewRequest) -> Where:
    if request.web and request.save is not None:
        raise ResultError("--web and --save contradict each other: give one")
    if request.save is not None:
        if request.save.exists() and not request.force:
            raise ResultError(f"{request.save} exists: choose another --save, or --force")
        return request.save
    if request.web:
        return "web"
    if (
        not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))
        and sys.platform == "linux"
    ):
        raise ResultError("there is no display here: use --web, or --save FILE.rrd")
    return "window"


def _stay() -> None:
    """A browser may come, or look on, until Ctrl-C."""
    while True:
        time.sleep(3600.0)
