"""Times in the names of image files.

    1305031102.175304.png        seconds
    1403636579763555584.png      nanoseconds; micro- and milliseconds likewise
    frame_000012_1.4.png         the number that is a time
    1305031102_175304000.png     seconds and nanoseconds
    20240102_123005_250.jpg      a date and the time of the day, in UTC

Numbers of frames are none: they have equal or small steps.
"""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import UTC, datetime
from decimal import Decimal

from pliant.datasets.times import UNITS, is_date, likely_unit, median_step, steps_between

_NUMBER = re.compile(r"[0-9]+(?:\.[0-9]+)?|^\.[0-9]+")
_DATE = re.compile(
    r"(?<![0-9])((?:19|20)[0-9]{2})[-_.]?([01][0-9])[-_.]?([0-3][0-9])[T_ -]*"
    r"([0-2][0-9])[-_.:hH]?([0-5][0-9])[-_.:mM]?([0-5][0-9])(?:[-_.,]?([0-9]{3,9}))?(?![0-9])"
)
_LONGEST_STEP_S, _SHORTEST_STEP_S = 600.0, 5e-4
_FRAME_STEP = 1000
"""Whole numbers with smaller steps may be those of frames, of which every n-th is there."""
_LEAST_STEP = 4
_EVEN, _EVEN_SHARE = 0.1, 0.8
"""Times have steps that differ, but most of them by no more than this from the median."""
_LEAST_DATE_S = 500_000_000


@dataclass(frozen=True)
class NamedTimes:
    """Times from names.  order: indices of the names by time.   stamps_ns: in that order.

    unit: in which they are, for people.
    """

    order: list[int]
    stamps_ns: list[int]
    unit: str


def times_in_names(names: Sequence[str]) -> NamedTimes | None:
    """The times in names without their endings; None if they tell none, or not all of them."""
    dates = _dates(names)
    if dates or len(names) < 2 or len({_NUMBER.sub("#", name) for name in names}) > 1:
        return dates
    columns = list(zip(*(_NUMBER.findall(name) for name in names), strict=True))
    for column, following in zip(columns, [*columns[1:], None], strict=True):
        for found in (_seconds_and_rest(column, following), _times_in(column)):
            if found is not None:
                return found
    return None


def _times_in(column: Sequence[str]) -> NamedTimes | None:
    values = [Decimal(text) for text in column]
    if len(set(values)) < len(values):
        return None
    has_points = any("." in text for text in column)
    unit = likely_unit(values, "seconds" if has_points else "")
    step = median_step(values)
    seconds = step * UNITS[unit] / 1e9
    if has_points and _is_counter(column):
        return None
    if not _SHORTEST_STEP_S <= seconds <= _LONGEST_STEP_S:
        return None
    if not (has_points or is_date(values, unit) or step >= _FRAME_STEP or _uneven(values, step)):
        return None
    return _in_order([round(value * UNITS[unit]) for value in values], unit)


def _is_counter(column: Sequence[str]) -> bool:
    """Whether numbers with points are a constant and a counter, as in shot1.0001, shot1.0002."""
    parts = [text.partition(".") for text in column]
    if len({whole for whole, _, _ in parts}) > 1 or len({len(count) for _, _, count in parts}) > 1:
        return False
    return median_step([Decimal(count or "0") for _, _, count in parts]) < _LEAST_STEP


def _uneven(values: Sequence[Decimal], step: float) -> bool:
    """Whether whole numbers have the steps of times and not those of frames."""
    steps = [float(each) for each in steps_between(values)]
    even = sum(abs(each - step) <= _EVEN * step for each in steps)
    return step >= _LEAST_STEP and steps[0] < steps[-1] and even >= _EVEN_SHARE * len(steps)


def _seconds_and_rest(seconds: Sequence[str], rest: Sequence[str] | None) -> NamedTimes | None:
    """Seconds of a date, and the next number as their fraction."""
    whole = [text for text in [*seconds, *(rest or ())] if text.isdecimal()]
    if rest is None or len(whole) < 2 * len(rest) or min(map(int, seconds)) < _LEAST_DATE_S:
        return None
    if max(map(int, seconds)) >= 10**11:
        return None
    digits = {len(text) for text in rest}
    # Of equal length they are decimals; else nanoseconds without leading zeros.
    power = 9 - digits.pop() if len(digits) == 1 else 0
    if power < 0 or max(map(int, rest)) * 10**power >= 10**9:
        return None
    stamps = [
        int(second) * 10**9 + int(part) * 10**power
        for second, part in zip(seconds, rest, strict=True)
    ]
    unique = len(set(stamps)) == len(stamps)
    return _in_order(stamps, "seconds and fraction") if unique else None


def _dates(names: Sequence[str]) -> NamedTimes | None:
    stamps: list[int] = []
    for name in names:
        found = _DATE.search(name)
        if found is None:
            return None
        *parts, fraction = found.groups()
        try:
            date = datetime(*map(int, parts), tzinfo=UTC)  # pyright: ignore[reportArgumentType]
        except ValueError:
            return None
        stamps.append(int(date.timestamp()) * 10**9 + int((fraction or "").ljust(9, "0")))
    unique = len(set(stamps)) == len(stamps) > 1 and min(stamps, default=-1) >= 0
    return _in_order(stamps, "date and time of day") if unique else None


def _in_order(stamps_ns: list[int], unit: str) -> NamedTimes:
    order = sorted(range(len(stamps_ns)), key=stamps_ns.__getitem__)
    return NamedTimes(order, [stamps_ns[row] for row in order], unit)
