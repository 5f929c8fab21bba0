"""Kernels of the Schur complement solver with a calibration that all cameras share.

The projection is ``u = fx e^s (1 + k1 r^2 + k2 r^4) x + cx`` with r^2 = x^2 + y^2 on the plane
z = 1, likewise for v, and the unknowns of the calibration are q = (s, k1, k2).  Its derivative is
``K (x, y)^T h_q`` with K = diag(fx e^s, fy e^s) and

    h = (1 + k1 r^2 + k2 r^4,  r^2,  r^4)       for  s, k1, k2.

The Jacobian of the lens is ``F = K D`` with ``D = d I + e (x, y)^T (x, y)``, where d is h_s and
e = 2 k1 + 4 k2 r^2.  (x, y) is an eigenvector of D: ``D (x, y)^T = (d + e r^2) (x, y)^T``.
So a calibration unknown moves the point on the plane z = 1 as if by

    A_q = (x, y)^T rho_q,     rho_q = h_q / (1 + 3 k1 r^2 + 5 k2 r^4),     F A_q = d(u, v) / dq,

and enters the Hessian like a column of B (see ``projection``): with M and e of that module the
blocks are ``A^T M A``, ``A^T M B``, ``A^T M P`` and the negative gradient ``A^T e``.  So the
calibration is one more camera, which sees every point and whose last three unknowns are void.
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
from pliant.algorithms.bundle.projection import motion_of, point_rows
from pliant.algorithms.bundle.schur_kernels import (
    camera_block,
    carry_step,
    couple_block,
    factor_points,
    linearise_block,
    substitute_points,
    whiten,
)
from pliant.algorithms.kernel import fast_kernel, inline_kernel, kernel


@inline_kernel
def radial_shares(n2: Any, k1: Any, k2: Any) -> Any:
    """rho of s, k1 and k2 at the squared radius n2."""
    inverse = 1.0 / (1.0 + n2 * (3.0 * k1 + 5.0 * k2 * n2))
    return (1.0 + n2 * (k1 + k2 * n2)) * inverse, n2 * inverse, n2 * n2 * inverse


@kernel
def calibrated_system(
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
    cross: F64,
    shared: F64,
) -> None:
    """``schur_kernels.reduced_system`` with the calibration in the last six rows.

    w: (M + 1, P), the last row positive where any camera sees the point.
    S: (6F + 6, 6F + 6).     b: (6F + 6,).     normal: (M, 27) as there.
    cross: (M, 18) ``A^T M B`` of each camera, shared: (9,) lower triangle of ``A^T M A`` by rows,
    then ``A^T e``: added to.
    """
    M = cameras.shape[0]
    F = S.shape[0] // 6 - 1
    U = np.empty((M + 1, 6 * DEPTH))
    common = np.empty(6 * DEPTH)
    local = np.empty(8 * BLOCK)
    V = np.empty(9 * BLOCK)
    L = np.empty(6 * BLOCK)
    y = np.empty(DEPTH)
    rows = np.empty(M + 1, np.int64)
    slots = np.empty(M + 1, np.int64)
    cameras_of = np.empty((BLOCK, M + 1), np.int32)
    seen_counts = np.empty(BLOCK, np.int32)
    packed = np.empty((M + 1, 18))
    for block in range(seen.shape[1]):
        lo = block * BLOCK
        hi = lo + BLOCK
        V[:] = 0.0
        common[:] = 0.0
        count = 0
        for m in range(M):
            if seen[m, block] == 0:
                continue
            linearise_block(
                cameras, pinholes, lenses, m, lo, points, u, v, w, limits, local, V
            )  # fmt: skip
            calibration_points(motion_of(cameras, m), lenses[m], local, common)
            calibration_cameras(lenses[m], local, cross[m], shared)
            if free[m] >= 0:
                rows[count], slots[count] = free[m], m
                couple_block(motion_of(cameras, m), local, U[count])
                camera_block(local, normal[m])
                count += 1
        rows[count], slots[count] = F, M
        U[count] = common
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
def calibration_points(T: Any, lens: F64, local: F64, W: F64) -> None:
    """Add ``A^T M P`` of one camera and block to W (6 x 3 x BLOCK); rows 3 to 5 stay."""
    k1, k2 = lens[0], lens[1]
    for i in range(BLOCK):
        x, y, iz = local[i], local[BLOCK + i], local[2 * BLOCK + i]
        m00, m01, m11 = local[3 * BLOCK + i], local[4 * BLOCK + i], local[5 * BLOCK + i]
        a, c = m00 * x + m01 * y, m01 * x + m11 * y
        p0, p1, p2, q0, q1, q2 = point_rows(T, x, y, iz)
        h0, h1, h2 = a * p0 + c * q0, a * p1 + c * q1, a * p2 + c * q2
        s0, s1, s2 = radial_shares(x * x + y * y, k1, k2)
        W[i] += s0 * h0
        W[BLOCK + i] += s0 * h1
        W[2 * BLOCK + i] += s0 * h2
        W[DEPTH + i] += s1 * h0
        W[DEPTH + BLOCK + i] += s1 * h1
        W[DEPTH + 2 * BLOCK + i] += s1 * h2
        W[2 * DEPTH + i] += s2 * h0
        W[2 * DEPTH + BLOCK + i] += s2 * h1
        W[2 * DEPTH + 2 * BLOCK + i] += s2 * h2


@fast_kernel
def calibration_cameras(lens: F64, local: F64, cross: F64, shared: F64) -> None:
    """Add ``A^T M B`` (3 x 6 by rows) to cross, ``A^T M A`` and ``A^T e`` to shared (9,)."""
    k1, k2 = lens[0], lens[1]
    h00 = h10 = h11 = h20 = h21 = h22 = g0 = g1 = g2 = 0.0
    for i in range(BLOCK):
        x, y = local[i], local[BLOCK + i]
        m00, m01, m11 = local[3 * BLOCK + i], local[4 * BLOCK + i], local[5 * BLOCK + i]
        e = x * local[6 * BLOCK + i] + y * local[7 * BLOCK + i]
        r = m00 * x * x + 2.0 * m01 * x * y + m11 * y * y
        s0, s1, s2 = radial_shares(x * x + y * y, k1, k2)
        h00 += s0 * s0 * r
        h10 += s1 * s0 * r
        h11 += s1 * s1 * r
        h20 += s2 * s0 * r
        h21 += s2 * s1 * r
        h22 += s2 * s2 * r
        g0 += s0 * e
        g1 += s1 * e
        g2 += s2 * e
    sums = (h00, h10, h11, h20, h21, h22, g0, g1, g2)
    for k in range(9):
        shared[k] += sums[k]
    for q in range(3):
        t0 = t1 = t2 = t3 = t4 = t5 = 0.0
        for i in range(BLOCK):
            x, y, iz = local[i], local[BLOCK + i], local[2 * BLOCK + i]
            m00, m01, m11 = local[3 * BLOCK + i], local[4 * BLOCK + i], local[5 * BLOCK + i]
            s0, s1, s2 = radial_shares(x * x + y * y, k1, k2)
            share = s0 if q == 0 else (s1 if q == 1 else s2)
            a, c = share * (m00 * x + m01 * y), share * (m01 * x + m11 * y)
            r = x * a + y * c
            t0 += iz * a
            t1 += iz * c
            t2 -= iz * r
            t3 -= c + y * r
            t4 += a + x * r
            t5 += x * c - y * a
        cross[6 * q] += t0
        cross[6 * q + 1] += t1
        cross[6 * q + 2] += t2
        cross[6 * q + 3] += t3
        cross[6 * q + 4] += t4
        cross[6 * q + 5] += t5


@kernel
def calibrated_substitution(
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
    change: F64,
    out: F64,
) -> None:
    """``schur_kernels.back_substitute`` after a step ``change`` (3,) of the calibration too."""
    local = np.empty(8 * BLOCK)
    V = np.empty(9 * BLOCK)
    L = np.empty(6 * BLOCK)
    y = np.empty(DEPTH)
    for block in range(seen.shape[1]):
        lo = block * BLOCK
        V[:] = 0.0
        for m in range(cameras.shape[0]):
            if seen[m, block] == 0:
                continue
            linearise_block(
                cameras, pinholes, lenses, m, lo, points, u, v, w, limits, local, V
            )  # fmt: skip
            if np.any(steps[m] != 0.0):
                carry_step(motion_of(cameras, m), local, steps[m], V)
            carry_change(motion_of(cameras, m), lenses[m], local, change, V)
        factor_points(V, movable[lo : lo + BLOCK], damping, L, y)
        substitute_points(points, lo, L, y, out)


@fast_kernel
def carry_change(T: Any, lens: F64, local: F64, change: F64, V: F64) -> None:
    """Subtract ``P^T M A dq`` from the negative gradients in V."""
    k1, k2 = lens[0], lens[1]
    c0, c1, c2 = change[0], change[1], change[2]
    for i in range(BLOCK):
        x, y, iz = local[i], local[BLOCK + i], local[2 * BLOCK + i]
        m00, m01, m11 = local[3 * BLOCK + i], local[4 * BLOCK + i], local[5 * BLOCK + i]
        s0, s1, s2 = radial_shares(x * x + y * y, k1, k2)
        share = s0 * c0 + s1 * c1 + s2 * c2
        a, c = share * (m00 * x + m01 * y), share * (m01 * x + m11 * y)
        p0, p1, p2, q0, q1, q2 = point_rows(T, x, y, iz)
        V[6 * BLOCK + i] -= a * p0 + c * q0
        V[7 * BLOCK + i] -= a * p1 + c * q1
        V[8 * BLOCK + i] -= a * p2 + c * q2
