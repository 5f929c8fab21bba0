"""KITTI trajectories: the top three rows of T_world_camera a line; times in a file of their own."""

from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import I64
from pliant.algorithms.geometry import quat_from_rotation, rotation_from_quat
from pliant.errors import ResultError
from pliant.formats.text import (
    build_trajectory,
    numbered_lines,
    parse_numbers,
    parse_seconds,
    write_lines,
)
from pliant.trajectory import Trajectory

ROTATION_TOLERANCE = 1e-3
"""Largest entry of R^T R - I: the benchmark's own files reach 1e-6."""


def read_kitti(path: Path, stamps_ns: I64) -> Trajectory:
    """Read and check every line.  ResultError names file and line of the first bad one.

    stamps_ns: (N,) time of each line, which the format does not hold (``read_kitti_times``).
    """
    lines: list[int] = []
    matrices: list[list[float]] = []
    for number, line in numbered_lines(path):
        fields = line.split()
        try:
            if len(fields) != 12:
                raise ValueError(f"{len(fields)} fields, expected 12: the top of T_world_camera")
            values = parse_numbers(fields)
            R = np.array(values).reshape(3, 4)[:, :3]
            if np.abs(R.T @ R - np.eye(3)).max() > ROTATION_TOLERANCE or np.linalg.det(R) < 0.0:
                raise ValueError("the left 3x3 block is not a rotation")
        except ValueError as error:
            raise ResultError(f"{path}:{number}: {error}") from None
        matrices.append(values)
        lines.append(number)
    if len(matrices) != len(stamps_ns):
        raise ResultError(f"{path}: holds {len(matrices)} poses for {len(stamps_ns)} times")
    T = np.zeros((len(matrices), 4, 4))
    T[:, 3, 3] = 1.0
    if len(matrices):
        T[:, :3] = np.array(matrices).reshape(-1, 3, 4)
        T[:, :3, :3] = rotation_from_quat(quat_from_rotation(T[:, :3, :3]))
    return build_trajectory(path, lines, stamps_ns.tolist(), T)


def read_kitti_times(path: Path) -> I64:
    """(N,) nanoseconds of ``times.txt``: one time in seconds a line."""
    stamps: list[int] = []
    for number, line in numbered_lines(path):
        try:
            stamps.append(parse_seconds(line))
        except ValueError as error:
            raise ResultError(f"{path}:{number}: {error}") from None
    return np.array(stamps, np.int64)


def write_kitti(path: Path, trajectory: Trajectory) -> None:
    """Ten significant digits: equal numbers give equal bytes.  The times are not in it."""
    rows = trajectory.T_world_camera[:, :3].reshape(-1, 12) + 0.0
    write_lines(path, (" ".join(f"{value:.9e}" for value in row) for row in rows.tolist()))
