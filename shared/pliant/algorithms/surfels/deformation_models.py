"""What a surfel may do (DSDT, Eq. 6 and Table I), and how its patch follows.

The parameters of a step are: translation of the centre (3, metres), rotation about it (3, rad,
applied from the left), those of F (Table I), gain and bias.  All in the camera frame.

Table I prints the equiareal tensor as [[alpha, beta], [beta, (1 + beta) / alpha]].  Area is kept
when det F = 1, that is alpha f22 - beta^2 = 1, hence f22 = (1 + beta^2) / alpha, which is used
here: the printed entry has lost its square.
"""

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.surfels.patch_sampling import BIAS, GAIN, POSE_FLOATS, A, B, F, Level, X
from pliant.algorithms.surfels.photometric import FEATURES
from pliant.compiler.kernel import fast_kernel

ISOMETRIC, EQUIAREAL, GENERAL = 0, 2, 3
MODELS = {"isometric": ISOMETRIC, "equiareal": EQUIAREAL, "general": GENERAL}
"""Columns of Table I, by the number of parameters that F has.  The conformal one is left out:
whatever stretches is nearer to ground truth with one of the last two."""

RIGID = 6
MOST_PARAMETERS = RIGID + 3 + 2

_MIN_STRETCH, _MAX_STRETCH = 0.2, 5.0

_TERMS = 13
"""Of the series of sine and cosine: the next one is below 1e-15 at half a turn."""


@fast_kernel(inline=True)
def parameter_count(model: int) -> int:
    """Parameters of a step: 6, those of F, gain and bias."""
    return RIGID + model + 2


@fast_kernel
def deformation_directions(model: int, pose: F64, k: int) -> tuple[float, float, float]:
    """Derivative of (f11, f12, f22) with respect to the k-th parameter of F."""
    if model == EQUIAREAL:
        alpha, beta = pose[F], pose[F + 1]
        if k == 0:
            return 1.0, 0.0, -(1.0 + beta * beta) / (alpha * alpha)
        return 0.0, 1.0, 2.0 * beta / alpha
    return (1.0, 0.0, 0.0) if k == 0 else ((0.0, 1.0, 0.0) if k == 1 else (0.0, 0.0, 1.0))


@fast_kernel
def mixing(pose: F64, level: Level, model: int, out: F64) -> None:
    """The (FEATURES, parameters) matrix that mixes the sums' features into Jacobian rows.

    A displacement dX of the point X + i a + j b moves the patch along its grid by (w1, w2), where
    dX = w1 a + w2 b + s (X + i a + j b): along the ray nothing changes.  With the rows n1, n2, n3
    of [a b X]^-1 that is w1 = n1 dX - i n3 dX and w2 = n2 dX - j n3 dX.
    """
    su, sv = level.step_u, level.step_v
    f11, f12, f22 = pose[F], pose[F + 1], pose[F + 2]
    a0, a1, a2 = pose[A], pose[A + 1], pose[A + 2]
    b0, b1, b2 = pose[B], pose[B + 1], pose[B + 2]
    g0, g1, g2 = su * (f11 * a0 + f12 * b0), su * (f11 * a1 + f12 * b1), su * (f11 * a2 + f12 * b2)
    h0, h1, h2 = sv * (f12 * a0 + f22 * b0), sv * (f12 * a1 + f22 * b1), sv * (f12 * a2 + f22 * b2)
    x0, x1, x2 = pose[X], pose[X + 1], pose[X + 2]
    c0, c1, c2 = g1 * h2 - g2 * h1, g2 * h0 - g0 * h2, g0 * h1 - g1 * h0
    scale = 1.0 / (c0 * x0 + c1 * x1 + c2 * x2)
    n = (
        (scale * (h1 * x2 - h2 * x1), scale * (h2 * x0 - h0 * x2), scale * (h0 * x1 - h1 * x0)),
        (scale * (x1 * g2 - x2 * g1), scale * (x2 * g0 - x0 * g2), scale * (x0 * g1 - x1 * g0)),
        (scale * c0, scale * c1, scale * c2),
    )
    parameters = parameter_count(model)
    out[:, :parameters] = 0.0
    for k in range(3):
        out[0, k], out[1, k], out[2, k], out[5, k] = n[0][k], n[1][k], -n[2][k], -n[2][k]
    turns = (
        ((0.0, -g2, g1), (0.0, -h2, h1)),
        ((g2, 0.0, -g0), (h2, 0.0, -h0)),
        ((-g1, g0, 0.0), (-h1, h0, 0.0)),
    )
    for k in range(3):
        _turn(out, 3 + k, n, turns[k][0], turns[k][1])
    for k in range(model):
        d11, d12, d22 = deformation_directions(model, pose, k)
        _turn(
            out, RIGID + k, n,
            (su * (d11 * a0 + d12 * b0), su * (d11 * a1 + d12 * b1), su * (d11 * a2 + d12 * b2)),
            (sv * (d12 * a0 + d22 * b0), sv * (d12 * a1 + d22 * b1), sv * (d12 * a2 + d22 * b2)),
        )  # fmt: skip
    gain = parameters - 2
    # The feature is the texture; the residual's derivative is the frame, (T - bias) / gain.
    out[8, gain], out[9, gain] = 1.0 / pose[GAIN], -pose[BIAS] / pose[GAIN]
    out[9, gain + 1] = 1.0


@fast_kernel(inline=True)
def _turn(
    out: F64,
    column: int,
    n: tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]],
    a: tuple[float, float, float],
    b: tuple[float, float, float],
) -> None:
    """Column of a motion dX = i a + j b, which leaves the centre where it is."""
    out[2, column] = n[0][0] * a[0] + n[0][1] * a[1] + n[0][2] * a[2]
    out[3, column] = n[0][0] * b[0] + n[0][1] * b[1] + n[0][2] * b[2]
    out[4, column] = n[1][0] * a[0] + n[1][1] * a[1] + n[1][2] * a[2]
    out[5, column] = n[1][0] * b[0] + n[1][1] * b[1] + n[1][2] * b[2]
    out[6, column] = -(n[2][0] * a[0] + n[2][1] * a[1] + n[2][2] * a[2])
    out[7, column] = -(n[2][0] * b[0] + n[2][1] * b[1] + n[2][2] * b[2])


@fast_kernel
def hessian(matrix: F64, share: float, mix: F64, parameters: int, scratch: F64, H: F64) -> None:
    """H = share mix' matrix mix, of the photometric cost alone.

    share: of the texture that is seen.  scratch: (FEATURES, MOST_PARAMETERS).
    """
    gain = parameters - 2
    for row in range(FEATURES):
        m, out = matrix[row], scratch[row]
        for k in range(3):
            out[k] = share * _shifted(m[0], m[1], m[2], m[5], mix, k)
        for k in range(3, gain):
            out[k] = share * _turned(m[2], m[3], m[4], m[5], m[6], m[7], mix, k)
        out[gain] = share * (m[8] * mix[8, gain] + m[9] * mix[9, gain])
        out[gain + 1] = share * m[9] * mix[9, gain + 1]
    s = scratch
    for c in range(parameters):
        for row in range(min(c + 1, 3)):
            H[c, row] = H[row, c] = _shifted(s[0, c], s[1, c], s[2, c], s[5, c], mix, row)
        for row in range(3, min(c + 1, gain)):
            H[c, row] = H[row, c] = _turned(
                s[2, c], s[3, c], s[4, c], s[5, c], s[6, c], s[7, c], mix, row
            )
        if c >= gain:
            H[c, gain] = H[gain, c] = s[8, c] * mix[8, gain] + s[9, c] * mix[9, gain]
    H[gain + 1, gain + 1] = s[9, gain + 1] * mix[9, gain + 1]


@fast_kernel(inline=True)
def _shifted(f0: float, f1: float, f2: float, f5: float, mix: F64, column: int) -> float:
    """Product with a column of ``mixing`` that shifts the centre: its other rows are zero."""
    return f0 * mix[0, column] + f1 * mix[1, column] + f2 * mix[2, column] + f5 * mix[5, column]


@fast_kernel(inline=True)
def _turned(
    f2: float, f3: float, f4: float, f5: float, f6: float, f7: float, mix: F64, column: int
) -> float:
    """Product with a column of ``mixing`` that turns or deforms the patch."""
    left = f2 * mix[2, column] + f3 * mix[3, column] + f4 * mix[4, column]
    return left + f5 * mix[5, column] + f6 * mix[6, column] + f7 * mix[7, column]


@fast_kernel
def gradient(sums: F64, mix: F64, parameters: int, g: F64) -> None:
    """g = mix' sums: half of the gradient of the photometric cost."""
    for row in range(parameters):
        total = 0.0
        for k in range(FEATURES):
            total += mix[k, row] * sums[k]
        g[row] = total


@fast_kernel
def apply_step(pose: F64, step: F64, model: int, out: F64) -> None:
    """Eq. 6: move, turn and deform a surfel.  pose, out: (POSE_FLOATS,)."""
    for k in range(POSE_FLOATS):
        out[k] = pose[k]
    for k in range(3):
        out[X + k] += step[k]
    for tangent in range(A, F, B - A):
        _rotate(out, tangent, step[3], step[4], step[5])
    if model == EQUIAREAL:
        alpha = min(max(pose[F] + step[RIGID], _MIN_STRETCH), _MAX_STRETCH)
        beta = pose[F + 1] + step[RIGID + 1]
        out[F], out[F + 1], out[F + 2] = alpha, beta, (1.0 + beta * beta) / alpha
    elif model == GENERAL:
        for k in range(3):
            out[F + k] += step[RIGID + k]
        out[F] = min(max(out[F], _MIN_STRETCH), _MAX_STRETCH)
        out[F + 2] = min(max(out[F + 2], _MIN_STRETCH), _MAX_STRETCH)
    parameters = parameter_count(model)
    out[GAIN] = pose[GAIN] + step[parameters - 2]
    out[BIAS] = pose[BIAS] + step[parameters - 1]


@fast_kernel
def _rotate(pose: F64, start: int, wx: float, wy: float, wz: float) -> None:
    """Turn one tangent by a rotation vector (Rodrigues), of half a turn at most.

    sin a / a and (1 - cos a) / a^2 as series: those of the C library differ in their last bits
    with what the processor can do.
    """
    x, y, z = pose[start], pose[start + 1], pose[start + 2]
    squared = wx * wx + wy * wy + wz * wz
    s, c = 1.0, 1.0
    for k in range(_TERMS, 0, -1):
        s = 1.0 - squared * s / (2 * k * (2 * k + 1))
        c = 1.0 - squared * c / ((2 * k + 1) * (2 * k + 2))
    c *= 0.5
    ux, uy, uz = wy * z - wz * y, wz * x - wx * z, wx * y - wy * x
    pose[start] = x + s * ux + c * (wy * uz - wz * uy)
    pose[start + 1] = y + s * uy + c * (wz * ux - wx * uz)
    pose[start + 2] = z + s * uz + c * (wx * uy - wy * ux)


def identity_poses(count: int) -> F64:
    """(count, POSE_FLOATS) rows with F = I, gain 1, everything else 0."""
    poses = np.zeros((count, POSE_FLOATS))
    poses[:, F] = poses[:, F + 2] = poses[:, GAIN] = 1.0
    return poses


def move_poses(poses: F64, T: F64) -> F64:
    """Surfels in another frame: (N, POSE_FLOATS) rows moved by a (4, 4) rigid motion."""
    out = poses.copy()
    R = T[:3, :3]
    out[:, X : X + 3] = poses[:, X : X + 3] @ R.T + T[:3, 3]
    out[:, A : A + 3] = poses[:, A : A + 3] @ R.T
    out[:, B : B + 3] = poses[:, B : B + 3] @ R.T
    return out
