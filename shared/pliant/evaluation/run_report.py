"""The values of report.json that evaluation needs, checked: the folder may be from elsewhere."""

import json
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, cast

from pliant.errors import ResultError

REPORT_NAME = "report.json"


@dataclass(frozen=True, kw_only=True)
class Segment:
    """One map segment: its id, first frame, and how many frames have a pose in it."""

    id: int
    first_frame: int
    frames: int


@dataclass(frozen=True, kw_only=True)
class RunReport:
    """frames: of the whole sequence.  None if the report has none.

    segments: in the order of time; None if the report does not list them (then the trajectory
    is taken as one segment).
    """

    frames: int | None
    initialisation_retries: int | None
    segments: tuple[Segment, ...] | None


def read_json(path: Path) -> dict[str, Any]:
    """A JSON object of a file; ResultError in one line where it is not one."""
    try:
        data: object = json.loads(path.read_bytes())
    except OSError as error:
        raise ResultError(f"{path}: cannot be read ({error.strerror})") from None
    except (ValueError, RecursionError) as error:
        raise ResultError(f"{path}: is not JSON ({str(error)[:80]})") from None
    if not isinstance(data, dict):
        raise ResultError(f"{path}: expected a JSON object")
    return cast("dict[str, Any]", data)


def _count(data: dict[str, Any], key: str, where: str) -> int | None:
    value: object = data.get(key)
    if value is None:
        return None
    if not isinstance(value, int) or isinstance(value, bool) or not 0 <= value < 2**62:
        raise ResultError(f"{where}: {key} must be a count (an integer from 0)")
    return value


def read_run_report(folder: Path) -> RunReport:
    """Read ``report.json`` of a result folder; all None if there is no such file.

    Keys read: frames, initialisation_retries, segments [{id, first_frame, frames}].  Others are
    left alone.  ResultError if one of them is not what it should be.
    """
    path = folder / REPORT_NAME
    if not path.exists():
        return RunReport(frames=None, initialisation_retries=None, segments=None)
    data = read_json(path)
    return RunReport(
        frames=_count(data, "frames", str(path)),
        initialisation_retries=_count(data, "initialisation_retries", str(path)),
        segments=_segments(data.get("segments"), path),
    )


def _segments(rows: object, path: Path) -> tuple[Segment, ...] | None:
    if rows is None:
        return None
    if not isinstance(rows, list):
        raise ResultError(f"{path}: segments must be a list")
    segments: list[Segment] = []
    for index, row in enumerate(cast("list[object]", rows)):
        where = f"{path}: segments[{index}]"
        if not isinstance(row, dict):
            raise ResultError(f"{where}: expected an object with id, first_frame, frames")
        data = cast("dict[str, Any]", row)
        values = {key: _count(data, key, where) for key in ("id", "first_frame", "frames")}
        for key, value in values.items():
            if value is None:
                raise ResultError(f"{where}: {key} is missing")
        segments.append(Segment(**cast("dict[str, int]", values)))
    for before, after in pairwise(segments):
        if after.first_frame <= before.first_frame:
            raise ResultError(f"{path}: segments must be in the order of their first_frame")
    return tuple(segments)
