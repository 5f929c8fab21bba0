"""How well a calibration is known: the prior of its correction."""

import numpy as np
from pydantic import Field

from pliant.algorithms.arrays import F64
from pliant.algorithms.parameters import Parameters


class CalibrationUncertainty(Parameters):
    """How far the given calibration may be wrong: standard deviations of a prior at 0."""

    focal: float = Field(
        default=0.01,
        ge=0.0,
        description="Standard deviation of the focal length, as a share of it; 0 holds it",
    )
    k1: float = Field(
        default=0.01,
        ge=0.0,
        description="Standard deviation of the radial distortion k1 after rectification; 0: held",
    )
    k2: float = Field(
        default=0.0,
        ge=0.0,
        description="Standard deviation of the radial distortion k2 after rectification; 0: held",
    )
    prior_px: float = Field(
        default=1.0,
        gt=0.0,
        description="Weight of this prior: one standard deviation costs as much as a residual of "
        "this many px of one observation",
    )

    @property
    def sigmas(self) -> F64:
        """(3,) of the focal factor's logarithm, k1 and k2."""
        return np.array([self.focal, self.k1, self.k2])
