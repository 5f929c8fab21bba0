"""The cost of Eq. 6: limits of the robust kernel, total cost, squared residuals."""

from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.bundle.layout import BLOCK, Layout
from pliant.algorithms.bundle.problem import BundleParameters
from pliant.algorithms.bundle.projection import (
    lens_of,
    motion_of,
    pinhole_of,
    residual,
    robust_cost,
)
from pliant.algorithms.kernel import fast_kernel

BEHIND_PX2 = 1e8
"""Squared residual charged behind a camera without a kernel; above all real ones, and constant."""

Limits = tuple[Any, Any, Any, Any]
"""(1 / sigma^2, cost of a point behind its camera in px^2, least depth, least distance from the
camera's plane) for the kernels."""

LEAST_DISTANCE = 1e-6
"""Map units.  Where a point may lie behind, it must still not lie in the plane of the camera."""


def limits_of(parameters: BundleParameters) -> Limits:
    """What the kernels need of the parameters, in float64.

    Geman-McClure: ``rho(s) = s / (1 + s / sigma^2)``, weight ``rho'(s) = 1 / (1 + s / sigma^2)^2``,
    s the squared residual.  rho(s) ~ s near 0 and saturates at sigma^2, which is what a point
    behind a camera costs.
    """
    sigma2 = parameters.kernel_sigma_px**2
    if sigma2 <= 0.0:
        return 0.0, BEHIND_PX2, parameters.min_depth, LEAST_DISTANCE
    return 1.0 / sigma2, sigma2, parameters.min_depth, LEAST_DISTANCE


def float32_limits(parameters: BundleParameters) -> Limits:
    """``limits_of`` in float32."""
    a, b, c, d = limits_of(parameters)
    return np.float32(a), np.float32(b), np.float32(c), np.float32(d)


def total_cost(layout: Layout, cameras: F64, points: F64, parameters: BundleParameters) -> float:
    """``0.5 sum w rho(r^2)`` in px^2."""
    return float(
        _total_cost(
            cameras, layout.pinholes, layout.lenses, points, layout.u, layout.v, layout.w,
            layout.seen, limits_of(parameters),
        )
    )  # fmt: skip


def squared_residuals(
    layout: Layout, cameras: F64, points: F64, parameters: BundleParameters
) -> F32:
    """(M, P) squared residuals, px^2; inf where nothing is seen or the point lies behind."""
    return _squared_residuals(
        cameras, layout.pinholes, layout.lenses, points, layout.u, layout.v, layout.w,
        limits_of(parameters),
    )  # fmt: skip


@fast_kernel
def _total_cost(
    cameras: F64,
    pinholes: F64,
    lenses: F64,
    points: F64,
    u: F32,
    v: F32,
    w: F32,
    seen: U8,
    limits: Limits,
) -> float:
    total = 0.0
    for m in range(cameras.shape[0]):
        T, K, lens = motion_of(cameras, m), pinhole_of(pinholes, m), lens_of(lenses, m)
        for b in range(seen.shape[1]):
            if seen[m, b] == 0:
                continue
            lo = b * BLOCK
            X, Y, Z = points[0, lo:], points[1, lo:], points[2, lo:]
            um, vm, wm = u[m, lo:], v[m, lo:], w[m, lo:]
            for i in range(BLOCK):
                _, _, _, front, du, dv = residual(
                    1.0, T, K, lens, X[i], Y[i], Z[i], um[i], vm[i], limits
                )
                total += robust_cost(1.0, du, dv, wm[i], front, limits)
    return 0.5 * total


@fast_kernel
def _squared_residuals(
    cameras: F64,
    pinholes: F64,
    lenses: F64,
    points: F64,
    u: F32,
    v: F32,
    w: F32,
    limits: Limits,
) -> F32:
    out = np.empty(u.shape, np.float32)
    for m in range(cameras.shape[0]):
        T, K, lens = motion_of(cameras, m), pinhole_of(pinholes, m), lens_of(lenses, m)
        X, Y, Z = points[0], points[1], points[2]
        um, vm, wm, om = u[m], v[m], w[m], out[m]
        for i in range(X.size):
            _, _, _, front, du, dv = residual(
                1.0, T, K, lens, X[i], Y[i], Z[i], um[i], vm[i], limits
            )
            good = front & (wm[i] > 0.0)
            om[i] = np.float32(du * du + dv * dv) if good else np.float32(np.inf)
    return out
