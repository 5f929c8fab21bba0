"""Compares two recordings topic by topic: counts, then order, then fields."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, fields
from itertools import zip_longest
from typing import Any

import numpy as np

from pliant.errors import RecordingError
from pliant.messages.topics import Topic
from pliant.messages.types import Header
from pliant.recording.reader import Recording
from pliant.wording import counted


@dataclass(frozen=True)
class Difference:
    """How one topic differs: the first difference in words, and how many messages differ."""

    topic: str
    kind: str
    """"count", "order" or "field"."""
    first: str
    messages: int


def compare(
    recorded: Recording,
    made: Recording,
    topics: Sequence[Topic],
    tolerances: Mapping[str, float] | None = None,
) -> list[Difference]:
    """Differences, counts before order before fields and topics as given; none: the same bytes, or
    the same fields where an earlier release encoded them.

    Messages are compared by their place within their topic, never across topics.  ``tolerances``:
    by how much the numbers of a field may differ, which then counts as no difference.  Raises
    RecordingError for a tolerance of a field that no message has.
    """
    allowed = dict(tolerances or {})
    check_tolerances(topics, allowed)
    found = [d for topic in topics for d in _compare_topic(recorded, made, topic, allowed)]
    return sorted(found, key=lambda d: ("count", "order", "field").index(d.kind))


def check_tolerances(topics: Sequence[Topic], tolerances: Mapping[str, float]) -> None:
    """Raise RecordingError for a tolerance of a field that no message of the topics has."""
    known = {field.name for topic in topics for field in fields(topic.message)}
    unknown = sorted(tolerances.keys() - known)
    if unknown:
        raise RecordingError(f"no field {unknown[0]}: choose from {', '.join(sorted(known))}")


def _compare_topic(
    recorded: Recording, made: Recording, topic: Topic, tolerances: Mapping[str, float]
) -> Iterator[Difference]:
    counts = [0, 0]
    order: list[str] = []
    content: list[str] = []
    differing = 0
    for a, b in zip_longest(recorded.messages(topic), made.messages(topic)):
        counts[0] += a is not None
        counts[1] += b is not None
        if a is None or b is None or a.data == b.data:
            continue
        was, now = a.decode(), b.decode()
        text = first_difference(was, now, tolerances)
        if not text:
            continue
        differing += 1
        if order or content:
            continue
        if was.frame != now.frame:
            order.append(f"message {counts[0] - 1} is of frame {now.frame}, was of {was.frame}")
        else:
            content.append(f"frame {was.frame}: {text}")
    if counts[0] != counts[1]:
        what = f"{counted(counts[1], 'message')}, was {counts[0]}"
        yield Difference(topic.key, "count", what, abs(counts[0] - counts[1]))
    for kind, first in (("order", order), ("field", content)):
        if first:
            yield Difference(topic.key, kind, first[0], differing)


def first_difference(
    was: Header, now: Header, tolerances: Mapping[str, float] | None = None
) -> str:
    """The first field in which two messages differ, and how; "" for none beyond its tolerance."""
    allowed = tolerances or {}
    for field in fields(was):
        a, b = getattr(was, field.name), getattr(now, field.name)
        if isinstance(a, np.ndarray):
            text = _arrays(a, b, allowed.get(field.name, 0.0))
        elif field.name in allowed and _near(a, b, allowed[field.name]):
            text = ""
        else:
            text = "" if a == b else f"{_short(b)}, was {_short(a)}"
        if text:
            return f"{field.name}: {text}"
    return ""


def _near(was: Any, now: Any, tolerance: float) -> bool:
    """Whether two numbers differ by no more than the tolerance."""
    numbers = isinstance(was, int | float) and isinstance(now, int | float)
    return was == now or (numbers and abs(now - was) <= tolerance)


def _arrays(was: Any, now: Any, tolerance: float) -> str:
    if was.shape != now.shape:
        return f"shape {now.shape}, was {was.shape}"
    if was.tobytes() == now.tobytes():
        return ""
    same = (was == now) | ((was != was) & (now != now))
    if tolerance > 0.0:
        apart = np.abs(now.astype(np.float64) - was.astype(np.float64))
        same |= apart <= tolerance
        if same.all():
            return ""
    places = np.argwhere(~same)
    if not len(places):
        return "the bits of a zero or a NaN"
    at = tuple(int(i) for i in places[0])
    where = "[" + ", ".join(map(str, at)) + "]"
    text = f"{where} {now[at]!s}, was {was[at]!s}; {len(places)} of {was.size} values differ"
    if was.dtype.kind == "f":
        largest = float(np.nanmax(np.abs(now.astype(np.float64) - was.astype(np.float64))))
        text += f", by {largest:.3g} at most"
    return text


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 60 else text[:57] + "..."
