"""EuRoC (ASL) trajectories: CSV, integer nanoseconds, position, quaternion with w first."""

from pathlib import Path

import numpy as np

from pliant.errors import ResultError
from pliant.formats.text import (
    build_trajectory,
    check_quaternion,
    format_fixed,
    numbered_lines,
    parse_nanoseconds,
    parse_numbers,
    write_lines,
)
from pliant.trajectory import Trajectory

_HEADER = (
    "#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z []"
)
# state_groundtruth_estimate0 continues with velocity (3) and two biases (6).
_FIELD_COUNTS = (8, 17)


def read_euroc(path: Path) -> Trajectory:
    """Read and check every line.  ResultError names file and line of the first bad one.

    The ground truth of a EuRoC sequence is that of the body; its camera's is
    ``T_world_body @ T_body_camera``, which is the caller's to apply.
    """
    lines: list[int] = []
    stamps: list[int] = []
    poses: list[list[float]] = []
    for number, line in numbered_lines(path):
        fields = [field.strip() for field in line.removesuffix(",").split(",")]
        try:
            if len(fields) not in _FIELD_COUNTS:
                raise ValueError(
                    f"{len(fields)} fields, expected 8 (t x y z qw qx qy qz) or 17 with the state"
                )
            stamps.append(parse_nanoseconds(fields[0]))
            x, y, z, qw, qx, qy, qz = parse_numbers(fields[1:8])
            check_quaternion((qx, qy, qz, qw))
        except ValueError as error:
            raise ResultError(f"{path}:{number}: {error}") from None
        poses.append([x, y, z, qx, qy, qz, qw])
        lines.append(number)
    return build_trajectory(path, lines, stamps, np.array(poses))


def write_euroc(path: Path, trajectory: Trajectory) -> None:
    """Stamps as they are, nine decimals elsewhere: equal numbers give equal bytes."""
    rows = [_HEADER]
    for stamp, pose in zip(trajectory.stamps_ns.tolist(), trajectory.poses.tolist(), strict=True):
        x, y, z, qx, qy, qz, qw = (format_fixed(value) for value in pose)
        rows.append(f"{stamp},{x},{y},{z},{qw},{qx},{qy},{qz}")
    write_lines(path, rows)
