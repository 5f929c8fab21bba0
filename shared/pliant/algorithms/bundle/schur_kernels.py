"""Kernels of the Schur complement solver, in float64 and vectorised over the points of a block.

With ``L L^T = H_pp + damping diag(H_pp)`` for every point and ``U = H_cp L^-T``, Eq. 9
reads ``(H_cc - U U^T) dx_c = -g_c + U L^-1 g_p``: the products of the blocks of U are all the work.
"""

from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8
from pliant.algorithms.bundle.cost import Limits
from pliant.algorithms.bundle.layout import BLOCK
from pliant.algorithms.bundle.products import (
    DEPTH,
    SPARSE_PAIR,
    count_seen,
    multiply_pairs,
    multiply_points,
    multiply_vector,
)
from pliant.algorithms.bundle.projection import (
    apply_metric,
    corner,
    lens_of,
    motion_of,
    observe,
    pinhole_of,
    point_rows,
)
from pliant.algorithms.kernel import fast_kernel, kernel

SINGULAR = 1e-14


@kernel
def reduced_system(
    cameras: F64,
    pinholes: F64,
    lenses: F64,
    free: I32,
    points: F64,
    movable: U8,
    u: F32,
    v: F32,
    w: F32,
    seen: U8,
    limits: Limits,
    damping: float,
    S: F64,
    b: F64,
    normal: F64,
) -> None:
    """Add all blocks of points to the reduced system of the F movable cameras.

    S: (6F, 6F), lower block triangle: ``- U U^T`` is added.     b: (6F,) ``U L^-1 g_p`` is added.
    normal: (M, 27) lower triangle of each H_cc by rows, then the negative gradient: added to.
    """
    M = cameras.shape[0]
    U = np.empty((M, 6 * DEPTH))
    local = np.empty(8 * BLOCK)
    V = np.empty(9 * BLOCK)
    L = np.empty(6 * BLOCK)
    y = np.empty(DEPTH)
    rows = np.empty(M, np.int64)
    slots = np.empty(M, np.int64)
    cameras_of = np.empty((BLOCK, M), np.int32)
    seen_counts = np.empty(BLOCK, np.int32)
    packed = np.empty((M, 18))
    for block in range(seen.shape[1]):
        lo = block * BLOCK
        hi = lo + BLOCK
        V[:] = 0.0
        count = 0
        for m in range(M):
            if seen[m, block] == 0:
                continue
            linearise_block(
                cameras, pinholes, lenses, m, lo, points, u, v, w, limits, local, V
            )  # fmt: skip
            if free[m] >= 0:
                rows[count], slots[count] = free[m], m
                couple_block(motion_of(cameras, m), local, U[count])
                camera_block(local, normal[m])
                count += 1
        factor_points(V, movable[lo:hi], damping, L, y)
        for a in range(count):
            whiten(U[a], L)
            multiply_vector(U[a], y, b[6 * rows[a] :])
        seen_by = count_seen(w, slots[:count], lo, cameras_of, seen_counts)
        if seen_by * SPARSE_PAIR < BLOCK * count * (count + 1):
            multiply_points(U, rows, cameras_of, seen_counts, packed, S)
        else:
            multiply_pairs(U, rows, count, S)


@fast_kernel
def linearise_block(
    cameras: F64,
    pinholes: F64,
    lenses: F64,
    m: int,
    lo: int,
    points: F64,
    u: F32,
    v: F32,
    w: F32,
    limits: Limits,
    local: F64,
    V: F64,
) -> None:
    """Linearise one camera at one block.

    local: (8 x BLOCK) x, y, 1/z, m00, m01, m11, e0, e1 (see ``projection``) are written.
    V: (9 x BLOCK) lower triangles of H_pp and negative gradients are added to.
    """
    T, K, lens = motion_of(cameras, m), pinhole_of(pinholes, m), lens_of(lenses, m)
    hi = lo + BLOCK
    X, Y, Z = points[0, lo:hi], points[1, lo:hi], points[2, lo:hi]
    um, vm, wm = u[m, lo:hi], v[m, lo:hi], w[m, lo:hi]
    for i in range(BLOCK):
        x, q, iz, m00, m01, m11, e0, e1, _ = observe(
            1.0, T, K, lens, X[i], Y[i], Z[i], um[i], vm[i], wm[i], limits
        )
        local[i] = x
        local[BLOCK + i] = q
        local[2 * BLOCK + i] = iz
        local[3 * BLOCK + i] = m00
        local[4 * BLOCK + i] = corner(m01, 1.0, 0.0)
        local[5 * BLOCK + i] = m11
        local[6 * BLOCK + i] = e0
        local[7 * BLOCK + i] = e1
    for i in range(BLOCK):
        p0, p1, p2, q0, q1, q2 = point_rows(T, local[i], local[BLOCK + i], local[2 * BLOCK + i])
        m00, m01, m11, e0, e1 = (
            local[3 * BLOCK + i],
            local[4 * BLOCK + i],
            local[5 * BLOCK + i],
            local[6 * BLOCK + i],
            local[7 * BLOCK + i],
        )
        a0, b0 = apply_metric(m00, (m01,), m11, p0, q0)
        a1, b1 = apply_metric(m00, (m01,), m11, p1, q1)
        a2, b2 = apply_metric(m00, (m01,), m11, p2, q2)
        V[i] += a0 * p0 + b0 * q0
        V[BLOCK + i] += a1 * p0 + b1 * q0
        V[2 * BLOCK + i] += a1 * p1 + b1 * q1
        V[3 * BLOCK + i] += a2 * p0 + b2 * q0
        V[4 * BLOCK + i] += a2 * p1 + b2 * q1
        V[5 * BLOCK + i] += a2 * p2 + b2 * q2
        V[6 * BLOCK + i] += e0 * p0 + e1 * q0
        V[7 * BLOCK + i] += e0 * p1 + e1 * q1
        V[8 * BLOCK + i] += e0 * p2 + e1 * q2


@fast_kernel
def couple_block(T: Any, local: F64, W: F64) -> None:
    """Write ``H_cp = B^T M P`` of one camera and block: W (6 x 3 x BLOCK)."""
    for k in range(3):
        first, second, third = T[k], T[3 + k], T[6 + k]
        at = k * BLOCK
        for i in range(BLOCK):
            x, y, iz = local[i], local[BLOCK + i], local[2 * BLOCK + i]
            p, q = (first - x * third) * iz, (second - y * third) * iz
            a, c = (
                local[3 * BLOCK + i] * p + local[4 * BLOCK + i] * q,
                local[4 * BLOCK + i] * p + local[5 * BLOCK + i] * q,
            )
            e = x * a + y * c
            W[at + i] = iz * a
            W[DEPTH + at + i] = iz * c
            W[2 * DEPTH + at + i] = -iz * e
            W[3 * DEPTH + at + i] = -c - y * e
            W[4 * DEPTH + at + i] = a + x * e
            W[5 * DEPTH + at + i] = x * c - y * a


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
def factor_points(V: F64, movable: U8, damping: float, L: F64, y: F64) -> None:
    """Cholesky factors of the damped point blocks, stored ready for substitution.

    V: (9 x BLOCK) lower triangles and negative gradients.  L: 1/l00, l10, 1/l11, l20, l21, 1/l22;
    all 0 for a point that may not move or has no information, which leaves it where it is.
    y: (3 x BLOCK) ``- L^-1 g_p``.
    """
    grow = 1.0 + damping
    for i in range(BLOCK):
        v00, v11, v22 = V[i] * grow, V[2 * BLOCK + i] * grow, V[5 * BLOCK + i] * grow
        ok = (movable[i] != 0) & (v00 > 0.0)
        i00 = 1.0 / np.sqrt(v00 if ok else 1.0)
        l10, l20 = V[BLOCK + i] * i00, V[3 * BLOCK + i] * i00
        d11 = v11 - l10 * l10
        ok = ok & (d11 > SINGULAR * v11)
        i11 = 1.0 / np.sqrt(d11 if ok else 1.0)
        l21 = (V[4 * BLOCK + i] - l20 * l10) * i11
        d22 = v22 - l20 * l20 - l21 * l21
        ok = ok & (d22 > SINGULAR * v22)
        i22 = 1.0 / np.sqrt(d22 if ok else 1.0)
        L[i] = i00 if ok else 0.0
        L[BLOCK + i] = l10 if ok else 0.0
        L[2 * BLOCK + i] = i11 if ok else 0.0
        L[3 * BLOCK + i] = l20 if ok else 0.0
        L[4 * BLOCK + i] = l21 if ok else 0.0
        L[5 * BLOCK + i] = i22 if ok else 0.0
    for i in range(BLOCK):
        y0 = V[6 * BLOCK + i] * L[i]
        y1 = (V[7 * BLOCK + i] - L[BLOCK + i] * y0) * L[2 * BLOCK + i]
        y[i] = y0
        y[BLOCK + i] = y1
        y[2 * BLOCK + i] = (V[8 * BLOCK + i] - L[3 * BLOCK + i] * y0 - L[4 * BLOCK + i] * y1) * L[
            5 * BLOCK + i
        ]


@fast_kernel
def whiten(W: F64, L: F64) -> None:
    """``H_cp`` (6 x 3 x BLOCK) to ``U = H_cp L^-T``, in place."""
    for r in range(6):
        at = r * DEPTH
        for i in range(BLOCK):
            e0 = W[at + i] * L[i]
            e1 = (W[at + BLOCK + i] - L[BLOCK + i] * e0) * L[2 * BLOCK + i]
            W[at + 2 * BLOCK + i] = (
                W[at + 2 * BLOCK + i] - L[3 * BLOCK + i] * e0 - L[4 * BLOCK + i] * e1
            ) * L[5 * BLOCK + i]
            W[at + BLOCK + i] = e1
            W[at + i] = e0


@kernel
def back_substitute(
    cameras: F64,
    pinholes: F64,
    lenses: F64,
    points: F64,
    movable: U8,
    u: F32,
    v: F32,
    w: F32,
    seen: U8,
    limits: Limits,
    damping: float,
    steps: F64,
    out: F64,
) -> None:
    """Move the points: ``H_pp dx_p = -g_p - H_cp^T dx_c`` (Eq. 10).

    steps: (M, 6) of every camera, 0 where fixed.  out: (3, P) the moved points.
    """
    local = np.empty(8 * BLOCK)
    V = np.empty(9 * BLOCK)
    L = np.empty(6 * BLOCK)
    y = np.empty(DEPTH)
    for block in range(seen.shape[1]):
        lo = block * BLOCK
        hi = lo + BLOCK
        V[:] = 0.0
        for m in range(cameras.shape[0]):
            if seen[m, block] == 0:
                continue
            linearise_block(
                cameras, pinholes, lenses, m, lo, points, u, v, w, limits, local, V
            )  # fmt: skip
            if np.any(steps[m] != 0.0):
                carry_step(motion_of(cameras, m), local, steps[m], V)
        factor_points(V, movable[lo:hi], damping, L, y)
        substitute_points(points, lo, L, y, out)


@fast_kernel
def carry_step(T: Any, local: F64, step: F64, V: F64) -> None:
    """Subtract ``H_pc dx_c`` from the negative gradients in V."""
    d0, d1, d2, w0, w1, w2 = step[0], step[1], step[2], step[3], step[4], step[5]
    for i in range(BLOCK):
        x, y, iz = local[i], local[BLOCK + i], local[2 * BLOCK + i]
        # How the step moves the point on the plane z = 1: B dx_c.
        m0 = (d0 - x * d2) * iz - x * y * w0 + (1.0 + x * x) * w1 - y * w2
        m1 = (d1 - y * d2) * iz - (1.0 + y * y) * w0 + x * y * w1 + x * w2
        a, c = (
            local[3 * BLOCK + i] * m0 + local[4 * BLOCK + i] * m1,
            local[4 * BLOCK + i] * m0 + local[5 * BLOCK + i] * m1,
        )
        p0, p1, p2, q0, q1, q2 = point_rows(T, x, y, iz)
        V[6 * BLOCK + i] -= a * p0 + c * q0
        V[7 * BLOCK + i] -= a * p1 + c * q1
        V[8 * BLOCK + i] -= a * p2 + c * q2


@fast_kernel
def substitute_points(points: F64, lo: int, L: F64, y: F64, out: F64) -> None:
    """``L^T dx = y`` for every point of a block, added to the points."""
    for i in range(BLOCK):
        e2 = y[2 * BLOCK + i] * L[5 * BLOCK + i]
        e1 = (y[BLOCK + i] - L[4 * BLOCK + i] * e2) * L[2 * BLOCK + i]
        e0 = (y[i] - L[BLOCK + i] * e1 - L[3 * BLOCK + i] * e2) * L[i]
        out[0, lo + i] = points[0, lo + i] + e0
        out[1, lo + i] = points[1, lo + i] + e1
        out[2, lo + i] = points[2, lo + i] + e2
