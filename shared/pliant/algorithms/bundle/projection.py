"""One observation of one point: what every kernel of bundle adjustment has in common.

The residual is ``r = u - phi(T_camera_world p)``.  With x, y on the plane z = 1 and F the (2, 2)
Jacobian of the lens (focal lengths, radial distortion), the Jacobians of phi are ``F P`` for the
point and ``F B`` for the camera,

    P = (R_0 - x R_2, R_1 - y R_2) / z            R_k the rows of R_camera_world
    B = (1/z   0   -x/z    -x y      1 + x^2   -y)
        ( 0   1/z  -y/z  -(1 + y^2)    x y      x)

for ``T_camera_world' = (exp(theta), rho) T_camera_world`` with the step (rho, theta).  The lens
and the robust weight w enter only through ``M = w F^T F`` and ``e = w F^T r``: the Hessian blocks
are ``P^T M P``, ``B^T M B``, ``B^T M P`` and the negative gradients ``P^T e``, ``B^T e``.

All helpers work in the precision of their arguments: ``one`` is 1 in that precision.  Where there
is no distortion, ``lens`` and the off-diagonal of M are empty tuples; their lengths are known when
numba compiles, so that the code for distortion is dropped.
"""

from typing import Any

import numpy as np

from pliant.algorithms.kernel import inline_kernel

_Number = Any
_Camera = Any


@inline_kernel
def motion_of(cameras: Any, m: int) -> Any:
    """The 12 numbers of camera m, to stand in registers during a loop."""
    c = cameras[m]
    return (c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], c[9], c[10], c[11])


@inline_kernel
def pinhole_of(pinholes: Any, m: int) -> Any:
    """fx, fy, cx, cy of camera m."""
    k = pinholes[m]
    return (k[0], k[1], k[2], k[3])


@inline_kernel
def lens_of(lenses: Any, m: int) -> Any:
    """(k1, k2) of camera m; () where lenses is an empty one-dimensional array: no distortion."""
    if lenses.ndim == 1:
        return ()
    return (lenses[m, 0], lenses[m, 1])


@inline_kernel
def residual(
    one: _Number, T: _Camera, K: _Camera, lens: Any, X: Any, Y: Any, Z: Any, u: Any, v: Any,
    limits: Any,
) -> Any:  # fmt: skip
    """(x, y, 1/z, in front, residual u, residual v); behind the camera: finite nonsense."""
    z = T[6] * X + T[7] * Y + T[8] * Z + T[11]
    front = (z > limits[2]) & (abs(z) > limits[3])
    iz = one / (z if front else one)
    x = (T[0] * X + T[1] * Y + T[2] * Z + T[9]) * iz
    y = (T[3] * X + T[4] * Y + T[5] * Z + T[10]) * iz
    if len(lens) == 0:
        return x, y, iz, front, u - (K[0] * x + K[2]), v - (K[1] * y + K[3])
    n2 = x * x + y * y
    d = one + n2 * (lens[0] + lens[1] * n2)
    return x, y, iz, front, u - (K[0] * d * x + K[2]), v - (K[1] * d * y + K[3])


@inline_kernel
def robust_cost(one: _Number, du: Any, dv: Any, w: Any, front: Any, limits: Any) -> Any:
    """w rho(r^2), Geman-McClure; limits: see ``cost.Limits``."""
    s = du * du + dv * dv
    return w * (s / (one + s * limits[0]) if front else limits[1])


@inline_kernel
def observe(
    one: _Number, T: _Camera, K: _Camera, lens: Any, X: Any, Y: Any, Z: Any, u: Any, v: Any, w: Any,
    limits: Any,
) -> Any:  # fmt: skip
    """(x, y, 1/z, m00, m01, m11, e0, e1, cost): one observation linearised, see the module."""
    x, y, iz, front, du, dv = residual(one, T, K, lens, X, Y, Z, u, v, limits)
    s = du * du + dv * dv
    k = one / (one + s * limits[0])
    cost = w * (s * k if front else limits[1])
    weight = (w if front else one - one) * k * k
    if len(lens) == 0:
        gx, gy = weight * K[0], weight * K[1]
        return x, y, iz, gx * K[0], (), gy * K[1], gx * du, gy * dv, cost
    n2 = x * x + y * y
    d = one + n2 * (lens[0] + lens[1] * n2)
    two = one + one
    e = two * lens[0] + (two + two) * lens[1] * n2
    f00, f01 = K[0] * (d + e * x * x), K[0] * (e * x * y)
    f10, f11 = K[1] * (e * x * y), K[1] * (d + e * y * y)
    g00, g01, g10, g11 = weight * f00, weight * f01, weight * f10, weight * f11
    m00, m01, m11 = g00 * f00 + g10 * f10, g00 * f01 + g10 * f11, g01 * f01 + g11 * f11
    return x, y, iz, m00, (m01,), m11, g00 * du + g10 * dv, g01 * du + g11 * dv, cost


@inline_kernel
def apply_metric(m00: Any, m01: Any, m11: Any, a: Any, b: Any) -> Any:
    """M (a, b) for the symmetric M."""
    if len(m01) == 0:
        return m00 * a, m11 * b
    return m00 * a + m01[0] * b, m01[0] * a + m11 * b


@inline_kernel
def corner(m01: Any, factor: Any, zero: _Number) -> Any:
    """The off-diagonal of M times a factor."""
    if len(m01) == 0:
        return zero
    return m01[0] * factor


@inline_kernel
def point_rows(T: _Camera, x: Any, y: Any, iz: Any) -> Any:
    """The six numbers of P, row by row."""
    return (
        (T[0] - x * T[6]) * iz, (T[1] - x * T[7]) * iz, (T[2] - x * T[8]) * iz,
        (T[3] - y * T[6]) * iz, (T[4] - y * T[7]) * iz, (T[5] - y * T[8]) * iz,
    )  # fmt: skip


@inline_kernel
def solve_point(
    one: _Number, v00: Any, v10: Any, v11: Any, v20: Any, v21: Any, v22: Any, g0: Any, g1: Any,
    g2: Any, ok: Any, smallest: _Number,
) -> Any:  # fmt: skip
    """Solve a symmetric 3 x 3 system by Cholesky; 0 where not ok or not positive definite."""
    zero = one - one
    ok = ok & (v00 > zero)
    i00 = one / np.sqrt(v00 if ok else one)
    l10, l20 = v10 * i00, v20 * i00
    d11 = v11 - l10 * l10
    ok = ok & (d11 > smallest * v11)
    i11 = one / np.sqrt(d11 if ok else one)
    l21 = (v21 - l20 * l10) * i11
    d22 = v22 - l20 * l20 - l21 * l21
    ok = ok & (d22 > smallest * v22)
    i22 = one / np.sqrt(d22 if ok else one)
    y0 = g0 * i00
    y1 = (g1 - l10 * y0) * i11
    s2 = (g2 - l20 * y0 - l21 * y1) * i22 * i22
    s1 = (y1 - l21 * s2) * i11
    s0 = (y0 - l10 * s1 - l20 * s2) * i00
    return s0 if ok else zero, s1 if ok else zero, s2 if ok else zero
