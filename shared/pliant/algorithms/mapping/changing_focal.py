"""Whether the focal length changes during a clip, and by how much at each keyframe.

Zoom, focus breathing and cropped stabilisation do it, and a map with one focal length bends at
residuals that hardly grow.  The adjustment of all keyframes asks whether a focal length z_m of each
would explain what it leaves: how much less one linear step would cost with them (a score test), in
units of the variance of the residuals.  Errors of other kinds, of the rolling shutter for instance,
look like a z that jumps from keyframe to keyframe; what a camera does lasts for a while.  So z must
also vary by more than calibrations are believed, averaged over half a second; or else explain so
much that nothing else does.  It is asked at each adjustment of all keyframes while the clip runs,
since a bent map keeps only the observations that agree with it, and ``frame_focal`` says sooner.
"""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.bundle.problem import (
    BundleParameters,
    BundleProblem,
    BundleResult,
    CalibrationUncertainty,
)
from pliant.algorithms.bundle.schur import system_at
from pliant.algorithms.bundle.varying_focal import FocalWalk
from pliant.algorithms.mapping.keyframe import Keyframe
from pliant.algorithms.mapping.principal_point import with_principal_point

RATE = 0.05
"""Standard deviation of the log focal length a second later: weak beside what keyframes tell."""

SPREAD = 0.3
"""Of the log focal length in a clip."""

_GAIN = 25.0
"""Times what noise would gain by each focal length: real clips with one focal length gain up to 21,
zoomed ones from 30 on."""

_CERTAIN = 50.0
"""As ``_GAIN``, from which on the range does not matter: stabilised clips gain from 100 on."""

_RANGE = CalibrationUncertainty().focal
"""Of the log focal length: a standard deviation of a calibration that is believed.  Where errors of
other kinds gain more than 10 they range over up to 0.9 % in real clips."""

_ONE_STEP = 0.35
"""Share of the range that one step of the robust adjustment shows at least."""

_AVERAGED_S = 0.5
_PERCENTILES = (5.0, 95.0)


def gaps_s(keyframes: list[Keyframe]) -> F64:
    """(M - 1,) seconds between keyframes; inf where nobody knows."""
    stamps = np.array([keyframe.stamp_ns for keyframe in keyframes], np.int64)
    known = (stamps[:-1] >= 0) & (stamps[1:] > stamps[:-1])
    return np.where(known, 1e-9 * np.diff(stamps), np.inf)


def walk_from(start: F64, gaps: F64) -> FocalWalk:
    """The prior of the focal lengths of keyframes, and where they begin (M,)."""
    return FocalWalk(gaps_s=gaps, rate=RATE, spread=SPREAD, start=start)


def focal_range(log_focals: F64, gaps: F64) -> tuple[float, float]:
    """The least and the greatest log focal length (M,) that lasts for a while."""
    times = np.concatenate([[0.0], np.cumsum(np.where(np.isfinite(gaps), gaps, _AVERAGED_S))])
    first = np.searchsorted(times, times - 0.5 * _AVERAGED_S)
    stop = np.searchsorted(times, times + 0.5 * _AVERAGED_S, side="right")
    sums = np.concatenate([[0.0], np.cumsum(log_focals)])
    low, high = np.percentile((sums[stop] - sums[first]) / (stop - first), _PERCENTILES)
    return float(low), float(high)


class Evidence(NamedTuple):
    """gain: what focal lengths of their own would explain, times what noise would gain by them.
    log_focals: (M,) by one step.   gaps_s: (M - 1,)."""

    gain: float
    log_focals: F64
    gaps_s: F64

    @property
    def calls_for_more(self) -> bool:
        """Whether an adjustment with these unknowns is worth its time."""
        return self.confirmed_by(self.log_focals, _ONE_STEP)

    def confirmed_by(self, log_focals: F64, share: float = 1.0, known: bool = False) -> bool:
        """Whether log focal lengths (M,) range over as much as changes do, or the gain is certain.

        share: of that range.   known: they were found to change before, and the gain alone
        decides: focal lengths that hold a map together may have drifted over any range.
        """
        low, high = focal_range(log_focals, self.gaps_s)
        ranges = known or (high - low) / _RANGE > share
        return (self.gain > _GAIN and ranges) or self.gain > _CERTAIN


def evidence_of_change(
    problem: BundleProblem, found: BundleResult, parameters: BundleParameters,
    uncertainty: CalibrationUncertainty, gaps: F64,
) -> Evidence:  # fmt: skip
    """What an adjustment leaves that focal lengths which change would explain."""
    M, variance = len(problem.T_world_camera), found.residual_variance(problem)
    if M < 3 or variance == 0.0:
        return Evidence(0.0, np.zeros(M), gaps)
    # One focal length for all may be another one than was given: that is no change.
    wide = with_principal_point(uncertainty)
    wide = wide.model_copy(update={"focal": max(wide.focal, SPREAD)})
    walk = walk_from(np.zeros(M), gaps)
    gain, step = system_at(problem, found, parameters, wide, walk).gain_of_focal()
    return Evidence(gain / (M * variance), step, gaps)
