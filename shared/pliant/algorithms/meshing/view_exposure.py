"""Exposure of views, from the colours of surface points that several of them show.

View k shows point i in the colour c_ik = g_k a_i, in each channel: g is the exposure (with white
balance) and a the point's own colour.  A power law of the sensor leaves this form as it is.  With
x = log g and y = log a the gains minimise

    sum_ik w_ik |log c_ik - x_k - y_i|^2 + sum_k |x_k|^2

where w are Cauchy weights, renewed a few times, and the second term holds views that share no
points with others.  Each y_i is a mean, so it is eliminated: a system of as many unknowns as views
remains.  Its gauge is that the mean of log g is 0, so that the mean gain is 1.
"""

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, I64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse

_WINDOW = 0.01
"""Share of the width over which a colour is averaged: parallax within it does not matter."""
_DARK, _BRIGHT = 12.0, 250.0
"""Grey levels between which a colour grows with exposure: beyond are noise and saturation."""
_MIN_COSINE = 0.3
_DEPTH_TOLERANCE = 0.03
"""Share of its depth by which what a view sees may lie before or behind a point."""
_ROUNDS = 6
_CAUCHY_SIGMAS = 2.0
_BLOCK = 512
"""Points whose part of the system is made at a time: it bounds the memory."""


class ExposureSamples:
    """Colours of surface points in one view after the other.

    positions, normals: (S, 3) of the points, unit normals.
    """

    def __init__(self, positions: F32, normals: F32) -> None:
        self._positions, self._normals = positions, normals
        self._points: list[I64] = []
        self._logs: list[F64] = []

    def add(self, image: U8, depths: F32, camera: PinholeCamera, T_world_camera: F64) -> None:
        """The next view.  image: (H, W, 3).  depths: (H, W) along z of the surface, 0: none."""
        T = inverse(T_world_camera)
        local = self._positions @ T[:3, :3].T + T[:3, 3]
        ways = T_world_camera[:3, 3] - self._positions
        cosines = (self._normals * ways).sum(axis=1) / np.linalg.norm(ways, axis=1)
        rows = np.flatnonzero((local[:, 2] > 0.0) & (cosines > _MIN_COSINE))
        pixels = np.rint(camera.project(local[rows]))
        inside = np.all((pixels >= 0) & (pixels < (camera.width, camera.height)), axis=1)
        rows, (u, v) = rows[inside], pixels[inside].astype(np.int64).T
        side = 2 * int(0.5 * _WINDOW * camera.width) + 3
        window = np.ones((side, side), np.uint8)
        # Only where all of the window is on the same surface, and not saturated.
        near = cv2.erode(np.where(depths > 0.0, depths, np.float32(np.inf)), window)
        far = cv2.dilate(depths, window)
        z = local[rows, 2]
        same = near[v, u] > (1.0 - _DEPTH_TOLERANCE) * z
        same &= far[v, u] < (1.0 + _DEPTH_TOLERANCE) * z
        colours = cv2.blur(image, (side, side))[v, u].astype(np.float64)
        same &= (colours.min(axis=1) > _DARK) & (
            cv2.dilate(image, window)[v, u].max(axis=1) < _BRIGHT
        )
        self._points.append(rows[same])
        self._logs.append(np.log(colours[same]))

    def gains(self) -> F64:
        """(K, 3) exposure of each view and channel, of which the geometric mean is 1."""
        views = np.repeat(np.arange(len(self._points)), [len(rows) for rows in self._points])
        if not len(views):
            return np.ones((len(self._points), 3))
        points, logs = np.concatenate(self._points), np.concatenate(self._logs)
        order = np.argsort(points, kind="stable")
        points, views, logs = points[order], views[order], logs[order]
        weights = np.ones(len(points))
        x = np.zeros((len(self._points), 3))
        for _ in range(_ROUNDS):
            x = log_gains(points, views, logs, weights, len(x))
            y = _means(points, logs - x[views], weights)
            errors = np.linalg.norm(logs - x[views] - y[points], axis=1)
            sigma = max(_CAUCHY_SIGMAS * float(np.median(errors)), 1e-6)
            weights = 1.0 / (1.0 + (errors / sigma) ** 2)
        return np.exp(x - x.mean(axis=0))


def log_gains(points: I64, views: I64, logs: F64, weights: F64, count: int) -> F64:
    """(count, 3) x of the views, by the normal equations without the points.

    points: (N,) ascending, each at most once in a view.    views: (N,).    logs: (N, 3).
    weights: (N,).
    """
    system = np.diag(1.0 + np.bincount(views, weights, count))
    left = logs - _means(points, logs, weights)[points]
    b = np.stack([np.bincount(views, weights * c, count) for c in left.T], axis=1)
    totals = np.bincount(points, weights)
    for first in range(0, len(totals), _BLOCK):
        end = min(first + _BLOCK, len(totals))
        rows = slice(*np.searchsorted(points, (first, end)))
        shares = np.zeros((end - first, count))
        shares[points[rows] - first, views[rows]] = weights[rows]
        system -= shares.T @ (shares / np.maximum(totals[first:end, None], 1e-12))
    return np.asarray(np.linalg.solve(system, b), np.float64)


def _means(points: I64, values: F64, weights: F64) -> F64:
    """(P, C) weighted means of the values (N, C) of each point."""
    totals = np.maximum(np.bincount(points, weights), 1e-12)
    return np.stack([np.bincount(points, weights * c) / totals for c in values.T], axis=1)
