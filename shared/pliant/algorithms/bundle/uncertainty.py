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
    readout: float = Field(
        default=0.1,
        ge=0.0,
        description="Standard deviation of the readout of a rolling shutter, as a share of the "
        "frame interval; 0: every row is taken at once",
    )
    prior_px: float = Field(
        default=1.0,
        gt=0.0,
        description="Weight of this prior: one standard deviation costs as much as a residual of "
        "this many px of one observation",
    )

    @property
    def sigmas(self) -> F64:
        """(4,) of the focal factor's logarithm, k1, k2 and the readout."""
        return np.array([self.focal, self.k1, self.k2, self.readout])
