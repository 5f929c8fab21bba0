"""A prior on the pose of a camera, for the solvers of a pose.

With R, t of the camera, R_0, t_0 of the mean and E = R R_0^T, the cost is d^T L d, where

    d = (E^T t - t_0, vee(E - E^T) / 2),    d d / d (rho, theta) = diag(E^T, (tr(E) I - E) / 2):

the difference of the centres along the axes of the mean, and the axis of the rotation between the
two times the sine of its angle.  Near the mean that is the step (rho, theta) from it.
"""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.compiler.kernel import kernel

_CONTRADICTION = 4.0
"""Standard deviations: 1 of 1000 poses is farther away by chance."""


class PosePrior(NamedTuple):
    """A Gaussian prior of a pose, in units of observations with an error of 1 px.

    T_world_camera: (4, 4) its mean.   information: (6, 6) L, as of a ``PoseEstimate``.
    Infinity on the diagonal holds that part of the pose as it is at the start.
    """

    T_world_camera: F64 = np.eye(4)
    information: F64 = np.zeros((6, 6))

    def with_fixed_centre(self) -> "PosePrior":
        """Return it with a camera that may only rotate."""
        information = np.diag([np.inf] * 3 + [0.0] * 3)
        information[3:, 3:] = self.information[3:, 3:]
        return self._replace(information=information)

    def unless_contradicted(self, T_world_camera: F64) -> "PosePrior":
        """Return it, or none if a pose (4, 4) is many standard deviations away."""
        origin = T_world_camera[:3, 3]
        mean = shifted_motion(self.T_world_camera, origin)
        cost = prior_cost(shifted_motion(T_world_camera, origin), mean, self.information)
        return self if cost < _CONTRADICTION**2 else NO_PRIOR


NO_PRIOR = PosePrior()


def shifted_motion(T_world_camera: F64, origin: F64) -> F64:
    """(12,) motion of a camera, as of ``Cameras``, in the world shifted by the origin."""
    R = T_world_camera[:3, :3].T
    return np.concatenate([R.reshape(-1), R @ (origin - T_world_camera[:3, 3])])


@kernel
def add_prior(camera: F64, mean: F64, information: F64, normal: F64) -> None:
    """Add a prior's part to the equations (36,) of a camera (12,).

    mean: (12,).   information: (6, 6).   normal: as of ``linearise_camera``.
    """
    if not np.any(information != 0.0):
        return
    E, d, J, L = np.zeros((3, 3)), np.empty(6), np.zeros((6, 6)), np.empty((6, 6))
    for r in range(3):
        for c in range(3):
            for k in range(3):
                E[r, c] += camera[3 * r + k] * mean[3 * c + k]
    for r in range(3):
        a, b = (r + 1) % 3, (r + 2) % 3
        d[r] = E[0, r] * camera[9] + E[1, r] * camera[10] + E[2, r] * camera[11] - mean[9 + r]
        d[3 + r] = 0.5 * (E[b, a] - E[a, b])
        for c in range(3):
            J[r, c] = E[c, r]
            J[3 + r, 3 + c] = -0.5 * E[r, c]
        J[3 + r, 3 + r] += 0.5 * (E[0, 0] + E[1, 1] + E[2, 2])
    for a in range(6):
        for b in range(6):
            L[a, b] = information[a, b] if np.isfinite(information[a, b]) else 0.0
            normal[35] += d[a] * L[a, b] * d[b]
    for a in range(6):
        for b in range(6):
            for r in range(6):
                normal[28 + r] -= J[a, r] * L[a, b] * d[b]
                for c in range(r + 1):
                    normal[r * (r + 1) // 2 + c] += J[a, r] * L[a, b] * J[b, c]
    for held in range(6):
        if information[held, held] == np.inf:
            for r in range(7):
                low, high = min(r, held), max(r, held)
                normal[high * (high + 1) // 2 + low] = 1.0 if r == held else 0.0
            normal[28 + held] = 0.0


@kernel
def prior_cost(camera: F64, mean: F64, information: F64) -> float:
    """d^T L d of a camera (12,).   mean, information: as of ``add_prior``."""
    normal = np.zeros(36)
    add_prior(camera, mean, information, normal)
    return float(normal[35])
