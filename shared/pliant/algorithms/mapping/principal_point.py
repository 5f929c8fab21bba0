"""Whether a given principal point is wrong.

A calibration of the whole image, used for a part that was cropped off centre, bends the map while
the residuals hardly grow.  So the adjustment of all keyframes tests by how much one linear step
with a free principal point would reduce the cost (a score test), in units of the variance of the
residuals.  If that is far beyond noise and errors of the lens model, the principal point becomes an
unknown. Otherwise it is fixed, because a map is more accurate with a correct one fixed.
"""

from pliant.algorithms.bundle.problem import (
    BundleParameters,
    BundleProblem,
    BundleResult,
    CalibrationUncertainty,
)
from pliant.algorithms.bundle.schur import system_at

PRINCIPAL_POINT = 0.03
"""Standard deviation of an unknown principal point, as a share of the focal length."""

_GAIN = 100.0
"""Limit in units of what noise gains by each coordinate.  Calibrated sequences gain up to 50, ones
with a nominal calibration up to 220; an error of 1 % of the focal length gains 300 to 27,000, one
of 2 % under a rolling shutter 170.
"""


def with_principal_point(uncertainty: CalibrationUncertainty) -> CalibrationUncertainty:
    """Return the uncertainty with an unknown principal point."""
    width = max(uncertainty.principal_point, PRINCIPAL_POINT)
    return uncertainty.model_copy(update={"principal_point": width})


def contradicts_principal_point(
    problem: BundleProblem, found: BundleResult, parameters: BundleParameters,
    uncertainty: CalibrationUncertainty,
) -> bool:  # fmt: skip
    """Whether the residuals of an adjustment contradict the fixed principal point."""
    variance = found.residual_variance(problem)
    if uncertainty.principal_point > 0.0 or variance == 0.0:
        return False
    system = system_at(problem, found, parameters, with_principal_point(uncertainty))
    return system.gain_of_principal_point() > 2.0 * _GAIN * variance
