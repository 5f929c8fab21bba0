"""Kernels of the Schur complement solver: linearisation, elimination of points, substitution.

An observation is linearised once for a state, into a record of eight numbers: x, y, 1/z, m00, m01,
m11, e0, e1 of ``projection``.  Everything else follows from the record and the rotation of its
camera: with P and B of ``projection``,

    H_pp = sum P^T M P        g_p = - sum P^T e        H_cp = B^T M P.

So another damping costs no projection.  With ``L L^T = H_pp + damping diag(H_pp)``,
``U = H_cp L^-T`` and ``y = - L^-1 g_p`` of every point, Eq. 9 and 10 read

    (H_cc + damping diag(H_cc) - U U^T) dx_c = - g_c - U y        L^T dx_p = y - U^T dx_c.

A calibration that all cameras share is one more camera c with the rows ``A^T M P`` of
``calibration``, or two for more than six unknowns; it observes every point, so its H_cp is stored
as a sum, one block per point.

Linearisation goes camera by camera, in SIMD over blocks of observations; elimination goes point by
point, over the records of each point in ascending order of their cameras.
"""

from typing import Any, NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64
from pliant.algorithms.slam.estimate.dense_layout import BLOCK
from pliant.algorithms.slam.estimate.packed_layout import Places, Slots
from pliant.algorithms.slam.estimate.projection import (
    Cameras,
    Limits,
    Seen,
    Triangle,
    apply_metric,
    corner,
    couple,
    factor_point,
    lens_of,
    motion_of,
    observe,
    pinhole_of,
    point_rows,
    residual,
    robust_cost,
)
from pliant.algorithms.slam.estimate.reduced import subtract_product3
from pliant.compiler.kernel import fast_kernel

RECORD, FACTOR = 8, 9
"""Numbers kept of an observation, and of a point."""
MOST_BORDERS = 2
"""Blocks of six that a shared calibration has at most."""
_SINGULAR = 1e-14


class Linearised(NamedTuple):
    """The linearised observations of one state, independent of the damping.

    records: (O + 1, RECORD).     motion: (M, 12).     shared: (P, 18 R) H_cp by rows of the shared
    calibration, whose R blocks of six are the last; (0, ...): there is none.
    """

    records: F64
    shared: F64
    places: Places
    motion: F64


class CameraSystem(NamedTuple):
    """``S x = b`` of the F movable cameras, and of a shared calibration, packed as in ``reduced``.

    position: (M,) of each camera, -1 for a fixed one.     block: (N, N) of ``Pattern``.
    S: (K, 36).     b: (N, 6).
    """

    position: I32
    block: I32
    S: F64
    b: F64


class Scratch(NamedTuple):
    """Memory for one point: its observations, their U, their positions."""

    seen: F64
    U: F64
    rows: I64


def scratch_for(cameras: int) -> Scratch:
    """Return memory for points with at most this many observations, and a shared calibration."""
    size = cameras + MOST_BORDERS
    return Scratch(np.empty((size, 9)), np.empty((size, 18)), np.empty(size, np.int64))


@fast_kernel
def linearise_observations(
    cameras: Cameras,
    points: F64,
    slots: Slots,
    limits: Limits,
    records: F64,
    normal: F64,
) -> None:
    """Write the records and every camera's own part.

    points: (3, P).     records: (O + 1, RECORD), the last one a dump.
    normal: (M, 27) lower triangle of each H_cc by rows, then the negative gradient.
    """
    local = np.empty(RECORD * BLOCK)
    near = np.empty((3, BLOCK))
    normal[:] = 0.0
    for b in range(slots.camera.size):
        m = slots.camera[b]
        _gather(points, slots.point[b], near)
        _linearise(
            motion_of(cameras, m), pinhole_of(cameras, m), lens_of(cameras, m),
            (near[0], near[1], near[2]), Seen(slots.u[b], slots.v[b], slots.w[b]), limits, local,
        )  # fmt: skip
        camera_block(local, normal[m])
        for i in range(BLOCK):
            at = np.uint32(slots.place[b, i])
            for k in range(RECORD):
                records[at, k] = local[k * BLOCK + i]


@fast_kernel
def _gather(points: F64, columns: I32, near: F64) -> None:
    for i in range(BLOCK):
        n = np.uint32(columns[i])
        for k in range(3):
            near[k, i] = points[k, n]


@fast_kernel
def _linearise(
    T: Any, K: Any, lens: Any, points: tuple[F64, F64, F64], seen: Seen, limits: Limits, local: F64
) -> None:
    X, Y, Z = points
    u, v, w = seen
    for i in range(BLOCK):
        x, y, iz, m00, m01, m11, e0, e1, _ = observe(
            1.0, T, K, lens, (X[i], Y[i], Z[i]), Seen(u[i], v[i], w[i]), limits
        )
        local[i] = x
        local[BLOCK + i] = y
        local[2 * BLOCK + i] = iz
        local[3 * BLOCK + i] = m00
        local[4 * BLOCK + i] = corner(m01, 1.0, 0.0)
        local[5 * BLOCK + i] = m11
        local[6 * BLOCK + i] = e0
        local[7 * BLOCK + i] = e1


@fast_kernel
def cost_of_observations(cameras: Cameras, points: F64, slots: Slots, limits: Limits) -> float:
    """``0.5 sum w rho(r^2)``, px^2.  points: (3, P)."""
    near = np.empty((3, BLOCK))
    total = 0.0
    for b in range(slots.camera.size):
        m = slots.camera[b]
        _gather(points, slots.point[b], near)
        total += _cost(
            motion_of(cameras, m), pinhole_of(cameras, m), lens_of(cameras, m),
            (near[0], near[1], near[2]), Seen(slots.u[b], slots.v[b], slots.w[b]), limits,
        )  # fmt: skip
    return 0.5 * total


@fast_kernel
def _cost(
    T: Any, K: Any, lens: Any, points: tuple[F64, F64, F64], seen: Seen, limits: Limits
) -> float:
    X, Y, Z = points
    u, v, w = seen
    total = 0.0
    for i in range(BLOCK):
        _, _, _, front, du, dv = residual(1.0, T, K, lens, (X[i], Y[i], Z[i]), u[i], v[i], limits)
        total += robust_cost(1.0, du, dv, w[i], front, limits)
    return total


@fast_kernel
def squared_residuals(
    cameras: Cameras,
    points: F64,
    slots: Slots,
    limits: Limits,
    out: F32,
) -> None:
    """(O + 1,) squared residuals, px^2; inf where the point lies behind the camera."""
    for b in range(slots.camera.size):
        m = slots.camera[b]
        T, K, lens = motion_of(cameras, m), pinhole_of(cameras, m), lens_of(cameras, m)
        for i in range(BLOCK):
            n = slots.point[b, i]
            _, _, _, front, du, dv = residual(
                1.0, T, K, lens, (points[0, n], points[1, n], points[2, n]),
                slots.u[b, i], slots.v[b, i], limits,
            )  # fmt: skip
            good = front & (slots.w[b, i] > 0.0)
            out[slots.place[b, i]] = np.float32(du * du + dv * dv) if good else np.float32(np.inf)


@fast_kernel
def camera_block(local: F64, normal: F64) -> None:
    """Add ``B^T M B`` (21 numbers, lower triangle by rows) and ``B^T e`` of one block."""
    h00 = h10 = h11 = h20 = h21 = h22 = h30 = h31 = h32 = h33 = 0.0
    h40 = h41 = h42 = h43 = h44 = h50 = h51 = h52 = h53 = h54 = h55 = 0.0
    g0 = g1 = g2 = g3 = g4 = g5 = 0.0
    for i in range(BLOCK):
        x, y, iz = local[i], local[BLOCK + i], local[2 * BLOCK + i]
        m00, m01, m11, e0, e1 = (
            local[3 * BLOCK + i],
            local[4 * BLOCK + i],
            local[5 * BLOCK + i],
            local[6 * BLOCK + i],
            local[7 * BLOCK + i],
        )
        a2, b2 = -x * iz, -y * iz
        a3, b3 = -x * y, -(1.0 + y * y)
        a4, b4 = 1.0 + x * x, x * y
        a5, b5 = -y, x
        p2, q2 = m00 * a2 + m01 * b2, m01 * a2 + m11 * b2
        p3, q3 = m00 * a3 + m01 * b3, m01 * a3 + m11 * b3
        p4, q4 = m00 * a4 + m01 * b4, m01 * a4 + m11 * b4
        p5, q5 = m00 * a5 + m01 * b5, m01 * a5 + m11 * b5
        h00 += m00 * iz * iz
        h10 += m01 * iz * iz
        h11 += m11 * iz * iz
        h20 += p2 * iz
        h21 += q2 * iz
        h22 += p2 * a2 + q2 * b2
        h30 += p3 * iz
        h31 += q3 * iz
        h32 += p3 * a2 + q3 * b2
        h33 += p3 * a3 + q3 * b3
        h40 += p4 * iz
        h41 += q4 * iz
        h42 += p4 * a2 + q4 * b2
        h43 += p4 * a3 + q4 * b3
        h44 += p4 * a4 + q4 * b4
        h50 += p5 * iz
        h51 += q5 * iz
        h52 += p5 * a2 + q5 * b2
        h53 += p5 * a3 + q5 * b3
        h54 += p5 * a4 + q5 * b4
        h55 += p5 * a5 + q5 * b5
        g0 += e0 * iz
        g1 += e1 * iz
        g2 += e0 * a2 + e1 * b2
        g3 += e0 * a3 + e1 * b3
        g4 += e0 * a4 + e1 * b4
        g5 += e0 * a5 + e1 * b5
    sums = (
        h00, h10, h11, h20, h21, h22, h30, h31, h32, h33, h40, h41, h42, h43, h44,
        h50, h51, h52, h53, h54, h55, g0, g1, g2, g3, g4, g5,
    )  # fmt: skip
    for r in range(27):
        normal[r] += sums[r]


@fast_kernel
def eliminate_points(
    state: Linearised, damping: float, system: CameraSystem, scratch: Scratch, factors: F64
) -> None:
    """Factor every point's block and eliminate the points from the system.

    To S ``- U U^T`` is added, to b ``- U y``.
    factors: (P, FACTOR) are written, 0 for a point without information.
    """
    records, shared, places, motion = state.records, state.shared, state.places, state.motion
    free, block, S, b = system.position, system.block, system.S, system.b
    grow = 1.0 + damping
    seen, U, rows = scratch.seen, scratch.U, scratch.rows
    for point in range(places.start.size):
        n = np.uintp(point)
        v00 = v10 = v11 = v20 = v21 = v22 = g0 = g1 = g2 = 0.0
        count = 0
        for position in range(places.start[n], places.stop[n]):
            o = np.uintp(position)
            m = np.uintp(places.camera[o])
            x, y, iz = records[o, 0], records[o, 1], records[o, 2]
            m00, m01, m11 = records[o, 3], records[o, 4], records[o, 5]
            e0, e1 = records[o, 6], records[o, 7]
            p0, p1, p2, q0, q1, q2 = point_rows(motion[m], x, y, iz)
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
        damped = Triangle(grow * v00, v10, grow * v11, v20, v21, grow * v22)
        i00, l10, i11, l20, l21, i22 = factor_point(1.0, damped, _SINGULAR)
        y0 = g0 * i00
        y1 = (g1 - l10 * y0) * i11
        y2 = (g2 - l20 * y0 - l21 * y1) * i22
        factors[n, 0], factors[n, 1], factors[n, 2] = i00, l10, i11
        factors[n, 3], factors[n, 4], factors[n, 5] = l20, l21, i22
        factors[n, 6], factors[n, 7], factors[n, 8] = y0, y1, y2
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
                if row >= rows[c]:
                    subtract_product3(S, np.uintp(block[at, np.uintp(rows[c])]), U, a, c)
                else:
                    subtract_product3(S, np.uintp(block[np.uintp(rows[c]), at]), U, c, a)
        if shared.shape[0] == 0:
            continue
        borders = shared.shape[1] // 18
        for border in range(borders):
            last, a = np.uintp(b.shape[0] - borders + border), np.uintp(count)
            rows[a] = last
            for q in range(6):
                at = np.uintp(18 * border + 3 * q)
                e0 = shared[n, at] * i00
                e1 = (shared[n, at + 1] - l10 * e0) * i11
                e2 = (shared[n, at + 2] - l20 * e0 - l21 * e1) * i22
                U[a, q], U[a, 6 + q], U[a, 12 + q] = e0, e1, e2
                b[last, q] -= e0 * y0 + e1 * y1 + e2 * y2
            count += 1
            for second in range(count):
                c = np.uintp(second)
                subtract_product3(S, np.uintp(block[last, np.uintp(rows[c])]), U, a, c)


@fast_kernel
def substitute(
    state: Linearised, steps: F64, change: F64, factors: F64, points: F64, out: F64
) -> None:
    """Move the points (Eq. 10).

    steps: (M, 6) of every camera, 0 where fixed.     change: (6 R,) of the shared calibration.
    points, out: (3, P).
    """
    records, shared, places, motion = state.records, state.shared, state.places, state.motion
    for n in range(places.start.size):
        t0 = t1 = t2 = 0.0
        for o in range(places.start[n], places.stop[n]):
            m = places.camera[o]
            x, y, iz = records[o, 0], records[o, 1], records[o, 2]
            m00, m01, m11 = records[o, 3], records[o, 4], records[o, 5]
            d = steps[m]
            # Motion of the point on the plane z = 1 by the step: B dx_c.
            mu = (d[0] - x * d[2]) * iz - x * y * d[3] + (1.0 + x * x) * d[4] - y * d[5]
            mv = (d[1] - y * d[2]) * iz - (1.0 + y * y) * d[3] + x * y * d[4] + x * d[5]
            a, c = apply_metric(m00, (m01,), m11, mu, mv)
            p0, p1, p2, q0, q1, q2 = point_rows(motion[m], x, y, iz)
            t0 += a * p0 + c * q0
            t1 += a * p1 + c * q1
            t2 += a * p2 + c * q2
        for q in range(change.size):
            t0 += shared[n, 3 * q] * change[q]
            t1 += shared[n, 3 * q + 1] * change[q]
            t2 += shared[n, 3 * q + 2] * change[q]
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
