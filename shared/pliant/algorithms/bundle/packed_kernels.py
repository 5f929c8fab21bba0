"""Kernels of the Schur complement solver for problems in which most cameras see few of the points.

An observation is linearised once for a state, into a record of eight numbers: x, y, 1/z, m00, m01,
m11, e0, e1 of ``projection``.  Everything else follows from the record and the rotation of its
camera: with P and B of ``projection``,

    H_pp = sum P^T M P        g_p = - sum P^T e        H_cp = B^T M P.

So another damping costs no projection.  With ``L L^T = H_pp + damping diag(H_pp)``,
``U = H_cp L^-T`` and ``y = - L^-1 g_p`` of every point, Eq. 9 and 10 read

    (H_cc + damping diag(H_cc) - U U^T) dx_c = - g_c - U y        L^T dx_p = y - U^T dx_c.

The step lowers the linearised cost by ``0.5 dx^T (damping diag(H) dx - g)``, whose part of a point
is ``0.5 (y^T (y - U^T dx_c) + damping dx_p^T diag(H_pp) dx_p)``.

Linearisation goes camera by camera, in SIMD over blocks of observations; elimination goes point by
point, over the records of each point in ascending order of their cameras.
"""

from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8
from pliant.algorithms.bundle.cost import Limits
from pliant.algorithms.bundle.layout import BLOCK
from pliant.algorithms.bundle.outer_product import subtract_product
from pliant.algorithms.bundle.projection import (
    apply_metric,
    corner,
    lens_of,
    motion_of,
    observe,
    pinhole_of,
    point_rows,
    residual,
)
from pliant.algorithms.bundle.schur_kernels import SINGULAR, camera_block
from pliant.algorithms.kernel import fast_kernel, inline_kernel, leaf_kernel

RECORD = 8
FACTOR = 12
"""Numbers kept of each point: 1/l00, l10, 1/l11, l20, l21, 1/l22, y (3), diag(H_pp) (3)."""


@fast_kernel
def linearise_observations(
    cameras: F64,
    pinholes: F64,
    lenses: F64,
    points: F64,
    block_camera: I32,
    points_seen: I32,
    place: I32,
    u: F32,
    v: F32,
    w: F32,
    limits: Limits,
    records: F64,
    normal: F64,
) -> float:
    """Write the records and every camera's own part; returns the cost, px^2.

    points_seen, place, u, v, w: (B, BLOCK) of ``PackedLayout``.     records: (O + 1, 8).
    normal: (M, 27) lower triangle of each H_cc by rows, then the negative gradient.
    """
    local = np.empty(RECORD * BLOCK)
    near = np.empty((3, BLOCK))
    normal[:] = 0.0
    total = 0.0
    for b in range(block_camera.size):
        m = block_camera[b]
        for i in range(BLOCK):
            n = np.uint32(points_seen[b, i])
            for k in range(3):
                near[k, i] = points[k, n]
        total += _linearise(
            motion_of(cameras, m), pinhole_of(pinholes, m), lens_of(lenses, m),
            near[0], near[1], near[2], u[b], v[b], w[b], limits, local,
        )  # fmt: skip
        camera_block(local, normal[m])
        for i in range(BLOCK):
            at = np.uint32(place[b, i])
            for k in range(RECORD):
                records[at, k] = local[k * BLOCK + i]
    return 0.5 * total


@fast_kernel
def _linearise(
    T: Any, K: Any, lens: Any, X: F64, Y: F64, Z: F64, u: F32, v: F32, w: F32, limits: Limits,
    local: F64,
) -> float:  # fmt: skip
    total = 0.0
    for i in range(BLOCK):
        x, y, iz, m00, m01, m11, e0, e1, cost = observe(
            1.0, T, K, lens, X[i], Y[i], Z[i], u[i], v[i], w[i], limits
        )
        total += cost
        local[i] = x
        local[BLOCK + i] = y
        local[2 * BLOCK + i] = iz
        local[3 * BLOCK + i] = m00
        local[4 * BLOCK + i] = corner(m01, 1.0, 0.0)
        local[5 * BLOCK + i] = m11
        local[6 * BLOCK + i] = e0
        local[7 * BLOCK + i] = e1
    return total


@fast_kernel
def squared_residuals_of_blocks(
    cameras: F64,
    pinholes: F64,
    lenses: F64,
    points: F64,
    block_camera: I32,
    points_seen: I32,
    place: I32,
    u: F32,
    v: F32,
    w: F32,
    limits: Limits,
    out: F32,
) -> None:
    """(O + 1,) squared residuals, px^2; inf where the point lies behind the camera."""
    for b in range(block_camera.size):
        m = block_camera[b]
        T, K, lens = motion_of(cameras, m), pinhole_of(pinholes, m), lens_of(lenses, m)
        for i in range(BLOCK):
            n = points_seen[b, i]
            _, _, _, front, du, dv = residual(
                1.0, T, K, lens, points[0, n], points[1, n], points[2, n], u[b, i], v[b, i], limits
            )
            good = front & (w[b, i] > 0.0)
            out[place[b, i]] = np.float32(du * du + dv * dv) if good else np.float32(np.inf)


@leaf_kernel
def eliminate_points(
    records: F64,
    start: I64,
    stop: I64,
    camera: I32,
    free: I32,
    cameras: F64,
    movable: U8,
    damping: float,
    seen: F64,
    U: F64,
    rows: I64,
    factors: F64,
    S: F64,
    b: F64,
) -> None:
    """Factor every point's block and take the points out of the system of the F movable cameras.

    start, stop: (P,) records of each point.     camera: (O,) their cameras, ascending for a point.
    seen: (M, 9), U: (M, 18), rows: (M,) room for one point; column k of U at ``6 k``.
    factors: (P, FACTOR) are written, 0 for a point that may not move or has no information.
    S: (F F, 36) blocks of the lower triangle: ``- U U^T`` is added.  b: (F, 6): ``- U y``.
    """
    grow = 1.0 + damping
    F = b.shape[0]
    for point in range(start.size):
        n = np.uintp(point)
        v00 = v10 = v11 = v20 = v21 = v22 = g0 = g1 = g2 = 0.0
        count = 0
        for position in range(start[n], stop[n]):
            o = np.uintp(position)
            m = np.uintp(camera[o])
            x, y, iz = records[o, 0], records[o, 1], records[o, 2]
            m00, m01, m11 = records[o, 3], records[o, 4], records[o, 5]
            e0, e1 = records[o, 6], records[o, 7]
            p0, p1, p2, q0, q1, q2 = point_rows(cameras[m], x, y, iz)
            a0, c0 = apply_metric(m00, (m01,), m11, p0, q0)
            a1, c1 = apply_metric(m00, (m01,), m11, p1, q1)
            a2, c2 = apply_metric(m00, (m01,), m11, p2, q2)
            v00 += a0 * p0 + c0 * q0
            v10 += a1 * p0 + c1 * q0
            v11 += a1 * p1 + c1 * q1
            v20 += a2 * p0 + c2 * q0
            v21 += a2 * p1 + c2 * q1
            v22 += a2 * p2 + c2 * q2
            g0 += e0 * p0 + e1 * q0
            g1 += e0 * p1 + e1 * q1
            g2 += e0 * p2 + e1 * q2
            if free[m] >= 0:
                q = np.uintp(count)
                count += 1
                rows[q] = free[m]
                seen[q, 0], seen[q, 1], seen[q, 2] = x, y, iz
                seen[q, 3], seen[q, 4], seen[q, 5] = a0, a1, a2
                seen[q, 6], seen[q, 7], seen[q, 8] = c0, c1, c2
        i00, l10, i11, l20, l21, i22 = factor_point(
            1.0, grow * v00, v10, grow * v11, v20, v21, grow * v22, movable[n] != 0, SINGULAR
        )
        y0 = g0 * i00
        y1 = (g1 - l10 * y0) * i11
        y2 = (g2 - l20 * y0 - l21 * y1) * i22
        factors[n, 0], factors[n, 1], factors[n, 2] = i00, l10, i11
        factors[n, 3], factors[n, 4], factors[n, 5] = l20, l21, i22
        factors[n, 6], factors[n, 7], factors[n, 8] = y0, y1, y2
        factors[n, 9], factors[n, 10], factors[n, 11] = v00, v11, v22
        if i00 == 0.0:
            continue
        for first in range(count):
            a = np.uintp(first)
            row = rows[a]
            x, y, iz = seen[a, 0], seen[a, 1], seen[a, 2]
            # L^-T from the right, while M P has two rows; B^T makes six of them.
            a0, c0 = seen[a, 3] * i00, seen[a, 6] * i00
            a1, c1 = (seen[a, 4] - l10 * a0) * i11, (seen[a, 7] - l10 * c0) * i11
            a2 = (seen[a, 5] - l20 * a0 - l21 * a1) * i22
            c2 = (seen[a, 8] - l20 * c0 - l21 * c1) * i22
            U[a, 0], U[a, 1], U[a, 2], U[a, 3], U[a, 4], U[a, 5] = couple(x, y, iz, a0, c0)
            U[a, 6], U[a, 7], U[a, 8], U[a, 9], U[a, 10], U[a, 11] = couple(x, y, iz, a1, c1)
            U[a, 12], U[a, 13], U[a, 14], U[a, 15], U[a, 16], U[a, 17] = couple(x, y, iz, a2, c2)
            d0, d1, d2, d3, d4, d5 = couple(
                x, y, iz, a0 * y0 + a1 * y1 + a2 * y2, c0 * y0 + c1 * y1 + c2 * y2
            )
            at = np.uintp(row)
            b[at, 0] -= d0
            b[at, 1] -= d1
            b[at, 2] -= d2
            b[at, 3] -= d3
            b[at, 4] -= d4
            b[at, 5] -= d5
            for second in range(first + 1):
                c = np.uintp(second)
                subtract_product(S, np.uintp(row * F + rows[c]), U, a, c)


@inline_kernel
def couple(x: Any, y: Any, iz: Any, a: Any, c: Any) -> Any:
    """``B^T (a, c)``: the six numbers of a column of H_cp."""
    e = x * a + y * c
    return iz * a, iz * c, -iz * e, -c - y * e, a + x * e, x * c - y * a


@inline_kernel
def factor_point(
    one: Any, d00: Any, v10: Any, d11: Any, v20: Any, v21: Any, d22: Any, ok: Any, smallest: Any
) -> Any:
    """1/l00, l10, 1/l11, l20, l21, 1/l22; all 0 where not ok or not positive definite."""
    zero = one - one
    ok = ok & (d00 > zero)
    i00 = one / np.sqrt(d00 if ok else one)
    l10, l20 = v10 * i00, v20 * i00
    rest = d11 - l10 * l10
    ok = ok & (rest > smallest * d11)
    i11 = one / np.sqrt(rest if ok else one)
    l21 = (v21 - l20 * l10) * i11
    rest = d22 - l20 * l20 - l21 * l21
    ok = ok & (rest > smallest * d22)
    i22 = one / np.sqrt(rest if ok else one)
    if not ok:
        return zero, zero, zero, zero, zero, zero
    return i00, l10, i11, l20, l21, i22


@leaf_kernel
def substitute(
    records: F64,
    start: I64,
    stop: I64,
    camera: I32,
    cameras: F64,
    steps: F64,
    factors: F64,
    damping: float,
    points: F64,
    out: F64,
) -> float:
    """Move the points (Eq. 10); returns their part of twice the decrease that is foretold.

    steps: (M, 6) of every camera, 0 where fixed.     points, out: (3, P).
    """
    foretold = 0.0
    for n in range(start.size):
        t0 = t1 = t2 = 0.0
        for o in range(start[n], stop[n]):
            m = camera[o]
            x, y, iz = records[o, 0], records[o, 1], records[o, 2]
            m00, m01, m11 = records[o, 3], records[o, 4], records[o, 5]
            d = steps[m]
            # How the step moves the point on the plane z = 1: B dx_c.
            mu = (d[0] - x * d[2]) * iz - x * y * d[3] + (1.0 + x * x) * d[4] - y * d[5]
            mv = (d[1] - y * d[2]) * iz - (1.0 + y * y) * d[3] + x * y * d[4] + x * d[5]
            a, c = apply_metric(m00, (m01,), m11, mu, mv)
            p0, p1, p2, q0, q1, q2 = point_rows(cameras[m], x, y, iz)
            t0 += a * p0 + c * q0
            t1 += a * p1 + c * q1
            t2 += a * p2 + c * q2
        f = factors[n]
        s0 = t0 * f[0]
        s1 = (t1 - f[1] * s0) * f[2]
        s2 = (t2 - f[3] * s0 - f[4] * s1) * f[5]
        r0, r1, r2 = f[6] - s0, f[7] - s1, f[8] - s2
        h2 = r2 * f[5]
        h1 = (r1 - f[4] * h2) * f[2]
        h0 = (r0 - f[1] * h1 - f[3] * h2) * f[0]
        out[0, n] = points[0, n] + h0
        out[1, n] = points[1, n] + h1
        out[2, n] = points[2, n] + h2
        foretold += f[6] * r0 + f[7] * r1 + f[8] * r2
        foretold += damping * (f[9] * h0 * h0 + f[10] * h1 * h1 + f[11] * h2 * h2)
    return foretold
