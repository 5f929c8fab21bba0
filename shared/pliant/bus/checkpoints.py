"""Checkpoints of a service: its state and its position in every topic, from which it can restart.

A checkpoint is usable only if no reader can request a message from before it, because the service
will not make those again.  So several are kept, until an older one can never be needed: the newest
whose outputs every reader has safe.

Large records that never change are files of their own, which all checkpoints name: see
``state.Constants``.
"""

import hashlib
import io
import os
import threading
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgpack

from pliant.errors import BusError, StateError
from pliant.files import create, make_folder, put_in_place
from pliant.state import load_state, save_state
from pliant.wording import shown

_VERSION = 1


@dataclass(frozen=True)
class Place:
    """Messages taken of each input and sent of each output, by topic key; the outputs ended."""

    frame: int
    inputs: Mapping[str, int]
    outputs: Mapping[str, int]
    ended: tuple[str, ...] = ()

    def fits(self, safe: Mapping[str, int]) -> bool:
        """Whether all that was sent before is safe with every reader."""
        return all(sent <= safe.get(key, sent) for key, sent in self.outputs.items())


class Checkpoints:
    """The checkpoints of one service in a folder of the session.  Safe to use from two threads."""

    def __init__(self, folder: Path, *, interval: int) -> None:
        """``interval``: frames between two.  Raises BusError if the folder cannot be made."""
        self._folder = folder
        self._interval = interval
        self._lock = threading.Lock()
        self._writer: threading.Thread | None = None
        self._failure: OSError | None = None
        self._constants: dict[str, weakref.ref[Any]] = {}  # as long as the service needs them
        try:
            make_folder(folder)
            for unfinished in folder.glob("*.part"):
                unfinished.unlink()
        except OSError as error:
            raise BusError(
                f"{folder}: cannot create the checkpoint folder: {error.strerror}{_owner(folder)}"
            ) from None
        self._places = {
            place.frame: place for place in (_read_place(p) for p in folder.glob("*.state"))
        }

    def has_any(self) -> bool:
        """Whether there is one, from an earlier start."""
        with self._lock:
            return bool(self._places)

    def due(self, frame: int) -> bool:
        """Whether this frame closes an interval and the one before is on the disk."""
        busy = self._writer is not None and self._writer.is_alive()
        return (frame + 1) % self._interval == 0 and not busy

    def save(self, place: Place, state: bytes, written: Callable[[], None]) -> None:
        """Write in the background, whole or not at all; then call ``written``.

        Raises BusError if the one before could not be written.
        """
        if self._failure is not None:
            raise BusError(f"{self._folder}: cannot write checkpoints: {self._failure}")
        counts = [dict(place.inputs), dict(place.outputs)]
        header = [_VERSION, place.frame, *counts, list(place.ended)]
        parts = (msgpack.packb(header), state)

        def write() -> None:
            try:
                _write_whole(self._path(place.frame), parts)
            except OSError as error:
                self._failure = error
                return
            with self._lock:
                self._places[place.frame] = place
            written()

        self._writer = threading.Thread(target=write, daemon=True)
        self._writer.start()

    def usable(self, safe: Mapping[str, int]) -> Place | None:
        """The newest that fits what the readers have safe; older ones are dropped."""
        with self._lock:
            fitting = [frame for frame, place in self._places.items() if place.fits(safe)]
            if not fitting:
                return None
            newest = max(fitting)
            for frame in sorted(self._places):
                if frame < newest:
                    del self._places[frame]
                    with suppress(OSError):
                        self._path(frame).unlink()
            return self._places[newest]

    def restart_from(self, place: Place) -> bytes:
        """The state at a place; what was saved later will be made again.  Raises BusError."""
        with self._lock:
            for frame in [frame for frame in self._places if frame > place.frame]:
                del self._places[frame]
                with suppress(OSError):
                    self._path(frame).unlink()
        return _unpack(self._path(place.frame))[1]

    def keep(self, record: Any) -> str:
        """Store a record that never changes, the first time; returns its name.  Raises BusError."""
        for name, known in self._constants.items():
            if known() is record:
                return name
        data = save_state(record)
        name = hashlib.sha256(data).hexdigest()
        try:
            _write_whole(self._constant(name), (data,))
        except OSError as error:
            raise BusError(f"{self._folder}: cannot write checkpoints: {error}") from None
        self._constants[name] = weakref.ref(record)
        return name

    def kept(self, name: str) -> Any:
        """The record that a checkpoint names.  Raises BusError and StateError."""
        if not name.isalnum():
            raise StateError(f"{self._folder}: not a name of a record: {shown(name)}")
        path = self._constant(name)
        try:
            record = load_state(path.read_bytes())
        except OSError as error:
            raise BusError(f"{path}: cannot read the checkpoint: {error.strerror}") from None
        self._constants[name] = weakref.ref(record)
        return record

    def close(self) -> None:
        """Wait for the one that is being written."""
        if self._writer is not None:
            self._writer.join()

    def _constant(self, name: str) -> Path:
        return self._folder / f"{name}.constant"

    def _path(self, frame: int) -> Path:
        return self._folder / f"{frame:09d}.state"


def _owner(folder: Path) -> str:
    """Whose the folder is in which another one cannot be made, and what helps; "" if it is ours."""
    there = next(each for each in (folder, *folder.parents) if each.exists())
    uid, gid, own = there.stat().st_uid, there.stat().st_gid, os.getuid()
    if own in (0, uid):
        return ""
    return (
        f" ({there} belongs to user {uid}, this is user {own}): set PLIANT_USER={uid}:{gid} for "
        "containers, otherwise choose another --state"
    )


def _write_whole(path: Path, parts: tuple[Any, ...]) -> None:
    part = path.with_suffix(".part")
    with io.BufferedWriter(create(part)) as file:
        for data in parts:
            file.write(data)
    put_in_place(part, path)


def _read_place(path: Path) -> Place:
    return _unpack(path)[0]


def _unpack(path: Path) -> tuple[Place, bytes]:
    try:
        data = path.read_bytes()
        unpacker = msgpack.Unpacker(max_buffer_size=0)
        unpacker.feed(data)
        version, frame, inputs, outputs, ended = unpacker.unpack()
    except OSError as error:
        raise BusError(f"{path}: cannot read the checkpoint: {error.strerror}") from None
    except Exception as error:  # msgpack raises many unrelated types on broken bytes
        raise StateError(f"{path}: not a checkpoint: {error}") from None
    if version != _VERSION:
        raise StateError(f"{path}: a checkpoint of version {version}, this is {_VERSION}")
    return Place(frame, inputs, outputs, tuple(ended)), data[unpacker.tell() :]
