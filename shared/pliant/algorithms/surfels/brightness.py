"""What the brightness of a surfel tells where the lamp is at the camera (not in the paper).

A Lambertian surface at the distance d, whose normal is tilted by theta to its ray, then has the
grey level

    I = c a b,    b = cos(theta) / d^2,

with an albedo a that stays, and a factor c of the frame, its exposure.  Compared with the birth of
the surfel, marked 0, a patch of mean grey level I tells

    b = b_0 (I / I_0) / e,    e = c / c_0,

one equation for position and normal.  A stretched surface looks like one that has come closer, but
is not brighter.  e is the same for all surfels that were born in one frame: 1 if the exposure is
fixed, otherwise the median of what they tell at their present poses.  So a surfel that is born
later keeps e b_0 instead of b_0, with the e of its frame of birth: it is then compared with the
exposure of the first frame, as the others are, and one e remains for all.  Mean grey levels count,
since blur changes the contrast of a patch.

Of a surface that may stretch, size and shading together tell more than each alone.  So with this
light surfels have the general model of Table I with a soft isometry, and the residual
b / b_measured - 1.
"""

import math

import numpy as np

from pliant.algorithms.arrays import F64, U8, BoolArray
from pliant.algorithms.surfels.deformation_models import RIGID
from pliant.algorithms.surfels.patch_sampling import BIAS, GAIN, A, B, X
from pliant.compiler.kernel import fast_kernel

_LEAST_COSINE = 0.05


@fast_kernel
def brightness_row(pose: F64, out: F64) -> float:
    """Return b = cos(theta) / d^2 of a surfel, 1 / m^2, and fill its derivative.

    pose: (POSE_FLOATS,), camera's frame.  out: (6,), by a shift and a turn of the surfel:

        db/dX = b (n / (n u) - 3 u) / d,    db/domega = b (n x u) / (n u),    u = X / d.
    """
    x, y, z = pose[X], pose[X + 1], pose[X + 2]
    d = math.sqrt(x * x + y * y + z * z)
    u0, u1, u2 = x / d, y / d, z / d
    a0, a1, a2 = pose[A], pose[A + 1], pose[A + 2]
    b0, b1, b2 = pose[B], pose[B + 1], pose[B + 2]
    n0, n1, n2 = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
    length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    along = n0 * u0 + n1 * u1 + n2 * u2
    cosine = max(abs(along) / length, _LEAST_COSINE)
    b = cosine / (d * d)
    scale = (b if along > 0.0 else -b) / (cosine * length)
    n0, n1, n2 = n0 * scale, n1 * scale, n2 * scale
    out[0], out[1], out[2] = (
        (n0 - 3.0 * b * u0) / d,
        (n1 - 3.0 * b * u1) / d,
        (n2 - 3.0 * b * u2) / d,
    )
    out[3], out[4], out[5] = n1 * u2 - n2 * u1, n2 * u0 - n0 * u2, n0 * u1 - n1 * u0
    return float(b)


@fast_kernel
def _brightness(poses: F64, out: F64) -> None:
    row = np.zeros(RIGID)
    for k in range(len(poses)):
        out[k] = brightness_row(poses[k], row)


def brightness(poses: F64) -> F64:
    """(N,) b of the surfels, 1 / m^2.  poses: (N, POSE_FLOATS), camera's frame."""
    out = np.zeros(len(poses))
    _brightness(poses, out)
    return out


def measured_brightness(
    poses: F64, births: F64, means: F64, residuals: F64, rows: BoolArray
) -> F64:
    """(N,) b of the surfels by the mean grey levels of their patches, 1 / m^2.

    births: (N,) b at birth, at the exposure of the first frame.  means: (N,) of the templates,
    whose grey levels are those of birth.  residuals: (N,) mean of gain (I - mean) + bias -
    template.  rows: (N,) which surfels tell the exposure; none if it is fixed.
    """
    now = means + (residuals - poses[:, BIAS]) / poses[:, GAIN]
    measured = births * np.maximum(now, 1.0) / np.maximum(means, 1.0)
    return measured / (np.median((measured / brightness(poses))[rows]) if rows.any() else 1.0)


def exposure(poses: F64, births: F64, means: F64, rows: BoolArray) -> float:
    """Exposure of a frame relative to the first one, from surfels that are aligned with it.

    As above; 1 without rows.
    """
    everyone = np.zeros(len(poses), np.bool_)
    measured = measured_brightness(poses, births, means, np.zeros(len(poses)), everyone)
    return float(np.median((measured / brightness(poses))[rows])) if rows.any() else 1.0


@fast_kernel
def add_light(poses: F64, measured: F64, weight: float, rows: U8, H: F64, g: F64) -> None:
    """Add the matrices and half of the gradients of weight (b / measured - 1)^2.

    rows: (N,) 1 or 0.  H: (N, 6, 6).  g: (N, 6).
    """
    row = np.zeros(RIGID)
    for s in range(len(poses)):
        if not rows[s]:
            continue
        off = brightness_row(poses[s], row) / measured[s] - 1.0
        for k in range(RIGID):
            row[k] /= measured[s]
        for k in range(RIGID):
            g[s, k] += weight * off * row[k]
            for m in range(RIGID):
                H[s, k, m] += weight * row[k] * row[m]
