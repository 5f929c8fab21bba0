"""One observation of one point, one step of one camera: common code of the kernels.

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

from typing import Any, NamedTuple, TypeAlias

import numpy as np
from numpy.typing import DTypeLike

from pliant.algorithms.arrays import F64
from pliant.algorithms.slam.estimate.problem import BundleParameters
from pliant.compiler.kernel import fast_kernel, kernel

_Number: TypeAlias = Any
_Camera: TypeAlias = Any
_Point: TypeAlias = tuple[Any, Any, Any]

_BEHIND_PX2 = 1e8
"""Squared residual behind a camera without a kernel; above all real ones, and constant."""

_SINGULAR = 1e-12
_LEAST_DISTANCE = 1e-6
"""Map units.  A point that may lie behind a camera must still not lie in the camera's plane."""


class Cameras(NamedTuple):
    """The cameras of a problem, all in one precision.

    motion: (M, 12) R_camera_world by rows, then t_camera_world; of the shifted world.
    pinhole: (M, 4) fx, fy, cx, cy.      lens: (M, 2) k1, k2; (0,) where none has distortion.
    """

    motion: Any
    pinhole: Any
    lens: Any

    def single(self) -> "Cameras":
        """In float32."""
        return Cameras(*(np.asarray(each, np.float32) for each in self))


class Seen(NamedTuple):
    """Pixel and weight of an observation; or arrays of these."""

    u: Any
    v: Any
    w: Any


class Triangle(NamedTuple):
    """The lower triangle of a (3, 3) matrix, by rows."""

    xx: Any
    yx: Any
    yy: Any
    zx: Any
    zy: Any
    zz: Any


class Limits(NamedTuple):
    """Of the robust kernel and the camera's front, in the precision of a kernel's arithmetic.

    Geman-McClure: ``rho(s) = s / (1 + s / sigma^2)``, weight ``rho'(s) = 1 / (1 + s / sigma^2)^2``,
    s the squared residual.  rho(s) ~ s near 0 and saturates at sigma^2, which is what a point
    behind a camera costs.

    inverse_sigma2: 1 / sigma^2, 1 / px^2.    behind: cost of a point behind its camera, px^2.
    min_depth, min_distance: least depth, least distance from the camera's plane, map units.
    """

    inverse_sigma2: Any
    behind: Any
    min_depth: Any
    min_distance: Any


def limits_of(parameters: BundleParameters, dtype: DTypeLike = np.float64) -> Limits:
    """Limits that the kernels need, from the parameters."""
    number: Any = np.dtype(dtype).type
    sigma2 = parameters.kernel_sigma_px**2
    return Limits(
        inverse_sigma2=number(1.0 / sigma2 if sigma2 > 0.0 else 0.0),
        behind=number(sigma2 if sigma2 > 0.0 else _BEHIND_PX2),
        min_depth=number(parameters.min_depth),
        min_distance=number(_LEAST_DISTANCE),
    )


@fast_kernel
def motion_of(cameras: Cameras, m: int) -> Any:
    """The 12 numbers of camera m, held in registers during a loop."""
    return row_of(cameras.motion[m])


@fast_kernel
def row_of(c: Any) -> Any:
    """The 12 numbers of a motion (12,)."""
    return (c[0], c[1], c[2], c[3], c[4], c[5], c[6], c[7], c[8], c[9], c[10], c[11])


@fast_kernel
def pinhole_of(cameras: Cameras, m: int) -> Any:
    """fx, fy, cx, cy of camera m."""
    k = cameras.pinhole[m]
    return (k[0], k[1], k[2], k[3])


@fast_kernel
def lens_of(cameras: Cameras, m: int) -> Any:
    """(k1, k2) of camera m; () where there is no distortion."""
    return _lens_of(cameras.lens, m)


@fast_kernel
def _lens_of(lens: Any, m: int) -> Any:
    # Of an argument numba knows the dimensions before it types the branches.
    if lens.ndim == 1:
        return ()
    return (lens[m, 0], lens[m, 1])


@fast_kernel
def residual(
    one: _Number, T: _Camera, K: _Camera, lens: Any, point: _Point, u: Any, v: Any, limits: Limits
) -> Any:
    """(x, y, 1/z, in front, residual u, residual v); finite but meaningless behind the camera."""
    X, Y, Z = point
    z = T[6] * X + T[7] * Y + T[8] * Z + T[11]
    front = (z > limits.min_depth) & (abs(z) > limits.min_distance)
    iz = one / (z if front else one)
    x = (T[0] * X + T[1] * Y + T[2] * Z + T[9]) * iz
    y = (T[3] * X + T[4] * Y + T[5] * Z + T[10]) * iz
    if len(lens) == 0:
        return x, y, iz, front, u - (K[0] * x + K[2]), v - (K[1] * y + K[3])
    n2 = x * x + y * y
    d = one + n2 * (lens[0] + lens[1] * n2)
    return x, y, iz, front, u - (K[0] * d * x + K[2]), v - (K[1] * d * y + K[3])


@fast_kernel
def robust_cost(one: _Number, du: Any, dv: Any, w: Any, front: Any, limits: Limits) -> Any:
    """w rho(r^2), Geman-McClure."""
    s = du * du + dv * dv
    return w * (s / (one + s * limits.inverse_sigma2) if front else limits.behind)


@fast_kernel
def observe(
    one: _Number, T: _Camera, K: _Camera, lens: Any, point: _Point, seen: Seen, limits: Limits
) -> Any:
    """(x, y, 1/z, m00, m01, m11, e0, e1, cost): one observation linearised, see the module."""
    u, v, w = seen
    x, y, iz, front, du, dv = residual(one, T, K, lens, point, u, v, limits)
    s = du * du + dv * dv
    k = one / (one + s * limits.inverse_sigma2)
    cost = w * (s * k if front else limits.behind)
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


@fast_kernel(inline=True)  # a call in a loop keeps LLVM from vectorising it
def observe_uncertain(
    one: _Number,
    T: _Camera,
    K: _Camera,
    point: _Point,
    spread: _Point,
    shared: Any,
    seen: Seen,
    limits: Limits,
) -> Any:
    """As ``observe``, without distortion, of a point whose depth is uncertain (``inverse_depth``).

    The point is at ``point + shared spread``.  Returns in addition (a, b), the derivative of (x, y)
    by shared, r^T W r, and whether it is in front: M and e contain W.
    """
    x0, y0, z0 = spread
    X, Y, Z = point[0] + shared * x0, point[1] + shared * y0, point[2] + shared * z0
    x, y, iz, front, du, dv = residual(one, T, K, (), (X, Y, Z), seen.u, seen.v, limits)
    mz = T[6] * x0 + T[7] * y0 + T[8] * z0
    a = (T[0] * x0 + T[1] * y0 + T[2] * z0 - x * mz) * iz
    b = (T[3] * x0 + T[4] * y0 + T[5] * z0 - y * mz) * iz
    eu, ev = K[0] * a, K[1] * b
    across = ev * du - eu * dv
    share = one / (one + eu * eu + ev * ev)
    s = (du * du + dv * dv + across * across) * share
    k = one / (one + s * limits.inverse_sigma2)
    cost = seen.w * (s * k if front else limits.behind)
    weight = (seen.w if front else one - one) * k * k * share
    gx, gy = weight * K[0], weight * K[1]
    m00, m11 = gx * K[0] * (one + ev * ev), gy * K[1] * (one + eu * eu)
    e0, e1 = gx * (du + ev * across), gy * (dv - eu * across)
    return x, y, iz, m00, (-gx * K[1] * eu * ev,), m11, e0, e1, cost, a, b, s, front


@fast_kernel
def apply_metric(m00: Any, m01: Any, m11: Any, a: Any, b: Any) -> Any:
    """M (a, b) for the symmetric M."""
    if len(m01) == 0:
        return m00 * a, m11 * b
    return m00 * a + m01[0] * b, m01[0] * a + m11 * b


@fast_kernel
def corner(m01: Any, factor: Any, zero: _Number) -> Any:
    """The off-diagonal of M times a factor."""
    if len(m01) == 0:
        return zero
    return m01[0] * factor


@fast_kernel
def point_rows(T: _Camera, x: Any, y: Any, iz: Any) -> Any:
    """The six numbers of P, row by row."""
    return (
        (T[0] - x * T[6]) * iz, (T[1] - x * T[7]) * iz, (T[2] - x * T[8]) * iz,
        (T[3] - y * T[6]) * iz, (T[4] - y * T[7]) * iz, (T[5] - y * T[8]) * iz,
    )  # fmt: skip


@fast_kernel
def couple(x: Any, y: Any, iz: Any, a: Any, c: Any) -> Any:
    """``B^T (a, c)``: the six numbers of a column of H_cp."""
    e = x * a + y * c
    return iz * a, iz * c, -iz * e, -c - y * e, a + x * e, x * c - y * a


@fast_kernel
def factor_point(one: _Number, V: Triangle, smallest: _Number) -> Triangle:
    """L of ``L L^T = V`` with the inverse of its diagonal; all 0 where not positive definite."""
    zero = one - one
    ok = V.xx > zero
    xx = one / np.sqrt(V.xx if ok else one)
    yx, zx = V.yx * xx, V.zx * xx
    rest = V.yy - yx * yx
    ok = ok & (rest > smallest * V.yy)
    yy = one / np.sqrt(rest if ok else one)
    zy = (V.zy - zx * yx) * yy
    rest = V.zz - zx * zx - zy * zy
    ok = ok & (rest > smallest * V.zz)
    zz = one / np.sqrt(rest if ok else one)
    if not ok:
        return Triangle(zero, zero, zero, zero, zero, zero)
    return Triangle(xx, yx, yy, zx, zy, zz)


@fast_kernel
def solve_point(one: _Number, V: Triangle, g: _Point, smallest: _Number) -> _Point:
    """Solve ``V s = g`` by Cholesky; 0 where V is not positive definite.

    In one with its factor: after ``factor_point`` the same would be rounded in another way.
    """
    zero = one - one
    ok = V.xx > zero
    i00 = one / np.sqrt(V.xx if ok else one)
    l10, l20 = V.yx * i00, V.zx * i00
    d11 = V.yy - l10 * l10
    ok = ok & (d11 > smallest * V.yy)
    i11 = one / np.sqrt(d11 if ok else one)
    l21 = (V.zy - l20 * l10) * i11
    d22 = V.zz - l20 * l20 - l21 * l21
    ok = ok & (d22 > smallest * V.zz)
    i22 = one / np.sqrt(d22 if ok else one)
    y0 = g[0] * i00
    y1 = (g[1] - l10 * y0) * i11
    s2 = (g[2] - l20 * y0 - l21 * y1) * i22 * i22
    s1 = (y1 - l21 * s2) * i11
    s0 = (y0 - l10 * s1 - l20 * s2) * i00
    return s0 if ok else zero, s1 if ok else zero, s2 if ok else zero


@kernel
def solve_camera(H: F64, g: F64, damping: float, step: F64) -> bool:
    """Solve ``(H + damping diag(H)) step = g``; False, and step 0, where there is no solution.

    H: (>= 21,) its lower triangle by rows.   g, step: (>= 6,).
    """
    L = np.empty((6, 6))
    at = 0
    for r in range(6):
        for c in range(r + 1):
            total = H[at] * (1.0 + damping) if r == c else H[at]
            diagonal = total
            for k in range(c):
                total -= L[r, k] * L[c, k]
            if r == c:
                if not total > _SINGULAR * diagonal:
                    step[:] = 0.0
                    return False
                L[r, r] = np.sqrt(total)
            else:
                L[r, c] = total / L[c, c]
            at += 1
    for r in range(6):
        total = g[r]
        for k in range(r):
            total -= L[r, k] * step[k]
        step[r] = total / L[r, r]
    for r in range(5, -1, -1):
        total = step[r]
        for k in range(r + 1, 6):
            total -= L[k, r] * step[k]
        step[r] = total / L[r, r]
    return True


@kernel
def move_camera(camera: F64, step: F64, out: F64) -> None:
    """Left-multiply T_camera_world (12,) by ``(exp(theta), rho)``, step (6,) = (rho, theta)."""
    a, b, c = step[3], step[4], step[5]
    angle2 = a * a + b * b + c * c
    if angle2 < 1e-12:
        p, q = 1.0 - angle2 / 6.0, 0.5 - angle2 / 24.0
    else:
        angle = np.sqrt(angle2)
        p, q = np.sin(angle) / angle, (1.0 - np.cos(angle)) / angle2
    e00, e01, e02 = 1.0 - q * (b * b + c * c), q * a * b - p * c, q * a * c + p * b
    e10, e11, e12 = q * a * b + p * c, 1.0 - q * (a * a + c * c), q * b * c - p * a
    e20, e21, e22 = q * a * c - p * b, q * b * c + p * a, 1.0 - q * (a * a + b * b)
    for k in range(3):
        r0, r1, r2 = camera[k], camera[3 + k], camera[6 + k]
        out[k] = e00 * r0 + e01 * r1 + e02 * r2
        out[3 + k] = e10 * r0 + e11 * r1 + e12 * r2
        out[6 + k] = e20 * r0 + e21 * r1 + e22 * r2
    t0, t1, t2 = camera[9], camera[10], camera[11]
    out[9] = e00 * t0 + e01 * t1 + e02 * t2 + step[0]
    out[10] = e10 * t0 + e11 * t1 + e12 * t2 + step[1]
    out[11] = e20 * t0 + e21 * t1 + e22 * t2 + step[2]


@kernel
def move_cameras(cameras: F64, steps: F64) -> F64:
    """``move_camera`` for (M, 12) cameras and (M, 6) steps; a step of 0 changes no bit."""
    out = cameras.copy()
    for m in range(cameras.shape[0]):
        if np.any(steps[m] != 0.0):
            move_camera(cameras[m], steps[m], out[m])
    return out
