"""The video tracks of a Matroska or WebM file: EBML elements, by RFC 8794 and RFC 9559."""

from collections.abc import Iterator
from dataclasses import replace
from typing import BinaryIO, NamedTuple

from pliant.datasets.video_streams import Container, Patch, VideoStream

MAGIC_BYTES = 4
_EBML, _SEGMENT, _TRACKS, _ENTRY = 0x1A45DFA3, 0x18538067, 0x1654AE6B, 0xAE
_TYPE, _DEFAULT, _VIDEO, _WIDTH, _HEIGHT = 0x83, 0x88, 0xE0, 0xB0, 0xBA
_INFO, _UNIT, _UNIT_NS = 0x1549A966, 0x2AD7B1, 1_000_000
_NUMBER, _CLUSTER_TIME = 0xD7, 0xE7
_BLOCKS, _HOLDS_BLOCKS = (0xA1, 0xA3), (0x1F43B675, 0xA0)
"""Block and SimpleBlock; Cluster and BlockGroup."""
_TYPE_VIDEO = 1
_TYPE_METADATA = 0x21
"""Of a track that a reader follows, but does not decode."""
_MOST_ELEMENTS = 10_000
_LONGEST_NUMBER = 8


class _Element(NamedTuple):
    kind: int
    start: int
    end: int


def recognises(head: bytes) -> bool:
    """Whether a file begins as one of these."""
    return head == _EBML.to_bytes(4)


def video_streams(file: BinaryIO, size: int) -> Container:
    """Its video tracks.  Raises OSError."""
    segment = next((e for e in _elements(file, 0, size) if e.kind == _SEGMENT), None)
    streams, unit_ns = dict[int, VideoStream](), _UNIT_NS
    for part in _elements(file, segment.start, segment.end) if segment is not None else ():
        if part.kind == _INFO:
            for each in _elements(file, part.start, part.end):
                unit_ns = _number(file, each) if each.kind == _UNIT else unit_ns
        if part.kind == _TRACKS:
            for entry in _elements(file, part.start, part.end):
                if entry.kind == _ENTRY and (stream := _stream(file, entry)) is not None:
                    streams[stream[0]] = stream[1]
            break
    times = _block_times(file, segment.start, size) if streams and segment is not None else {}
    for number, stream in streams.items():
        stamps_ns = [unit_ns * time for time in times.get(number, ())]
        streams[number] = replace(
            stream,
            frames=len(stamps_ns) or None,
            stamps_ns=sorted(stamps_ns),
            origin_ns=stamps_ns[0] if stamps_ns else 0,
        )
    return Container(streams=tuple(streams.values()))


def _block_times(file: BinaryIO, start: int, size: int) -> dict[int, list[int]]:
    """Times of the blocks of each track, in the order of decoding, in units of the file.

    Clusters of live recordings have no length: whatever holds blocks is entered, not passed over.
    """
    times, cluster, at = dict[int, list[int]](), 0, start
    while at < size:
        file.seek(at)
        head = file.read(4 + 2 * _LONGEST_NUMBER + 2)
        kind, kind_bytes, _ = _variable(head, keep_marker=True)
        length, length_bytes, unknown = _variable(head[kind_bytes:], keep_marker=False)
        if not kind_bytes or not length_bytes or (unknown and kind not in _HOLDS_BLOCKS):
            break
        body = head[kind_bytes + length_bytes :]
        at += kind_bytes + length_bytes
        if kind == _CLUSTER_TIME:
            cluster = int.from_bytes(body[: min(length, _LONGEST_NUMBER)])
        if kind in _BLOCKS:
            number, found, _ = _variable(body, keep_marker=False)
            since = int.from_bytes(body[found : found + 2], signed=True)
            times.setdefault(number, []).append(cluster + since)
        at += 0 if kind in _HOLDS_BLOCKS else length
    return times


def _stream(file: BinaryIO, entry: _Element) -> tuple[int, VideoStream] | None:
    """Number and description of a track, if it is one of images."""
    parts = {part.kind: part for part in _elements(file, entry.start, entry.end)}
    if _TYPE not in parts or _number(file, parts[_TYPE]) != _TYPE_VIDEO or _VIDEO not in parts:
        return None
    video = parts[_VIDEO]
    inside = {part.kind: part for part in _elements(file, video.start, video.end)}
    if not {_WIDTH, _HEIGHT} <= set(inside) or _NUMBER not in parts:
        return None
    kind = parts[_TYPE]
    return _number(file, parts[_NUMBER]), VideoStream(
        width=_number(file, inside[_WIDTH]),
        height=_number(file, inside[_HEIGHT]),
        is_default=_DEFAULT not in parts or _number(file, parts[_DEFAULT]) == 1,
        hide=(Patch(kind.start, _TYPE_METADATA.to_bytes(kind.end - kind.start)),),
    )


def _elements(file: BinaryIO, start: int, end: int) -> Iterator[_Element]:
    """The elements between two places, as far as they make sense.

    One of unknown length, as live recordings have, reaches to the end.
    """
    for _ in range(_MOST_ELEMENTS):
        if start >= end:
            return
        file.seek(start)
        head = file.read(4 + _LONGEST_NUMBER)
        kind, kind_bytes, _ = _variable(head, keep_marker=True)
        length, length_bytes, unknown = _variable(head[kind_bytes:], keep_marker=False)
        if not kind_bytes or not length_bytes:
            return
        body = start + kind_bytes + length_bytes
        stop = end if unknown else min(end, body + length)
        yield _Element(kind, body, stop)
        start = stop


def _variable(data: bytes, *, keep_marker: bool) -> tuple[int, int, bool]:
    """A number of variable length, its bytes (0: none is there), and whether it is "unknown"."""
    if not data or not data[0]:
        return 0, 0, False
    size = 9 - data[0].bit_length()
    if len(data) < size:
        return 0, 0, False
    value, marker = int.from_bytes(data[:size]), 1 << 7 * size
    unknown = value == 2 * marker - 1
    return value if keep_marker else value - marker, size, unknown


def _number(file: BinaryIO, element: _Element) -> int:
    file.seek(element.start)
    return int.from_bytes(file.read(min(_LONGEST_NUMBER, element.end - element.start)))
