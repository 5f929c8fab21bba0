"""Detection of a focal length that changes during a clip, and its value at each keyframe.

Zoom, focus breathing and cropped stabilisation change it, and a map with one focal length bends
while its residuals hardly grow.  The adjustment of all keyframes tests whether a focal length z_m
of each keyframe would explain its residuals: by how much one linear step would reduce the cost (a
score test), in units of the variance of the residuals.  Other errors, for instance of a rolling
shutter, look like a z that jumps between keyframes; a real change lasts for a while.  So z,
averaged over half a second, must also vary by more than the uncertainty of a calibration, or the
gain must be certain. The test runs at each adjustment of all keyframes during the clip, because a
bent map keeps only observations that agree with it; ``frame_focal`` detects large changes sooner.
"""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.slam.calibration.held_unknowns import PRINCIPAL_POINT, freed
from pliant.algorithms.slam.estimate.problem import (
    BundleParameters,
    BundleProblem,
    BundleResult,
    CalibrationUncertainty,
)
from pliant.algorithms.slam.estimate.schur import system_at
from pliant.algorithms.slam.estimate.varying_focal import FocalWalk
from pliant.algorithms.slam.map.keyframe import Keyframe

RATE = 0.05
"""Standard deviation of the log focal length after a second: weak compared with the keyframes."""

SPREAD = 0.3
"""Standard deviation of the log focal length within a clip."""

_GAIN = 25.0
"""Minimum gain in units of what noise gains: real clips with one focal length reach 21, zoomed ones
begin at 30.
"""

_CERTAIN = 50.0
"""Gain from which the range does not matter: stabilised clips begin at 100."""

_RANGE = CalibrationUncertainty().focal
"""Minimum range of the log focal length: a standard deviation of a trusted calibration.  Other
errors with a gain above 10 have a range of up to 0.9 % in real clips.
"""

_ONE_STEP = 0.35
"""Minimum share of the range that one step of the robust adjustment shows."""

_AVERAGED_S = 0.5
_PERCENTILES = (5.0, 95.0)


def gaps_s(keyframes: list[Keyframe]) -> F64:
    """(M - 1,) seconds between keyframes; inf where unknown."""
    stamps = np.array([keyframe.stamp_ns for keyframe in keyframes], np.int64)
    known = (stamps[:-1] >= 0) & (stamps[1:] > stamps[:-1])
    return np.where(known, 1e-9 * np.diff(stamps), np.inf)


def walk_from(start: F64, gaps: F64) -> FocalWalk:
    """Return the prior of the keyframes' focal lengths, and their initial values (M,)."""
    return FocalWalk(gaps_s=gaps, rate=RATE, spread=SPREAD, start=start)


def focal_range(log_focals: F64, gaps: F64) -> tuple[float, float]:
    """Return the smallest and the largest log focal length (M,) that lasts for a while."""
    times = np.concatenate([[0.0], np.cumsum(np.where(np.isfinite(gaps), gaps, _AVERAGED_S))])
    first = np.searchsorted(times, times - 0.5 * _AVERAGED_S)
    stop = np.searchsorted(times, times + 0.5 * _AVERAGED_S, side="right")
    sums = np.concatenate([[0.0], np.cumsum(log_focals)])
    low, high = np.percentile((sums[stop] - sums[first]) / (stop - first), _PERCENTILES)
    return float(low), float(high)


class Evidence(NamedTuple):
    """gain: of separate focal lengths, in units of what noise would gain.
    log_focals: (M,) by one step.   gaps_s: (M - 1,).
    """

    gain: float
    log_focals: F64
    gaps_s: F64

    @property
    def calls_for_more(self) -> bool:
        """Whether an adjustment with these unknowns is worthwhile."""
        return self.confirmed_by(self.log_focals, _ONE_STEP)

    def confirmed_by(self, log_focals: F64, share: float = 1.0, known: bool = False) -> bool:
        """Whether the log focal lengths (M,) have the range of a real change, or the gain is
        certain.

        share: of that range.   known: a change was found before, so the gain alone decides: the
        focal lengths that hold a map together may have drifted over any range.
        """
        low, high = focal_range(log_focals, self.gaps_s)
        ranges = known or (high - low) / _RANGE > share
        return (self.gain > _GAIN and ranges) or self.gain > _CERTAIN


def evidence_of_change(
    problem: BundleProblem, found: BundleResult, parameters: BundleParameters,
    uncertainty: CalibrationUncertainty, gaps: F64,
) -> Evidence:  # fmt: skip
    """Return the evidence of changing focal lengths in the residuals of an adjustment."""
    M, variance = len(problem.T_world_camera), found.residual_variance(problem)
    if M < 3 or variance == 0.0:
        return Evidence(0.0, np.zeros(M), gaps)
    # A common error of the given focal length is no change.
    wide = freed(uncertainty, PRINCIPAL_POINT)
    wide = wide.model_copy(update={"focal": max(wide.focal, SPREAD)})
    walk = walk_from(np.zeros(M), gaps)
    gain, step = system_at(problem, found, parameters, wide, walk).gain_of_focal()
    return Evidence(gain / (M * variance), step, gaps)
