"""Camera trajectories: stamped poses, how two are matched in time, and map segments."""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F64, I64, Shape, check_arrays
from pliant.algorithms.geometry import matrix_to_pose, pose_to_matrix

MAX_DIFFERENCE_NS = 4_000_000
"""Two stamps farther apart than this are not the same instant (the peers' 0.004 s)."""


@dataclass(frozen=True, kw_only=True)
class Trajectory:
    """Poses of one camera in time order.

    stamps_ns: capture times, strictly increasing.
    T_world_camera: (N, 4, 4) poses that map camera points to world.

    Raises ValueError on wrong shapes or dtypes, repeated or unordered stamps, or values that are
    not finite.
    """

    stamps_ns: Annotated[I64, Shape("N")]
    T_world_camera: Annotated[F64, Shape("N", 4, 4)]

    def __post_init__(self) -> None:
        check_arrays(self)
        if np.any(np.diff(self.stamps_ns) <= 0):
            raise ValueError("stamps_ns: must increase from pose to pose")
        if not np.all(np.isfinite(self.T_world_camera)):
            raise ValueError("T_world_camera: a pose is not finite")

    def __len__(self) -> int:
        return len(self.stamps_ns)

    @property
    def positions(self) -> F64:
        """(N, 3) positions of the camera in the world."""
        return self.T_world_camera[:, :3, 3]

    @property
    def poses(self) -> F64:
        """(N, 7) poses (x, y, z, qx, qy, qz, qw) with qw >= 0."""
        return matrix_to_pose(self.T_world_camera)

    @staticmethod
    def from_poses(stamps_ns: I64, poses: F64) -> "Trajectory":
        """From (N,) stamps and (N, 7) poses; quaternions are normalised."""
        return Trajectory(
            stamps_ns=np.asarray(stamps_ns, np.int64),
            T_world_camera=pose_to_matrix(np.asarray(poses, np.float64).reshape(-1, 7)),
        )

    @staticmethod
    def empty() -> "Trajectory":
        """No poses: what a run that never started a map leaves."""
        return Trajectory(stamps_ns=np.zeros(0, np.int64), T_world_camera=np.zeros((0, 4, 4)))

    def select(self, rows: I64) -> "Trajectory":
        """The poses of some rows (increasing indices)."""
        return Trajectory(stamps_ns=self.stamps_ns[rows], T_world_camera=self.T_world_camera[rows])


def _nearest(queries: I64, stamps: I64) -> I64:
    """Index of the stamp closest to each query; the earlier one where two are equally close."""
    right = np.clip(np.searchsorted(stamps, queries), 0, len(stamps) - 1)
    left = np.maximum(right - 1, 0)
    return np.where(np.abs(queries - stamps[left]) <= np.abs(queries - stamps[right]), left, right)


def associate(
    stamps_a: I64, stamps_b: I64, *, max_difference_ns: int = MAX_DIFFERENCE_NS
) -> tuple[I64, I64]:
    """Match two increasing lists of stamps, one to one.

    A pair counts where each stamp is the other's nearest and they differ by at most
    ``max_difference_ns``.  Returns the rows in a and the rows in b, both (M,) and increasing.
    """
    if not len(stamps_a) or not len(stamps_b):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    b_of_a = _nearest(stamps_a, stamps_b)
    a_of_b = _nearest(stamps_b, stamps_a)
    rows_a = np.arange(len(stamps_a), dtype=np.int64)
    good = (a_of_b[b_of_a] == rows_a) & (np.abs(stamps_a - stamps_b[b_of_a]) <= max_difference_ns)
    return rows_a[good], b_of_a[good]
