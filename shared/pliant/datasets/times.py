"""Times that are written as numbers: in which unit they are, and their nanoseconds.

A unit is likely where it makes the images come at a usual rate, or puts them into the years in
which there were digital cameras.
"""

import math
from collections.abc import Sequence
from datetime import UTC, datetime
from decimal import Decimal, InvalidOperation
from itertools import pairwise

from pliant.errors import DatasetError
from pliant.wording import shown

UNITS = {"seconds": 10**9, "milliseconds": 10**6, "microseconds": 10**3, "nanoseconds": 1}
"""Nanoseconds of each."""
_MAX_STAMP_NS = (1 << 63) - 1
_USUAL_STEP_S = 1.0 / 30.0
_YEARS_S = (631_152_000, 4_102_444_800)  # 1990 to 2100
# In powers of ten: how much farther from the usual rate a unit may be that a file is known to
# have, or that gives a date.
_IS_KNOWN, _IS_A_DATE = 2.0, 3.0


def number_of(text: str, where: str) -> Decimal:
    """A time as it is written, exact.  Raises DatasetError."""
    try:
        value = Decimal(text)
    except InvalidOperation:
        raise DatasetError(f"{where}: {shown(text)} is not a time") from None
    if not value.is_finite() or value < 0:
        raise DatasetError(f"{where}: the time {text[:40]} is not finite and positive")
    return value


def utc_ns(text: str) -> int:
    """Nanoseconds since 1970 of a date in ISO 8601, in UTC without a zone.  Raises ValueError."""
    time = datetime.fromisoformat(text.strip())
    time = time if time.tzinfo is not None else time.replace(tzinfo=UTC)
    since = time - datetime(1970, 1, 1, tzinfo=UTC)
    return (since.days * 86_400 + since.seconds) * 10**9 + since.microseconds * 1000


def nanoseconds(value: Decimal, unit: str, where: str) -> int:
    """A time in nanoseconds.  Raises DatasetError if it does not fit 63 bits."""
    if value > Decimal(_MAX_STAMP_NS) / UNITS[unit]:
        raise DatasetError(f"{where}: the time {str(value)[:40]} is too large to be in {unit}")
    return int((value * UNITS[unit]).to_integral_value())


def likely_unit(
    values: Sequence[Decimal], known: str = "", *, usual_step_s: float = _USUAL_STEP_S
) -> str:
    """The unit of a list of times.  known: that which the file should have.

    usual_step_s: between two of them.
    """
    step = median_step(values)

    def unlikely(unit: str) -> float:
        scale = UNITS[unit] / 1e9
        off = abs(math.log10(step * scale / usual_step_s)) if step > 0.0 else 0.0
        return off - _IS_KNOWN * (unit == known) - _IS_A_DATE * is_date(values, unit)

    return min(UNITS, key=unlikely)


def is_date(values: Sequence[Decimal], unit: str) -> bool:
    """Whether times begin in the years of digital cameras."""
    begin_s = float(min(values, default=Decimal(0))) * UNITS[unit] / 1e9
    return _YEARS_S[0] <= begin_s <= _YEARS_S[1]


def median_step(values: Sequence[Decimal]) -> float:
    """The median difference of times that follow each other; 0 where there are fewer than two."""
    steps = steps_between(values)
    return float(steps[len(steps) // 2]) if steps else 0.0


def steps_between(values: Sequence[Decimal]) -> list[Decimal]:
    """The positive differences of times, by size."""
    return sorted(b - a for a, b in pairwise(sorted(values)) if b > a)


def rate(stamps_ns: Sequence[int]) -> str:
    """How fast images come, for people."""
    step = median_step([Decimal(stamp) for stamp in stamps_ns])
    return f"{1e9 / step:.3g} images/s" if step else "one image"
