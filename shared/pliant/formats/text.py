"""Common parts of the text formats of trajectories: checked lines in, exact numbers out."""

from collections.abc import Iterable, Iterator, Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.errors import ResultError
from pliant.files import write_whole
from pliant.text_files import decoded
from pliant.trajectory import Trajectory

QUATERNION_TOLERANCE = 0.01
"""Largest distance of a quaternion's length from 1: files round to four digits, or worse."""

_NS = 1_000_000_000
_SHOWN = 40


def numbered_lines(path: Path) -> Iterator[tuple[int, str]]:
    """Line numbers (from 1) and text, without blank lines and comments (#)."""
    try:
        text = decoded(path.read_bytes())
    except FileNotFoundError:
        raise ResultError(f"{path}: no such file") from None
    except IsADirectoryError:
        raise ResultError(f"{path}: is a folder, expected a trajectory file") from None
    except OSError as error:
        raise ResultError(f"{path}: cannot be read ({error.strerror})") from None
    except UnicodeDecodeError:
        raise ResultError(f"{path}: is not a text file") from None
    for number, line in enumerate(text.splitlines(), start=1):
        stripped = line.strip()
        if stripped and not stripped.startswith("#"):
            yield number, stripped


def shorten(text: str) -> str:
    """At most 40 characters of a bad text, quoted, for an error message."""
    return repr(text if len(text) <= _SHOWN else text[: _SHOWN - 3] + "...")


def parse_seconds(text: str) -> int:
    """Decimal seconds to integer nanoseconds, exactly (rounded beyond the ninth digit).

    Raises ValueError if the text is not a finite number or does not fit 64 bits.
    """
    try:
        value = Decimal(text)
    except InvalidOperation:
        raise ValueError(f"{shorten(text)} is not a time in seconds") from None
    # The size is looked at before the number is made an integer: 1e999999 would fill the memory.
    if "_" in text or not value.is_finite() or (value and value.adjusted() > 9):
        raise ValueError(f"{shorten(text)} is not a time in seconds")
    return int((value * _NS).to_integral_value())


def format_seconds(stamp_ns: int) -> str:
    """Integer nanoseconds as decimal seconds with nine digits, exactly."""
    whole, rest = divmod(abs(int(stamp_ns)), _NS)
    return f"{'-' if stamp_ns < 0 else ''}{whole}.{rest:09d}"


def parse_nanoseconds(text: str) -> int:
    """An integer number of nanoseconds that fits 64 bits; ValueError otherwise."""
    digits = text.removeprefix("-")
    good = digits.isascii() and digits.isdigit() and len(digits) <= 19
    if not good or int(digits) >= 2**63:
        raise ValueError(f"{shorten(text)} is not a time in integer nanoseconds")
    return int(text)


def parse_numbers(fields: Iterable[str]) -> list[float]:
    """Texts to finite floats; ValueError names the one that is not."""
    numbers: list[float] = []
    for field in fields:
        try:
            number = float(field) if "_" not in field else float("nan")
        except ValueError:
            raise ValueError(f"{shorten(field)} is not a number") from None
        if not np.isfinite(number):
            raise ValueError(f"{shorten(field)} is not a finite number")
        numbers.append(number)
    return numbers


def check_quaternion(quaternion: Sequence[float]) -> None:
    """ValueError unless four numbers have length 1 within QUATERNION_TOLERANCE."""
    length = float(np.linalg.norm(quaternion))
    if abs(length - 1.0) > QUATERNION_TOLERANCE:
        raise ValueError(f"the quaternion has length {length:.4g}, expected 1")


def build_trajectory(
    path: Path, lines: list[int], stamps_ns: list[int], poses: F64, *, allow_empty: bool = False
) -> Trajectory:
    """Check that times increase and make the Trajectory; errors name file and line.

    lines: line number of each pose.  poses: (N, 7) poses or (N, 4, 4) matrices.
    """
    if not stamps_ns:
        if allow_empty:
            return Trajectory.empty()
        raise ResultError(f"{path}: holds no poses")
    stamps: I64 = np.asarray(stamps_ns, np.int64)
    backwards = np.flatnonzero(np.diff(stamps) <= 0)
    if len(backwards):
        row = int(backwards[0]) + 1
        how = "repeats" if stamps[row] == stamps[row - 1] else "is earlier than"
        raise ResultError(
            f"{path}:{lines[row]}: the time {format_seconds(int(stamps[row]))} s {how} "
            f"that of the pose before; poses must be in time order"
        )
    if poses.ndim == 3:
        return Trajectory(stamps_ns=stamps, T_world_camera=poses)
    return Trajectory.from_poses(stamps, poses)


def format_fixed(number: float, digits: int = 9) -> str:
    """A float with a fixed number of decimals; there is no minus zero."""
    return f"{round(float(number), digits) + 0.0:.{digits}f}"


def write_lines(path: Path, lines: Iterable[str]) -> None:
    """Write lines ending in \\n; a failing disk is one clear line (ResultError)."""
    write_bytes(path, "".join(f"{line}\n" for line in lines).encode("ascii"))


def write_bytes(path: Path, data: bytes) -> None:
    """Write a file, whole or not at all; a failing disk is one clear line (ResultError)."""
    try:
        write_whole(path, data, synced=False)
    except OSError as error:
        raise ResultError(f"{path}: cannot be written ({error.strerror})") from None
