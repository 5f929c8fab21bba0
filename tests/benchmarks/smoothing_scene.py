"""Vertices on planes, a crease and steps, with noise and outliers, to measure smoothing on."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, F64, BoolArray
from pliant.algorithms.meshing.delaunay import Triangulation, triangulate

NOISE = 0.01
# u0, v0, u1, v1 of patches in front, their inverse depth at the centre and its slopes per px.
PATCHES = (
    (80, 60, 240, 200, 0.70, 0.0008, 0.0),
    (330, 250, 560, 420, 0.76, 0.0, -0.0005),
    (120, 300, 220, 440, 0.55, 0.0, 0.0),
)
CREASE_U = 420.0


@dataclass(frozen=True)
class Scene:
    """Vertices in raster order.

    true, data, sigmas: (M,) inverse depth.    distance_px: (M,) to the nearest step.
    """

    points_px: F32
    true: F64
    data: F32
    sigmas: F32
    distance_px: F64
    outliers: BoolArray
    mesh: Triangulation


def make_scene(count: int, seed: int, outlier_share: float = 0.1) -> Scene:
    """A keyframe of 640x480 px; data of outliers are anywhere in 0.1 .. 1."""
    generator = np.random.default_rng(seed)
    points = generator.uniform((0, 0), (640, 480), (count, 2)).astype(np.float32)
    mesh = triangulate(points)
    points = points[mesh.vertices]
    u, v = points.astype(np.float64).T
    true = 0.25 + 0.0003 * np.minimum(u, CREASE_U) - 0.0006 * np.maximum(u - CREASE_U, 0.0)
    true += 0.0002 * v
    distance = np.full(len(u), np.inf)
    for u0, v0, u1, v1, depth, slope_u, slope_v in PATCHES:
        inside = (u > u0) & (u < u1) & (v > v0) & (v < v1)
        plane = depth + slope_u * (u - (u0 + u1) / 2) + slope_v * (v - (v0 + v1) / 2)
        true = np.where(inside, plane, true)
        du = np.maximum(np.maximum(u0 - u, u - u1), 0.0)
        dv = np.maximum(np.maximum(v0 - v, v - v1), 0.0)
        within = np.minimum(np.minimum(u - u0, u1 - u), np.minimum(v - v0, v1 - v))
        distance = np.minimum(distance, np.where(inside, within, np.hypot(du, dv)))
    data = true + NOISE * generator.standard_normal(len(u))
    outliers = generator.random(len(u)) < outlier_share
    data = np.where(outliers, generator.uniform(0.1, 1.0, len(u)), data)
    sigmas = np.full(len(u), NOISE, np.float32)
    return Scene(points, true, data.astype(np.float32), sigmas, distance, outliers, mesh)


def rmse(error: F32 | F64) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(error**2)))
