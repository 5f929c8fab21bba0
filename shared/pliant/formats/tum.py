"""TUM trajectories: ``t tx ty tz qx qy qz qw`` a line, seconds, poses T_world_camera."""

from pathlib import Path

import numpy as np

from pliant.errors import ResultError
from pliant.formats.text import (
    build_trajectory,
    check_quaternion,
    format_fixed,
    format_seconds,
    numbered_lines,
    parse_numbers,
    parse_seconds,
    write_lines,
)
from pliant.trajectory import Trajectory


def read_tum(path: Path, *, allow_empty: bool = False) -> Trajectory:
    """Read and check every line.  ResultError names file and line of the first bad one.

    allow_empty: a file without poses is an empty trajectory (a run that found no map), no error.
    """
    lines: list[int] = []
    stamps: list[int] = []
    poses: list[list[float]] = []
    for number, line in numbered_lines(path):
        fields = line.split()
        try:
            if len(fields) != 8:
                raise ValueError(f"{len(fields)} fields, expected 8: t tx ty tz qx qy qz qw")
            stamps.append(parse_seconds(fields[0]))
            pose = parse_numbers(fields[1:])
            check_quaternion(pose[3:])
        except ValueError as error:
            raise ResultError(f"{path}:{number}: {error}") from None
        poses.append(pose)
        lines.append(number)
    return build_trajectory(path, lines, stamps, np.array(poses), allow_empty=allow_empty)


def write_tum(path: Path, trajectory: Trajectory) -> None:
    """Nine decimals everywhere, stamps exact: equal numbers give equal bytes."""
    write_lines(
        path,
        (
            f"{format_seconds(stamp)} {' '.join(format_fixed(value) for value in pose)}"
            for stamp, pose in zip(
                trajectory.stamps_ns.tolist(), trajectory.poses.tolist(), strict=True
            )
        ),
    )
