"""The criteria of VITAMIN-E section 5.2, and relative errors, for matched poses.

Monocular scale is arbitrary: every accuracy here is after a Sim(3) alignment of the estimate to
ground truth, over all matched poses at once (Umeyama 1991), which is what ``evo_ape -as`` computes.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.geometry import align_umeyama, inverse, so3_log

MIN_POSES = 3
"""An alignment needs three poses."""

# Two matched poses more than this many frame intervals apart have a lost frame between them.
_GAP = 1.5


@dataclass(frozen=True, kw_only=True)
class Similarity:
    """``p_truth = scale * R @ p_estimate + t``."""

    scale: float
    R: F64
    t: F64

    def apply(self, points: F64) -> F64:
        """Map (N, 3) points of the estimate to the world of ground truth."""
        return self.scale * points @ self.R.T + self.t

    def apply_poses(self, T_world_camera: F64) -> F64:
        """Map (N, 4, 4) poses of the estimate to the world of ground truth; they stay rigid."""
        out = T_world_camera.copy()
        out[:, :3, :3] = self.R @ T_world_camera[:, :3, :3]
        out[:, :3, 3] = self.apply(T_world_camera[:, :3, 3])
        return out


@dataclass(frozen=True, kw_only=True)
class ErrorStatistics:
    """Statistics of a list of errors, in the unit of the errors."""

    rmse: float
    mean: float
    median: float
    std: float
    max: float
    count: int

    @staticmethod
    def of(errors: F64) -> "ErrorStatistics":
        """errors: (N,) with N >= 1; ValueError when there are none."""
        if not len(errors):
            raise ValueError("statistics of no errors")
        return ErrorStatistics(
            rmse=float(np.sqrt(np.mean(errors**2))),
            mean=float(errors.mean()),
            median=float(np.median(errors)),
            std=float(errors.std()),
            max=float(errors.max()),
            count=len(errors),
        )


@dataclass(frozen=True, kw_only=True)
class RelativeErrors:
    """Relative pose error over a step: translation in metres, rotation in degrees."""

    step: str
    translation_m: ErrorStatistics
    rotation_deg: ErrorStatistics


def align(estimate: F64, truth: F64) -> Similarity:
    """The Sim(3) that brings (N, 4, 4) poses of the estimate nearest to the true ones.

    Raises ValueError with a reason where there are fewer than three poses, or where the estimate
    or ground truth is static: the scale is undetermined.
    """
    positions, true_positions = estimate[:, :3, 3], truth[:, :3, 3]
    scale, R, t = align_umeyama(positions, true_positions, with_scale=True)
    extent = float(np.linalg.norm(true_positions - true_positions.mean(axis=0), axis=1).max())
    if extent <= 1e-9 or scale <= 0.0:
        raise ValueError("alignment needs a moving camera: all ground-truth positions are equal")
    return Similarity(scale=scale, R=R, t=t)


def absolute_errors(aligned: F64, truth: F64) -> F64:
    """(N,) distances in metres between aligned and true positions (the ATE before its RMSE)."""
    return np.linalg.norm(aligned[:, :3, 3] - truth[:, :3, 3], axis=1)


def path_length(T_world_camera: F64) -> float:
    """Metres along the positions of (N, 4, 4) poses."""
    return float(np.linalg.norm(np.diff(T_world_camera[:, :3, 3], axis=0), axis=1).sum())


def frame_pairs(stamps_ns: I64) -> tuple[I64, I64]:
    """Rows of consecutive frames.  Neighbours with a lost frame between them make no pair.

    A lost frame shows as an interval of more than 1.5 times the median interval.
    """
    intervals = np.diff(stamps_ns)
    if not len(intervals):
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    first = np.flatnonzero(intervals <= _GAP * np.median(intervals)).astype(np.int64)
    return first, first + 1


def second_pairs(stamps_ns: I64) -> tuple[I64, I64]:
    """Rows of poses a second apart: for each pose the one closest to a second later.

    It must be within half the median interval of it, else the pose has no partner.
    """
    if len(stamps_ns) < 2:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    wanted = stamps_ns + 1_000_000_000
    second = np.clip(np.searchsorted(stamps_ns, wanted), 1, len(stamps_ns) - 1)
    earlier_is_closer = wanted - stamps_ns[second - 1] <= stamps_ns[second] - wanted
    second = np.where(earlier_is_closer, second - 1, second)
    tolerance = 0.5 * float(np.median(np.diff(stamps_ns)))
    good = (np.abs(stamps_ns[second] - wanted) <= tolerance) & (second > np.arange(len(second)))
    return np.flatnonzero(good).astype(np.int64), second[good].astype(np.int64)


def relative_errors(
    aligned: F64, truth: F64, pairs: tuple[I64, I64], *, step: str
) -> RelativeErrors | None:
    """Relative pose error (Sturm et al. 2012, Eq. 1) over pairs of rows; None without pairs.

    aligned, truth: (N, 4, 4) poses, the estimate after its Sim(3) alignment.  For each pair the
    error is ``inverse(truth motion) @ (estimated motion)``, its translation and its angle.
    """
    first, second = pairs
    if not len(first):
        return None
    true_motion = inverse(truth[first]) @ truth[second]
    motion = inverse(aligned[first]) @ aligned[second]
    error = inverse(true_motion) @ motion
    return RelativeErrors(
        step=step,
        translation_m=ErrorStatistics.of(np.linalg.norm(error[:, :3, 3], axis=1)),
        rotation_deg=ErrorStatistics.of(
            np.degrees(np.linalg.norm(so3_log(error[:, :3, :3]), axis=1))
        ),
    )
