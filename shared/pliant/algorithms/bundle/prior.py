"""The Gaussian prior on camera poses: its cost, Hessian and gradient."""

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.bundle.layout import Unknowns
from pliant.algorithms.geometry import inverse, so3_log


def prior_cost(layout: Unknowns, cameras: F64) -> float:
    """``0.5 d^T H d + g^T d`` of ``CameraPrior``; 0 without a prior."""
    if layout.prior is None:
        return 0.0
    d = _departure(layout, cameras)
    return float(0.5 * d @ layout.prior.H @ d + layout.prior.g @ d)


def add_prior(layout: Unknowns, cameras: F64, moving: I64, S: F64, b: F64) -> None:
    """Add the prior's Hessian and negative gradient to the reduced system, in place.

    The departure is taken to change by the step itself, which is exact to first order in it.
    """
    if layout.prior is None:
        return
    d = _departure(layout, cameras)
    rows = (6 * moving[:, None] + np.arange(6)).reshape(-1)
    S[:] += layout.prior.H[np.ix_(rows, rows)]
    b[:] -= (layout.prior.H @ d + layout.prior.g)[rows]


def _departure(layout: Unknowns, cameras: F64) -> F64:
    """(6M,) steps (rho, theta) that lead from the poses of the prior to the cameras."""
    assert layout.prior is not None
    T = inverse(layout.prior.T_world_camera)
    R_old, t_old = T[:, :3, :3], T[:, :3, 3]
    R_new = cameras[:, :9].reshape(-1, 3, 3)
    t_new = cameras[:, 9:] - R_new @ layout.origin
    R = R_new @ np.swapaxes(R_old, -1, -2)
    rho = t_new - (R @ t_old[..., None])[..., 0]
    return np.concatenate([rho, so3_log(R)], axis=1).reshape(-1)
