"""Capture times that do not increase: which of them are wrong, so that one costs one frame.

Of a list of times as many as possible are kept that increase: the longest increasing subsequence.
The others are wrong: doubled, swapped, set back, or far ahead.
"""

from bisect import bisect_left
from collections import deque
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

from pliant.datasets.base import SourceFrame

_AHEAD = 16
_AHEAD_BYTES = 1 << 26
"""Look-ahead: this many frames, or this many bytes of them but at least three frames."""
_LEAST_AHEAD = 3
_MOST_NS = 1 << 62
"""Later ones are none: year 2116."""


def increasing(stamps_ns: Sequence[int]) -> list[int]:
    """Indices of a longest strictly increasing subsequence, the earliest of equal stamps."""
    ends: list[int] = []  # the last stamp of the best subsequence of each length
    rows: list[int] = []
    before: list[int] = []
    for row, stamp in enumerate(stamps_ns):
        length = bisect_left(ends, stamp)
        before.append(rows[length - 1] if length else -1)
        if length == len(ends):
            ends.append(stamp)
            rows.append(row)
        elif stamp < ends[length]:
            ends[length], rows[length] = stamp, row
    found: list[int] = []
    row = rows[-1] if rows else -1
    while row >= 0:
        found.append(row)
        row = before[row]
    return found[::-1]


def why_wrong(stamp_ns: int) -> str:
    """The note on a frame whose time is wrong."""
    return f"its time, {stamp_ns / 1e9:.6f} s, is not between those of the images around it"


def in_order(frames: Iterable[SourceFrame], *, ahead: bool = True) -> Iterator[SourceFrame]:
    """Frames with increasing times; those with wrong ones become broken frames in between.

    ahead: look some frames ahead, so that a time that is too large costs one frame, too.
    """
    last_ns, step_ns, waiting = -1, 1, list[SourceFrame]()
    for frame, good in _marked(frames, ahead=ahead):
        if not good or frame.stamp_ns - last_ns <= len(waiting):  # no time for the frames between
            waiting.append(frame)
            continue
        yield from _between(waiting, last_ns, (frame.stamp_ns - last_ns) // (len(waiting) + 1))
        if last_ns >= 0:
            step_ns = max(1, (frame.stamp_ns - last_ns) // (len(waiting) + 1))
        last_ns, waiting = frame.stamp_ns, []
        yield frame
    yield from _between(waiting, last_ns, step_ns)


def _between(frames: Sequence[SourceFrame], last_ns: int, step_ns: int) -> Iterator[SourceFrame]:
    for number, frame in enumerate(frames, start=1):
        broken = frame if not frame.data else frame.broken(why_wrong(frame.stamp_ns))
        yield replace(broken, stamp_ns=last_ns + number * step_ns)


def _marked(frames: Iterable[SourceFrame], *, ahead: bool) -> Iterator[tuple[SourceFrame, bool]]:
    """Each frame, and whether its time is right.  One without data has none to be believed."""
    window: deque[SourceFrame] = deque()
    last_ns, size = -1, 0

    def first() -> tuple[SourceFrame, bool]:
        later = [i for i, f in enumerate(window) if f.data and last_ns < f.stamp_ns < _MOST_NS]
        kept = increasing([window[i].stamp_ns for i in later])
        return window.popleft(), bool(kept) and later[kept[0]] == 0

    for frame in frames:
        window.append(frame)
        size += len(frame.data)
        while window and (
            not ahead
            or len(window) == _AHEAD
            or (size > _AHEAD_BYTES and len(window) >= _LEAST_AHEAD)
        ):
            out, good = first()
            size -= len(out.data)
            last_ns = out.stamp_ns if good else last_ns
            yield out, good
    while window:
        out, good = first()
        last_ns = out.stamp_ns if good else last_ns
        yield out, good
