"""The file of a saved map, ``map.pliant``: MCAP, one message for each keyframe.

A metadata record ``map`` stands first: ``version`` of what the fields mean, ``release`` of Pliant,
``source`` of the last session and its ``calibration`` as YAML, whether its lengths are ``metric``
and whether its z axis is up (``level``).  The messages are those of the topic ``map/kept``, in the
order of their keyframes.  Nothing in it depends on the time or the machine.
"""

import re
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pliant.algorithms.slam.map.kept_keyframe import MAP_VERSION
from pliant.errors import MapError, MessageError, RecordingError
from pliant.files import put_in_place
from pliant.messages import codec
from pliant.messages.topics import MAP_KEPT
from pliant.messages.types import MapKeyframe
from pliant.recording.reader import Recorded, Recording
from pliant.recording.scan import Closed, Damage
from pliant.recording.writer import RecordingWriter
from pliant.version import __version__
from pliant.wording import counted, shortened

MAP_NAME = "map.pliant"
_RECORD = "map"


@dataclass(frozen=True, kw_only=True)
class MapHeader:
    """The header of the file."""

    version: int = MAP_VERSION
    release: str = __version__
    source: str = ""
    calibration: str = ""
    metric: bool = False
    level: bool = False


class MapFile:
    """A kept map on disk."""

    def __init__(self, path: Path) -> None:
        """``path``: the file, or a result folder.  Raises MapError if it is no map, or one of a
        newer version."""
        self.path = path / MAP_NAME if path.is_dir() else path
        if not self.path.is_file():
            raise MapError(f"{path}: no map: pass a result folder, or its {MAP_NAME}")
        try:
            self._recording = Recording(self.path)
            found = self._recording.metadata().get(_RECORD)
        except RecordingError as error:
            raise MapError(f"{self.path}: no map: {_why(error, self.path)}") from None
        if found is None or not re.fullmatch("[0-9]{1,9}", found.get("version", "")):
            raise MapError(f"{self.path}: no map: without its record `{_RECORD}`")
        self.header = MapHeader(
            version=int(found["version"]),
            release=found.get("release", ""),
            source=found.get("source", ""),
            calibration=found.get("calibration", ""),
            metric=found.get("metric") == str(True),
            level=found.get("level") == str(True),
        )
        if self.header.version > MAP_VERSION:
            raise MapError(
                f"{self.path}: a map of version {self.header.version} (pliant "
                f"{shortened(self.header.release)}), this pliant reads up to "
                f"{MAP_VERSION}: install a newer one"
            )

    def keyframes(self) -> Iterator[MapKeyframe]:
        """The keyframes, oldest first.  Raises MapError for a file that is damaged or cut off,
        and for a map in which no place could be recognised."""
        # Loads kernels, which services that only look for their map do not need.
        from pliant.algorithms.slam.store.kept_map import check

        last, places = -1, 0
        closed = False
        try:
            for item in self._recording.everything(MAP_KEPT):
                if isinstance(item, Damage):
                    raise MapError(f"{self.path}: damaged: {item.what}")
                closed = closed or isinstance(item, Closed)
                if not isinstance(item, Recorded):
                    continue
                keyframe = codec.decode(MapKeyframe, item.data, max_bytes=MAP_KEPT.max_bytes)
                check(keyframe)
                if keyframe.id <= last:
                    raise ValueError("keyframes out of order")
                last, places = keyframe.id, places + bool(len(keyframe.descriptors))
                yield keyframe
        except (RecordingError, MessageError, ValueError) as error:
            raise MapError(f"{self.path}: damaged: {_why(error, self.path)}") from None
        if not closed:
            raise MapError(f"{self.path}: damaged: cut off")
        if places == 0:
            what = "empty" if last < 0 else "without a place that could be recognised"
            raise MapError(f"{self.path}: the map is {what}")


def write_map(path: Path, header: MapHeader, keyframes: Iterable[MapKeyframe]) -> bool:
    """Write a map whole or not at all; whether there was a keyframe.  Raises MapError."""
    waiting = iter(keyframes)
    first = next(waiting, None)
    if first is None:
        return False
    partial = path.with_name(path.name + ".partial")
    record = {name: str(value) for name, value in vars(header).items()}
    try:
        with RecordingWriter(partial, {_RECORD: record}) as writer:
            _write(writer, first)
            for keyframe in waiting:
                _write(writer, keyframe)
        put_in_place(partial, path)
    except (OSError, RecordingError) as error:
        raise MapError(f"{path}: the map cannot be written: {_why(error, partial)}") from None
    finally:
        partial.unlink(missing_ok=True)  # an interruption leaves none either
    return True


def describe(path: Path) -> Iterator[str]:
    """A summary of a map in a few lines.  Raises MapError."""
    file = MapFile(path)
    segments: dict[int, tuple[int, int]] = {}
    sessions: set[int] = set()
    cameras: set[str] = set()
    places = 0
    for keyframe in file.keyframes():
        keyframes, points = segments.get(keyframe.segment, (0, 0))
        segments[keyframe.segment] = keyframes + 1, points + len(keyframe.point_ids)
        sessions.add(keyframe.session)
        camera = keyframe.given_camera
        focal = camera.fx * float(np.exp(keyframe.correction[0]))
        cameras.add(f"{camera.width}x{camera.height}, focal length {focal:.1f} px")
        places += len(keyframe.descriptors) > 0
    count = sum(keyframes for keyframes, _ in segments.values())
    size = file.path.stat().st_size
    header = file.header
    yield f"{file.path}: version {header.version}, written by pliant {shortened(header.release)}"
    yield f"sessions: {len(sessions)}, the last of {shortened(header.source, 200)}"
    level = ", z is up" if header.level else ""
    yield f"scale: {'metres' if header.metric else 'arbitrary'}{level}"
    yield f"cameras: {'; '.join(sorted(cameras))}"
    yield (
        f"{counted(count, 'keyframe')}, {places} of them places, {size / 1e6:.1f} MB, "
        f"{size / 1e3 / count:.0f} kB each"
    )
    for segment, (keyframes, points) in sorted(segments.items()):
        yield f"segment {segment}: {counted(keyframes, 'keyframe')}, {counted(points, 'point')}"


def _write(writer: RecordingWriter, keyframe: MapKeyframe) -> None:
    data, number = codec.encode(keyframe), keyframe.frame
    writer.write(MAP_KEPT, data, sequence=number, log_time_ns=number, publish_time_ns=number)


def _why(error: Exception, path: Path) -> str:
    """The message of an error, without the name of the file that it begins with."""
    return str(error).removeprefix(f"{path}: ")
