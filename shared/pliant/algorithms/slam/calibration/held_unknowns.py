"""Whether fixed unknowns of a given calibration are wrong: principal point and aspect ratio.

A calibration of the whole image, used for a part that was cropped off centre, bends the map while
the residuals hardly grow.  So does one for square pixels after video was resized to another shape.
So the adjustment of all keyframes runs a score test for each of the two.  It computes by how much
one linear step with this unknown free would reduce the cost, in units of the variance of the
residuals.  All other unknowns are free in both cases, so that neither explains the error of the
other.  If the gain is far beyond noise and errors of the lens model, it becomes an unknown.
Otherwise it is fixed, because a map is more accurate with a correct one fixed.  Translation alone
shows no aspect ratio: it only stretches the map.
"""

from typing import NamedTuple

from pliant.algorithms.arrays import F64
from pliant.algorithms.slam.estimate.problem import (
    BundleParameters,
    BundleProblem,
    BundleResult,
    CalibrationUncertainty,
)
from pliant.algorithms.slam.estimate.schur import system_at

PRINCIPAL_POINT, ASPECT = "principal_point", "aspect"


class _Fixed(NamedTuple):
    """Unknowns of a correction that are freed together.

    sigma: their standard deviation when free.   gain: limit in units of what noise gains by each.
    """

    unknowns: slice
    sigma: float
    gain: float


_FIXED = {
    # Calibrated sequences gain up to 50, ones with a nominal calibration up to 220; an error of 1 %
    # of the focal length gains 300 to 27,000, one of 2 % under a rolling shutter 170.
    PRINCIPAL_POINT: _Fixed(slice(4, 6), 0.03, 100.0),
    # Calibrated sequences gain up to 26, ones with a nominal calibration up to 63; an error of 2 %
    # gains 58 to 210 once the camera has rotated.
    ASPECT: _Fixed(slice(6, 7), 0.01, 50.0),
}


def freed(uncertainty: CalibrationUncertainty, *names: str) -> CalibrationUncertainty:
    """Return the uncertainty with these unknowns free."""
    widths = {name: max(getattr(uncertainty, name), _FIXED[name].sigma) for name in names}
    return uncertainty.model_copy(update=widths)


def freed_as(uncertainty: CalibrationUncertainty, correction: F64) -> CalibrationUncertainty:
    """Return the uncertainty with the unknowns free that a correction (SHARED,) contains."""
    return freed(
        uncertainty, *(n for n, fixed in _FIXED.items() if correction[fixed.unknowns].any())
    )


def contradicted(
    problem: BundleProblem, found: BundleResult, parameters: BundleParameters,
    uncertainty: CalibrationUncertainty,
) -> list[str]:  # fmt: skip
    """Return the fixed unknowns that the residuals of an adjustment contradict."""
    variance = found.residual_variance(problem)
    names = [name for name in _FIXED if getattr(uncertainty, name) == 0.0]
    if not names or variance == 0.0:
        return []
    system = system_at(problem, found, parameters, freed(uncertainty, *names))
    wrong: list[str] = []
    for name in names:
        unknowns, _, gain = _FIXED[name]
        noise = (unknowns.stop - unknowns.start) * variance
        if system.gain_of_shared(unknowns) > gain * noise:
            wrong.append(name)
    return wrong
