"""Whether a given principal point is wrong.

A calibration of the whole image, used for a part of it that was cropped off centre, bends the map
at residuals that hardly grow.  So the adjustment of all keyframes asks how much less one linear
step would cost with the principal point free (a score test), in units of the variance of the
residuals.  Where that is far beyond noise and errors of the lens model the principal point becomes
an unknown; elsewhere it is held, since a map is more accurate with the right one held.
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
"""Times what noise would gain by each of its coordinates.  Calibrated sequences gain up to 50, ones
with a nominal calibration up to 220; an error of 1 % of the focal length gains 300 to 27,000, one
of 2 % under a rolling shutter 170."""


def with_principal_point(uncertainty: CalibrationUncertainty) -> CalibrationUncertainty:
    """With a principal point that is unknown."""
    width = max(uncertainty.principal_point, PRINCIPAL_POINT)
    return uncertainty.model_copy(update={"principal_point": width})


def contradicts_principal_point(
    problem: BundleProblem, found: BundleResult, parameters: BundleParameters,
    uncertainty: CalibrationUncertainty,
) -> bool:  # fmt: skip
    """Whether what an adjustment leaves calls for another principal point than the one it held."""
    variance = found.residual_variance(problem)
    if uncertainty.principal_point > 0.0 or variance == 0.0:
        return False
    system = system_at(problem, found, parameters, with_principal_point(uncertainty))
    return system.gain_of_principal_point() > 2.0 * _GAIN * variance
