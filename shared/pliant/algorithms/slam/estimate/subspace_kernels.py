"""Kernels of the subspace Gauss-Newton method, in float32 and vectorised over points."""

from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, F64, BoolArray
from pliant.algorithms.slam.estimate.dense_layout import BLOCK, Table
from pliant.algorithms.slam.estimate.pose_prior import add_prior, prior_cost
from pliant.algorithms.slam.estimate.projection import (
    Cameras,
    Limits,
    Seen,
    Triangle,
    apply_metric,
    corner,
    lens_of,
    motion_of,
    move_camera,
    observe,
    observe_uncertain,
    pinhole_of,
    point_rows,
    residual,
    robust_cost,
    row_of,
    solve_camera,
    solve_point,
)
from pliant.compiler.kernel import fast_kernel, kernel

ZERO, ONE = np.float32(0.0), np.float32(1.0)
SINGULAR = np.float32(1e-6)


@fast_kernel
def _linearise_points(
    cameras: Cameras,
    m: int,
    lo: int,
    points: F32,
    table: Table,
    limits: Limits,
    V: F32,
    cost: F32,
) -> None:
    """Add camera m's part to H_pp and the negative gradients (9 x BLOCK), and to the costs."""
    T, K, lens = motion_of(cameras, m), pinhole_of(cameras, m), lens_of(cameras, m)
    hi = lo + BLOCK
    X, Y, Z = points[0, lo:hi], points[1, lo:hi], points[2, lo:hi]
    um, vm, wm = table.u[m, lo:hi], table.v[m, lo:hi], table.w[m, lo:hi]
    for i in range(BLOCK):
        x, y, iz, m00, m01, m11, e0, e1, own = observe(
            ONE, T, K, lens, (X[i], Y[i], Z[i]), Seen(um[i], vm[i], wm[i]), limits
        )
        cost[i] += own
        p0, p1, p2, q0, q1, q2 = point_rows(T, x, y, iz)
        a0, b0 = apply_metric(m00, m01, m11, p0, q0)
        a1, b1 = apply_metric(m00, m01, m11, p1, q1)
        a2, b2 = apply_metric(m00, m01, m11, p2, q2)
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
def _cost_of_points(
    cameras: Cameras,
    m: int,
    lo: int,
    points: F32,
    table: Table,
    limits: Limits,
    cost: F32,
) -> None:
    """Add camera m's part to the costs of the points (3 x BLOCK)."""
    T, K, lens = motion_of(cameras, m), pinhole_of(cameras, m), lens_of(cameras, m)
    hi = lo + BLOCK
    um, vm, wm = table.u[m, lo:hi], table.v[m, lo:hi], table.w[m, lo:hi]
    for i in range(BLOCK):
        _, _, _, front, du, dv = residual(
            ONE, T, K, lens, (points[i], points[BLOCK + i], points[2 * BLOCK + i]),
            um[i], vm[i], limits,
        )  # fmt: skip
        cost[i] += robust_cost(ONE, du, dv, wm[i], front, limits)


@fast_kernel
def sweep_points(
    cameras: Cameras,
    points: F32,
    exact: F64,
    table: Table,
    limits: Limits,
    damping: Any,
) -> tuple[float, float]:
    """One damped Gauss-Newton step of every point, cameras fixed (Eq. 12).

    points: (3, P) float32, moved in place, as is exact, its float64 master.  A point moves only
    if that lowers its own cost.  Returns the cost before and after.
    """
    before_total, after_total = 0.0, 0.0
    V = np.empty(9 * BLOCK, np.float32)
    trial = np.empty(3 * BLOCK, np.float32)
    before = np.empty(BLOCK, np.float32)
    after = np.empty(BLOCK, np.float32)
    grow = ONE + damping
    for b in range(table.seen.shape[1]):
        lo, hi = b * BLOCK, (b + 1) * BLOCK
        X, Y, Z = points[0, lo:hi], points[1, lo:hi], points[2, lo:hi]
        V[:] = ZERO
        before[:] = ZERO
        after[:] = ZERO
        for m in range(cameras.motion.shape[0]):
            if table.seen[m, b] != 0:
                _linearise_points(cameras, m, lo, points, table, limits, V, before)
        for i in range(BLOCK):
            damped = Triangle(
                V[i] * grow, V[BLOCK + i], V[2 * BLOCK + i] * grow,
                V[3 * BLOCK + i], V[4 * BLOCK + i], V[5 * BLOCK + i] * grow,
            )  # fmt: skip
            descent = (V[6 * BLOCK + i], V[7 * BLOCK + i], V[8 * BLOCK + i])
            s0, s1, s2 = solve_point(ONE, damped, descent, SINGULAR)
            trial[i] = X[i] + s0
            trial[BLOCK + i] = Y[i] + s1
            trial[2 * BLOCK + i] = Z[i] + s2
        for m in range(cameras.motion.shape[0]):
            if table.seen[m, b] != 0:
                _cost_of_points(cameras, m, lo, trial, table, limits, after)
        part_before, part_after = ZERO, ZERO
        for i in range(BLOCK):
            better = after[i] < before[i]
            part_before += before[i]
            part_after += after[i] if better else before[i]
            exact[0, lo + i] += (trial[i] - X[i]) if better else ZERO
            exact[1, lo + i] += (trial[BLOCK + i] - Y[i]) if better else ZERO
            exact[2, lo + i] += (trial[2 * BLOCK + i] - Z[i]) if better else ZERO
        for i in range(BLOCK):
            X[i] = np.float32(exact[0, lo + i])
            Y[i] = np.float32(exact[1, lo + i])
            Z[i] = np.float32(exact[2, lo + i])
        before_total += part_before
        after_total += part_after
    return float(0.5 * before_total), float(0.5 * after_total)


@fast_kernel
def _depths(spread: Any, lo: int, hi: int) -> Any:
    if len(spread) == 0:
        return ()
    each = spread[0]
    return each[0, lo:hi], each[1, lo:hi], each[2, lo:hi]


@fast_kernel(inline=True)
def _observe(
    T: Any, K: Any, lens: Any, point: Any, seen: Seen, limits: Limits, depths: Any, i: int,
    shared: Any,
) -> Any:  # fmt: skip
    if len(depths) == 0:
        x, y, iz, m00, m01, m11, e0, e1, cost = observe(ONE, T, K, lens, point, seen, limits)
        return x, y, iz, m00, m01, m11, e0, e1, cost, ZERO, ZERO
    depth = (depths[0][i], depths[1][i], depths[2][i])
    return observe_uncertain(ONE, T, K, point, depth, shared, seen, limits)[:11]


@fast_kernel
def linearise_camera(
    m: int,
    cameras: Cameras,
    points: F32,
    table: Table,
    limits: Limits,
    spread: Any,
    shared: Any,
    out: F64,
) -> None:
    """Write (36,) of camera m: H (lower triangle by rows), negative gradient, cost (Eq. 11).

    Of seven unknowns: ``move_camera``'s step, and shared, which moves the points by spread:
    ((3, P),) of their depths, see ``inverse_depth``; () where all are certain.
    """
    T, K, lens = motion_of(cameras, m), pinhole_of(cameras, m), lens_of(cameras, m)
    out[:] = 0.0
    b = 0
    while b < table.seen.shape[1]:
        if table.seen[m, b] == 0:
            b += 1
            continue
        lo = b * BLOCK
        while b < table.seen.shape[1] and table.seen[m, b] != 0:
            b += 1
        hi = b * BLOCK
        X, Y, Z = points[0, lo:hi], points[1, lo:hi], points[2, lo:hi]
        um, vm, wm = table.u[m, lo:hi], table.v[m, lo:hi], table.w[m, lo:hi]
        depths = _depths(spread, lo, hi)
        total = ZERO
        h00 = h10 = h11 = h20 = h21 = h22 = h30 = h31 = h32 = h33 = ZERO
        h40 = h41 = h42 = h43 = h44 = h50 = h51 = h52 = h53 = h54 = h55 = ZERO
        h60 = h61 = h62 = h63 = h64 = h65 = h66 = ZERO
        g0 = g1 = g2 = g3 = g4 = g5 = g6 = ZERO
        for i in range(hi - lo):
            x, y, iz, m00, m01, m11, e0, e1, cost, a6, b6 = _observe(
                T, K, lens, (X[i], Y[i], Z[i]), Seen(um[i], vm[i], wm[i]), limits, depths, i, shared
            )
            total += cost
            a2, b2 = -x * iz, -y * iz
            a3, b3 = -x * y, -(ONE + y * y)
            a4, b4 = ONE + x * x, x * y
            a5, b5 = -y, x
            p2, q2 = apply_metric(m00, m01, m11, a2, b2)
            p3, q3 = apply_metric(m00, m01, m11, a3, b3)
            p4, q4 = apply_metric(m00, m01, m11, a4, b4)
            p5, q5 = apply_metric(m00, m01, m11, a5, b5)
            h00 += m00 * iz * iz
            h11 += m11 * iz * iz
            h10 += corner(m01, iz * iz, ZERO)
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
            if len(depths) != 0:
                p6, q6 = apply_metric(m00, m01, m11, a6, b6)
                h60 += p6 * iz
                h61 += q6 * iz
                h62 += p6 * a2 + q6 * b2
                h63 += p6 * a3 + q6 * b3
                h64 += p6 * a4 + q6 * b4
                h65 += p6 * a5 + q6 * b5
                h66 += p6 * a6 + q6 * b6
                g6 += e0 * a6 + e1 * b6
        sums = (
            h00, h10, h11, h20, h21, h22, h30, h31, h32, h33, h40, h41, h42, h43, h44,
            h50, h51, h52, h53, h54, h55, h60, h61, h62, h63, h64, h65, h66,
            g0, g1, g2, g3, g4, g5, g6, total,
        )  # fmt: skip
        for r in range(36):
            out[r] += sums[r]


@fast_kernel
def camera_cost(
    camera: F32,
    m: int,
    cameras: Cameras,
    points: F32,
    table: Table,
    limits: Limits,
) -> float:
    """``sum w rho`` of camera m at the trial motion camera (12,)."""
    T, K, lens = row_of(camera), pinhole_of(cameras, m), lens_of(cameras, m)
    X, Y, Z = points[0], points[1], points[2]
    um, vm, wm = table.u[m], table.v[m], table.w[m]
    total = ZERO
    for i in range(X.size):
        _, _, _, front, du, dv = residual(ONE, T, K, lens, (X[i], Y[i], Z[i]), um[i], vm[i], limits)
        total += robust_cost(ONE, du, dv, wm[i], front, limits)
    return float(total)


@kernel
def sweep_cameras(
    exact: F64,
    cameras: Cameras,
    free: BoolArray,
    points: F32,
    table: Table,
    limits: Limits,
    damping: float,
    mean: F64,
    information: F64,
) -> float:
    """One damped Gauss-Newton step of every movable camera, points fixed (Eq. 11).

    exact (M, 12) is the float64 master of the cameras' motion; both are moved in place.  A camera
    moves only if that lowers its own cost.   mean, information: (12,) and (6, 6) of a prior of the
    last camera.  Returns the decrease of the cost.
    """
    last = exact.shape[0] - 1
    normal = np.empty(36)
    step = np.empty(6)
    moved = np.empty(12)
    trial = np.empty(12, np.float32)
    decrease = 0.0
    for m in range(exact.shape[0]):
        if not free[m]:
            continue
        linearise_camera(m, cameras, points, table, limits, (), ZERO, normal)
        if m == last:
            add_prior(exact[m], mean, information, normal)
        if not solve_camera(normal, normal[28:], damping, step):
            continue
        move_camera(exact[m], step, moved)
        for k in range(12):
            trial[k] = np.float32(moved[k])
        cost = camera_cost(trial, m, cameras, points, table, limits)
        if m == last:
            cost += prior_cost(moved, mean, information)
        if cost < normal[35]:
            decrease += 0.5 * (normal[35] - cost)
            for k in range(12):
                exact[m, k] = moved[k]
                cameras.motion[m, k] = trial[k]
    return decrease
