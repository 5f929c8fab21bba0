"""The most probable scale, gravity and sensor of a camera's trajectory, given inertial samples.

An inertial-only maximum a posteriori estimate as in Campos, Montiel, Tardos: Inertial-Only
Optimization for Visual-Inertial Initialization, ICRA 2020, section III-B, whose residuals are those
of Forster et al. 2017, equation 45.  Three things differ, because the trajectory is finished and
the sensor unknown:

- The poses are measurements with noise, not constants: an estimate that takes them as exact finds
  too small a scale where the noise of positions resembles the motion.  Their standard deviations
  are estimated, too.
- The rotation and the lever arm between camera and sensor, and the offset of their clocks, are
  unknowns.
- Scale is a factor whose step is relative, ``s <- s (1 + d)``.  With rotations known, the residuals
  are linear in s, velocities, gravity, lever arm and bias, so that the first step is exact.

Unknowns of node i: the camera's rotation R_i, its position p_i in units of the map, the velocity
v_i of the sensor, and its biases, which walk at random (F-48).  Common unknowns: s, the direction
of gravity g, C = R_camera_imu, l = p_camera_imu, and the offset.  With the sensor's rotation
Q_i = R_i C and position P_i = s p_i + R_i l, and (dR, dv, dp) preintegrated over dt::

    r_R = Log(dR^T Q_i^T Q_j)
    r_v = Q_i^T (v_j - v_i - g dt) - dv
    r_p = Q_i^T (P_j - P_i - v_i dt - g dt^2 / 2) - dp

Rotations change by right factors: R_i Exp(a_i) and C Exp(c), so that Q_i turns by
q_i = C^T a_i + c.  Then, with J the inverse right Jacobian at r_R and y = Q_i^T (...)::

    d r_R = J (q_j - Q_j^T Q_i q_i) - J Exp(r_R)^T (d dR)
    d r_v = [y_v] q_i + Q_i^T (d v_j - d v_i - dt d g) - d dv
    d r_p = [y_p] q_i + Q_i^T (d P_j - d P_i - dt d v_i - dt^2 d g / 2) - d dp
    d P_i = s d p_i + s p_i d - R_i [l] a_i + R_i d l
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F64, I64, BoolArray, Shape
from pliant.algorithms.geometry import hat, so3_exp, so3_log
from pliant.algorithms.inertial.preintegration import Preintegrated, right_jacobian

_LEAST_STEP = 0.1
"""Factor of the scale in one step: it stays positive."""
GRAVITY_M_S2 = 9.81
"""Between 9.78 at the equator and 9.83 at the poles."""

SCALE, GRAVITY, TURN, LEVER, OFFSET = (
    slice(0, 1), slice(1, 3), slice(3, 6), slice(6, 9), slice(9, 10),
)  # fmt: skip
COMMON = 10
"""Common unknowns, in this order."""
ROTATION, POSITION, VELOCITY, GYRO, ACCEL = (
    slice(0, 3), slice(3, 6), slice(6, 9), slice(9, 12), slice(12, 15),
)  # fmt: skip
OWN = 15
"""Unknowns of a node, in this order."""


@dataclass(frozen=True, kw_only=True)
class Nodes:
    """Measured poses (N) of the camera, and which of the N - 1 intervals between them samples
    cover."""

    times_s: Annotated[F64, Shape("N")]
    R: Annotated[F64, Shape("N", 3, 3)]
    p: Annotated[F64, Shape("N", 3)]
    tied: BoolArray


@dataclass(frozen=True, kw_only=True)
class State:
    """The unknowns."""

    R: F64
    p: F64
    v: F64
    scale: float
    gravity: F64
    """(3,), of the length GRAVITY_M_S2, in the world of the map."""
    R_camera_imu: F64
    p_camera_imu: F64
    gyro_bias: F64
    accel_bias: F64
    offset_s: float

    def moved(self, common: F64, nodes: F64) -> "State":
        """After a step: (COMMON,) and (N, OWN)."""
        gravity = self.gravity + tangent(self.gravity) @ common[GRAVITY]
        return State(
            R=self.R @ so3_exp(nodes[:, ROTATION]),
            p=self.p + nodes[:, POSITION],
            v=self.v + nodes[:, VELOCITY],
            scale=self.scale * max(1.0 + float(common[0]), _LEAST_STEP),
            gravity=gravity * (GRAVITY_M_S2 / np.linalg.norm(gravity)),
            R_camera_imu=self.R_camera_imu @ so3_exp(common[TURN]),
            p_camera_imu=self.p_camera_imu + common[LEVER],
            gyro_bias=self.gyro_bias + nodes[:, GYRO],
            accel_bias=self.accel_bias + nodes[:, ACCEL],
            offset_s=self.offset_s + float(common[OFFSET][0]),
        )


def tangent(gravity: F64) -> F64:
    """(3, 2): by how much gravity changes per radian about two axes."""
    unit = gravity / np.linalg.norm(gravity)
    first = np.cross(unit, np.eye(3)[int(np.argmin(np.abs(unit)))])
    first = first / np.linalg.norm(first)
    axes: F64 = np.array([first, np.cross(unit, first)], np.float64).T
    return axes * float(np.linalg.norm(gravity))


@dataclass(frozen=True, kw_only=True)
class Linear:
    """Residuals (K, 9) of intervals, and their derivatives by both nodes (K, 9, OWN) and by the
    common unknowns (K, 9, COMMON)."""

    residual: F64
    by_first: F64
    by_second: F64
    by_common: F64


def linearised(state: State, sums: Preintegrated, first_nodes: I64) -> Linear:
    """Of K intervals, each from one of the nodes (K,) to the next; the equations above."""
    i, j = first_nodes, first_nodes + 1
    count, dt = len(sums.seconds), sums.seconds[:, None]
    C, lever = state.R_camera_imu, hat(state.p_camera_imu)
    R_i, R_j = state.R[i], state.R[j]
    Q_i, Q_j = R_i @ C, R_j @ C
    Q_t = Q_i.swapaxes(1, 2)
    step, swing = state.scale * (state.p[j] - state.p[i]), R_j - R_i
    P = step + swing @ state.p_camera_imu
    y_v = of_each(Q_t, state.v[j] - state.v[i] - state.gravity * dt)
    y_p = of_each(Q_t, P - state.v[i] * dt - 0.5 * state.gravity * dt**2)
    r_R = so3_log(sums.rotation.swapaxes(1, 2) @ Q_t @ Q_j)
    J = np.linalg.inv(right_jacobian(r_R))
    back = J @ so3_exp(-r_R)
    residual = np.concatenate([r_R, y_v - sums.velocity, y_p - sums.position], axis=1)
    first, second = np.zeros((2, count, 9, OWN))
    common = np.zeros((count, 9, COMMON))
    h = dt[:, :, None]
    by_turn = np.concatenate([-J @ Q_j.swapaxes(1, 2) @ Q_i, hat(y_v), hat(y_p)], axis=1)
    first[:, :, ROTATION] = by_turn @ C.T
    first[:, 6:9, ROTATION] += Q_t @ R_i @ lever
    first[:, 6:9, POSITION] = -state.scale * Q_t
    first[:, 3:6, VELOCITY] = -Q_t
    first[:, 6:9, VELOCITY] = -Q_t * h
    first[:, 0:3, GYRO] = -back @ sums.by_bias[:, 0:3, 0:3]
    first[:, 3:9, 9:15] -= sums.by_bias[:, 3:9]
    second[:, 0:3, ROTATION] = J @ C.T
    second[:, 6:9, ROTATION] = -Q_t @ R_j @ lever
    second[:, 6:9, POSITION] = state.scale * Q_t
    second[:, 3:6, VELOCITY] = Q_t
    common[:, :, TURN] = by_turn
    common[:, 0:3, TURN] += J
    common[:, 6:9, 0] = of_each(Q_t, step)
    by_gravity = Q_t @ tangent(state.gravity)
    common[:, 3:6, GRAVITY] = -by_gravity * h
    common[:, 6:9, GRAVITY] = -0.5 * by_gravity * h**2
    common[:, 6:9, LEVER] = Q_t @ swing
    common[:, 0:3, 9] = -of_each(back, sums.by_offset[:, 0:3])
    common[:, 3:9, 9] = -sums.by_offset[:, 3:9]
    return Linear(residual=residual, by_first=first, by_second=second, by_common=common)


def of_each(matrices: F64, vectors: F64) -> F64:
    """(K, n): the product of each matrix (K, n, m) with its vector (K, m)."""
    return (matrices @ vectors[:, :, None])[:, :, 0]
