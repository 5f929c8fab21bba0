"""Kernels of the Schur complement solver with a calibration that all cameras share.

The projection is ``u = fx e^s (1 + k1 r^2 + k2 r^4) x + cx`` with r^2 = x^2 + y^2 on the plane
z = 1, likewise for v, and the unknowns of the calibration are q = (s, k1, k2).  Its derivative is
``K (x, y)^T h_q`` with K = diag(fx e^s, fy e^s) and

    h = (1 + k1 r^2 + k2 r^4,  r^2,  r^4)       for  s, k1, k2.

The Jacobian of the lens is ``F = K D`` with ``D = d I + e (x, y)^T (x, y)``, where d is h_s and
e = 2 k1 + 4 k2 r^2.  (x, y) is an eigenvector of D: ``D (x, y)^T = (d + e r^2) (x, y)^T``.
So a calibration unknown moves the point on the plane z = 1 as if by

    A_q = (x, y)^T rho_q,     rho_q = h_q / (1 + 3 k1 r^2 + 5 k2 r^4),     F A_q = d(u, v) / dq.

A fourth unknown is the readout of a rolling shutter, as a share of the frame interval: it moves an
observation by the readout times its flow (see ``solve_calibrating``), so that ``A = F^-1 flow``.
An unknown enters the Hessian like a column of B (see ``projection``): with M and e of that module
the blocks are ``A^T M A``, ``A^T M B``, ``A^T M P`` and the negative gradient ``A^T e``.  So the
calibration is one more camera, which sees every point and whose last two unknowns are void.
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
from pliant.algorithms.bundle.projection import motion_of, pinhole_of, point_rows
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

UNKNOWNS = 4
"""Logarithm of the focal length's factor, k1, k2, readout."""

PAIRS = UNKNOWNS * (UNKNOWNS + 1) // 2


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
    flow: F32,
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

    flow: (2, M, P) px.     w: (M + 1, P), the last row positive where any camera sees the point.
    S: (6F + 6, 6F + 6).     b: (6F + 6,).     normal: (M, 27) as there.
    cross: (M, 6 UNKNOWNS) ``A^T M B`` of each camera, shared: (PAIRS + UNKNOWNS,) lower triangle of
    ``A^T M A`` by rows, then ``A^T e``: added to.
    """
    M = cameras.shape[0]
    F = S.shape[0] // 6 - 1
    U = np.empty((M + 1, 6 * DEPTH))
    common = np.empty(6 * DEPTH)
    local = np.empty(8 * BLOCK)
    A = np.empty(2 * UNKNOWNS * BLOCK)
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
            calibration_moves(pinholes, lenses[m], m, lo, flow, local, A)
            calibration_points(motion_of(cameras, m), local, A, common)
            calibration_cameras(local, A, cross[m], shared)
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
def calibration_moves(
    pinholes: F64, lens: F64, m: int, lo: int, flow: F32, local: F64, A: F64
) -> None:
    """Write A (UNKNOWNS x 2 x BLOCK) of one camera and block."""
    K, k1, k2 = pinhole_of(pinholes, m), lens[0], lens[1]
    fu, fv = flow[0, m, lo : lo + BLOCK], flow[1, m, lo : lo + BLOCK]
    for i in range(BLOCK):
        x, y = local[i], local[BLOCK + i]
        n2 = x * x + y * y
        s0, s1, s2 = radial_shares(n2, k1, k2)
        A[i] = s0 * x
        A[BLOCK + i] = s0 * y
        A[2 * BLOCK + i] = s1 * x
        A[3 * BLOCK + i] = s1 * y
        A[4 * BLOCK + i] = s2 * x
        A[5 * BLOCK + i] = s2 * y
        # D^-1 by Sherman and Morrison.
        a, c = fu[i] / K[0], fv[i] / K[1]
        d, e = 1.0 + n2 * (k1 + k2 * n2), 2.0 * k1 + 4.0 * k2 * n2
        t = e * (x * a + y * c) / (d + e * n2)
        A[6 * BLOCK + i] = (a - t * x) / d
        A[7 * BLOCK + i] = (c - t * y) / d


@fast_kernel
def calibration_points(T: Any, local: F64, A: F64, W: F64) -> None:
    """Add ``A^T M P`` of one camera and block to W (6 x 3 x BLOCK); the last rows stay."""
    for q in range(UNKNOWNS):
        Aq, Wq = A[2 * q * BLOCK :], W[q * DEPTH :]
        for i in range(BLOCK):
            x, y, iz = local[i], local[BLOCK + i], local[2 * BLOCK + i]
            m00, m01, m11 = local[3 * BLOCK + i], local[4 * BLOCK + i], local[5 * BLOCK + i]
            a = m00 * Aq[i] + m01 * Aq[BLOCK + i]
            c = m01 * Aq[i] + m11 * Aq[BLOCK + i]
            p0, p1, p2, q0, q1, q2 = point_rows(T, x, y, iz)
            Wq[i] += a * p0 + c * q0
            Wq[BLOCK + i] += a * p1 + c * q1
            Wq[2 * BLOCK + i] += a * p2 + c * q2


@fast_kernel
def calibration_cameras(local: F64, A: F64, cross: F64, shared: F64) -> None:
    """Add ``A^T M B`` (UNKNOWNS x 6 by rows) to cross, ``A^T M A`` and ``A^T e`` to shared."""
    at = 0
    for q in range(UNKNOWNS):
        Aq = A[2 * q * BLOCK :]
        for p in range(q + 1):
            Ap = A[2 * p * BLOCK :]
            h = 0.0
            for i in range(BLOCK):
                m00, m01, m11 = local[3 * BLOCK + i], local[4 * BLOCK + i], local[5 * BLOCK + i]
                a, c = Ap[i], Ap[BLOCK + i]
                h += Aq[i] * (m00 * a + m01 * c) + Aq[BLOCK + i] * (m01 * a + m11 * c)
            shared[at] += h
            at += 1
        g = t0 = t1 = t2 = t3 = t4 = t5 = 0.0
        for i in range(BLOCK):
            x, y, iz = local[i], local[BLOCK + i], local[2 * BLOCK + i]
            m00, m01, m11 = local[3 * BLOCK + i], local[4 * BLOCK + i], local[5 * BLOCK + i]
            g += Aq[i] * local[6 * BLOCK + i] + Aq[BLOCK + i] * local[7 * BLOCK + i]
            a = m00 * Aq[i] + m01 * Aq[BLOCK + i]
            c = m01 * Aq[i] + m11 * Aq[BLOCK + i]
            r = x * a + y * c
            t0 += iz * a
            t1 += iz * c
            t2 -= iz * r
            t3 -= c + y * r
            t4 += a + x * r
            t5 += x * c - y * a
        shared[PAIRS + q] += g
        sums = (t0, t1, t2, t3, t4, t5)
        for k in range(6):
            cross[6 * q + k] += sums[k]


@kernel
def calibrated_substitution(
    cameras: F64,
    pinholes: F64,
    lenses: F64,
    points: F64,
    movable: U8,
    u: F32,
    v: F32,
    flow: F32,
    w: F32,
    seen: U8,
    limits: Limits,
    damping: float,
    steps: F64,
    change: F64,
    out: F64,
) -> None:
    """``schur_kernels.back_substitute`` after a ``change`` (UNKNOWNS,) of the calibration too."""
    local = np.empty(8 * BLOCK)
    A = np.empty(2 * UNKNOWNS * BLOCK)
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
            calibration_moves(pinholes, lenses[m], m, lo, flow, local, A)
            carry_change(motion_of(cameras, m), local, A, change, V)
        factor_points(V, movable[lo : lo + BLOCK], damping, L, y)
        substitute_points(points, lo, L, y, out)


@fast_kernel
def carry_change(T: Any, local: F64, A: F64, change: F64, V: F64) -> None:
    """Subtract ``P^T M A dq`` from the negative gradients in V."""
    for i in range(BLOCK):
        x, y, iz = local[i], local[BLOCK + i], local[2 * BLOCK + i]
        m00, m01, m11 = local[3 * BLOCK + i], local[4 * BLOCK + i], local[5 * BLOCK + i]
        dx = dy = 0.0
        for q in range(UNKNOWNS):
            dx += change[q] * A[2 * q * BLOCK + i]
            dy += change[q] * A[(2 * q + 1) * BLOCK + i]
        a, c = m00 * dx + m01 * dy, m01 * dx + m11 * dy
        p0, p1, p2, q0, q1, q2 = point_rows(T, x, y, iz)
        V[6 * BLOCK + i] -= a * p0 + c * q0
        V[7 * BLOCK + i] -= a * p1 + c * q1
        V[8 * BLOCK + i] -= a * p2 + c * q2
