"""The tracks of an MP4 or QuickTime file: its boxes, by ISO/IEC 14496-12.

Read are the sizes, which tracks are pictures, the times of the samples, and the edit lists; of a
track of metadata also where the samples are.  With
an edit list a file keeps more samples than it shows (a lossless trim).  FFmpeg passes over some of
these, and then it is unknown how many frames should come.  So where an edit list leaves something
out it is hidden, all samples are decoded, and the source passes over what is not shown.
"""

from collections.abc import Iterator
from typing import BinaryIO, NamedTuple

import numpy as np

from pliant.algorithms.arrays import I64, BoolArray
from pliant.datasets.video_streams import Container, Patch, VideoStream

MAGIC_BYTES = 8
_BEGINNINGS = (b"ftyp", b"moov", b"mdat", b"free", b"skip", b"wide", b"pnot")
_FREE = b"free"
_SIZED = (b"avc1", b"hvc1")
"""Descriptions of H.264 and HEVC whose parameters are not among the samples."""
_MOST_BOXES = 100_000
_MOST_EDITS = 1_000
_MOST_PLACES = 1_000_000
"""Samples of a track of metadata: of one a second, for eleven days."""
_MOST_TABLE_BYTES = 1 << 28
_NS = 10**9


class _Box(NamedTuple):
    kind: bytes
    at: int
    start: int
    end: int


def recognises(head: bytes) -> bool:
    """Whether a file begins as one of these."""
    return head[4:8] in _BEGINNINGS


def video_streams(file: BinaryIO, size: int) -> Container:
    """Its video tracks.  Raises OSError."""
    moov = next((box for box in _boxes(file, 0, size) if box.kind == b"moov"), None)
    if moov is None:
        return Container()
    tracks = [_Track(file, box) for box in _boxes(file, moov.start, moov.end, b"trak")]
    chapters = {number for track in tracks for number in track.chapters()}
    fragments = any(True for _ in _boxes(file, moov.start, moov.end, b"mvex"))
    time_scale = _time_scale(file, moov, b"mvhd")
    streams: list[VideoStream] = []
    patches = list(_covers(file, moov))
    for track in tracks:
        if not track.is_video():
            continue
        times = np.zeros(0, np.int64) if fragments else track.stamps_ns()
        shown = track.shown_ns(time_scale) if len(times) else ()
        inside = _inside(times, shown)
        if shown and not (len(shown) == 1 and inside.all()):
            patches += [Patch(box.at + 4, _FREE) for box in track.boxes(b"edts")]
        if inside.all() or not inside.any():  # what would show nothing is none to follow
            shown = ()
        hide = [Patch(track.box.at + 4, _FREE)]
        parts = list(_parts_in_fragments(file, size, track.number)) if fragments else []
        hide += [Patch(part.at + 4, _FREE) for part in parts]
        width, height = track.size()
        streams.append(
            VideoStream(
                width=width,
                height=height,
                is_default=track.is_enabled(),
                is_still=track.number in chapters or track.samples() == 1,
                frames=track.samples() + sum(_samples_of(file, part) for part in parts),
                stamps_ns=np.sort(times).tolist(),
                origin_ns=int(times[0]) if len(times) else 0,
                shown_ns=shown,
                may_change=not track.keeps_size(),
                hide=tuple(hide),
            )
        )
    return Container(streams=tuple(streams), patches=tuple(patches))


class Sample(NamedTuple):
    """A sample of a track: where its bytes are, and from when to when it lasts.

    Times begin with the first picture that the file shows.
    """

    offset: int
    size: int
    begin_ns: int
    end_ns: int


def metadata_samples(file: BinaryIO, size: int, kind: bytes) -> list[Sample]:
    """The samples of the first track of a kind of metadata, in order.  Raises OSError."""
    moov = next((box for box in _boxes(file, 0, size) if box.kind == b"moov"), None)
    if moov is None:
        return []
    tracks = [_Track(file, box) for box in _boxes(file, moov.start, moov.end, b"trak")]
    track = next((each for each in tracks if each.kind() == kind), None)
    if track is None:
        return []
    time_scale = _time_scale(file, moov, b"mvhd")
    picture = next((each for each in tracks if each.is_video()), None)
    first_ns = 0
    if picture is not None and not picture.shown_ns(time_scale):
        first_ns = int(min(picture.stamps_ns(), default=0))
    shown = track.shown_ns(time_scale)
    origin_ns = first_ns + (shown[0][0] if shown else 0)
    begin = track.stamps_ns()
    places = track.places(size)[: len(begin)]
    begin = begin[: len(places)] - origin_ns
    steps = np.diff(begin, append=begin[-1:] + _NS)
    steps[-1:] = steps[-2:-1] if len(steps) > 1 else steps
    return [
        Sample(*place, start, start + step)
        for place, start, step in zip(places, begin.tolist(), steps.tolist(), strict=True)
    ]


class _Track:
    """A ``trak`` box."""

    def __init__(self, file: BinaryIO, box: _Box) -> None:
        self._file = file
        self.box = box
        header = self._body(b"tkhd")
        version = header[:1] == b"\1"
        self._flags = int.from_bytes(header[1:4])
        self.number = int.from_bytes(header[20:24] if version else header[12:16])

    def boxes(self, *path: bytes) -> list[_Box]:
        """The boxes at a path below it."""
        found = [self.box]
        for kind in path:
            found = [b for each in found for b in _boxes(self._file, each.start, each.end, kind)]
        return found

    def is_video(self) -> bool:
        return self._body(b"mdia", b"hdlr")[8:12] == b"vide" and bool(self._entry())

    def kind(self) -> bytes:
        """The format of its samples."""
        return self._entry()[4:8]

    def places(self, file_size: int) -> list[tuple[int, int]]:
        """(offset, size) of its samples that are in the file, up to the first that is not, or
        until all have as many bytes as the file."""
        data = self._body(b"mdia", b"minf", b"stbl", b"stsz", limit=_MOST_TABLE_BYTES)
        fixed, count = int.from_bytes(data[4:8]), self.samples()
        count = min(count, file_size) if fixed else min(count, max(0, len(data) - 12) // 4)
        count = min(count, _MOST_PLACES)
        sizes = [fixed] * count if fixed else np.frombuffer(data[12:], ">u4", count).tolist()
        found, left = list[tuple[int, int]](), file_size
        for offset, samples in self._chunks():
            for _ in range(samples):
                if len(found) == count or offset + sizes[len(found)] > file_size or left < 0:
                    return found
                found.append((offset, sizes[len(found)]))
                offset += found[-1][1]
                left -= found[-1][1]
        return found

    def _chunks(self) -> Iterator[tuple[int, int]]:
        """(offset, number of samples) of its chunks."""
        at = (b"mdia", b"minf", b"stbl")
        for kind, width in ((b"stco", 4), (b"co64", 8)):
            data = self._body(*at, kind, limit=_MOST_TABLE_BYTES)
            if not data:
                continue
            count = min(int.from_bytes(data[4:8]), max(0, len(data) - 8) // width)
            offsets = np.frombuffer(data[8:], f">u{width}", count).tolist()
            runs = self._body(*at, b"stsc", limit=_MOST_TABLE_BYTES)
            most = min(int.from_bytes(runs[4:8]), max(0, len(runs) - 8) // 12)
            table = np.frombuffer(runs[8:], ">u4", 3 * most).reshape(-1, 3).tolist()
            row, samples = 0, 0
            for number, offset in enumerate(offsets, start=1):
                while row < len(table) and table[row][0] <= number:
                    samples, row = table[row][1], row + 1
                yield offset, samples

    def is_enabled(self) -> bool:
        return bool(self._flags & 1)

    def chapters(self) -> list[int]:
        """The tracks that hold titles and pictures of its chapters."""
        data = self._body(b"tref", b"chap")
        return [int.from_bytes(data[i : i + 4]) for i in range(0, len(data), 4)]

    def size(self) -> tuple[int, int]:
        entry = self._entry()
        return int.from_bytes(entry[32:34]), int.from_bytes(entry[34:36])

    def keeps_size(self) -> bool:
        """Whether all samples have one description, and it has their size."""
        data = self._body(b"mdia", b"minf", b"stbl", b"stsd", limit=16)
        return int.from_bytes(data[4:8]) == 1 and data[12:16] in _SIZED

    def samples(self) -> int:
        """0 where fragments have them."""
        for kind in (b"stsz", b"stz2"):
            data = self._body(b"mdia", b"minf", b"stbl", kind, limit=12)
            if data:
                return int.from_bytes(data[8:12])
        return 0

    def stamps_ns(self) -> I64:
        """When its samples are shown, in the order of decoding; media time."""
        scale = _time_scale(self._file, self.boxes(b"mdia")[0], b"mdhd")
        steps = self._runs(b"stts")
        count = min(self.samples(), sum(max(0, each) for each, _ in steps.tolist()))
        if not scale or not count or count * 8 > _MOST_TABLE_BYTES:
            return np.zeros(0, np.int64)
        ticks = np.cumsum(_of_runs(steps, count))
        ticks = np.concatenate(([0], ticks[:-1]))
        later = self._runs(b"ctts")
        if int(np.maximum(later[:, 0], 0).sum()) >= count:
            ticks = ticks + _of_runs(later, count)
        return ticks // scale * _NS + ticks % scale * _NS // scale

    def shown_ns(self, movie_scale: int) -> tuple[tuple[int, int], ...]:
        """The intervals of media time in its edit list, without empty ones."""
        data = self._body(b"edts", b"elst", limit=8 + 20 * _MOST_EDITS)
        scale = _time_scale(self._file, self.boxes(b"mdia")[0], b"mdhd")
        wide, found = data[:1] == b"\1", list[tuple[int, int]]()
        step, half = (20, 8) if wide else (12, 4)
        if not scale or not movie_scale:
            return ()
        for at in range(8, min(len(data), 8 + step * int.from_bytes(data[4:8])) - step + 1, step):
            length = int.from_bytes(data[at : at + half])
            begin = int.from_bytes(data[at + half : at + 2 * half], signed=True)
            if begin >= 0:
                start = begin * _NS // scale
                end = start + length * _NS // movie_scale if length else 1 << 62
                found.append((start, end))
        return tuple(found)

    def _entry(self) -> bytes:
        """The first description of its samples."""
        return self._body(b"mdia", b"minf", b"stbl", b"stsd", limit=8 + 86)[8:]

    def _runs(self, kind: bytes) -> I64:
        """(N, 2) rows of a table of runs: how many samples, and their value."""
        data = self._body(b"mdia", b"minf", b"stbl", kind, limit=_MOST_TABLE_BYTES)
        count = min(int.from_bytes(data[4:8]), max(0, len(data) - 8) // 8)
        return np.frombuffer(data, ">i4", 2 * count, 8 if count else 0).reshape(-1, 2).astype(int)

    def _body(self, *path: bytes, limit: int = 1 << 16) -> bytes:
        box = next(iter(self.boxes(*path)), None)
        return _read(self._file, box, limit) if box is not None else b""


def _inside(stamps_ns: I64, shown_ns: tuple[tuple[int, int], ...]) -> BoolArray:
    """Which samples some interval shows."""
    inside = np.zeros(len(stamps_ns), np.bool_)
    for start, end in shown_ns:
        inside |= (stamps_ns >= start) & (stamps_ns < end)
    return inside


def _of_runs(runs: I64, count: int) -> I64:
    """The first values of runs (N, 2), which may claim to be far longer."""
    lengths = np.minimum(np.maximum(runs[:, 0], 0), count)
    before = np.minimum(np.cumsum(lengths) - lengths, count)
    return np.repeat(runs[:, 1], np.minimum(lengths, count - before))


def _time_scale(file: BinaryIO, parent: _Box, kind: bytes) -> int:
    """Ticks a second of a header."""
    box = next(_boxes(file, parent.start, parent.end, kind), None)
    data = _read(file, box, 24) if box is not None else b""
    return int.from_bytes(data[20:24] if data[:1] == b"\1" else data[12:16])


def _covers(file: BinaryIO, moov: _Box) -> Iterator[Patch]:
    """The box of cover pictures, which FFmpeg treats as video streams."""
    for udta in _boxes(file, moov.start, moov.end, b"udta"):
        for meta in _boxes(file, udta.start, udta.end, b"meta"):
            for skipped in (4, 0):  # QuickTime's has no version
                for ilst in _boxes(file, meta.start + skipped, meta.end, b"ilst"):
                    for cover in _boxes(file, ilst.start, ilst.end, b"covr"):
                        yield Patch(cover.at + 4, _FREE)


def _parts_in_fragments(file: BinaryIO, size: int, number: int) -> Iterator[_Box]:
    """The boxes of a track in the fragments."""
    for moof in _boxes(file, 0, size, b"moof"):
        for part in _boxes(file, moof.start, moof.end, b"traf"):
            header = next(_boxes(file, part.start, part.end, b"tfhd"), None)
            if header is not None and int.from_bytes(_read(file, header, 8)[4:8]) == number:
                yield part


def _samples_of(file: BinaryIO, part: _Box) -> int:
    runs = _boxes(file, part.start, part.end, b"trun")
    return sum(int.from_bytes(_read(file, run, 8)[4:8]) for run in runs)


def _boxes(file: BinaryIO, start: int, end: int, kind: bytes = b"") -> Iterator[_Box]:
    """The boxes of a kind, or all, between two places, as far as they make sense."""
    at = start
    for _ in range(_MOST_BOXES):
        if at + 8 > end:
            return
        file.seek(at)
        head = file.read(16)
        length, found, body = int.from_bytes(head[:4]), head[4:8], at + 8
        if length == 1:
            length, body = int.from_bytes(head[8:16]), at + 16
        stop = end if length == 0 else at + length
        if stop < body:
            return
        if not kind or found == kind:
            yield _Box(found, at, body, min(stop, end))
        at = stop


def _read(file: BinaryIO, box: _Box, limit: int) -> bytes:
    file.seek(box.start)
    return file.read(min(limit, box.end - box.start))
