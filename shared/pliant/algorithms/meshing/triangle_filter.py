"""Which triangles of a keyframe's mesh are surface: none across steps, too long or too slanted."""

import math

import numpy as np
from pydantic import Field

from pliant.algorithms.arrays import F32, F64, I32, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.kernel import kernel
from pliant.algorithms.parameters import Parameters


class TriangleFilterParameters(Parameters):
    """What a user may change about which triangles are kept."""

    max_edge_px: float = Field(
        default=100.0, gt=0.0, description="Longest edge of a triangle in the image, px."
    )
    max_depth_ratio: float = Field(
        default=1.4,
        gt=1.0,
        description="Largest over smallest depth of a triangle's corners: more is a jump.",
    )
    max_slant_deg: float = Field(
        default=75.0,
        gt=0.0,
        le=90.0,
        description="Largest angle between a triangle's normal and the ray to its centre, degrees.",
    )
    max_relative_sigma: float = Field(
        default=0.1,
        gt=0.0,
        description="Corners whose inverse depth is less certain (sigma over itself) are not used.",
    )
    min_observations: int = Field(
        default=2, ge=1, description="Corners seen in fewer frames are not used."
    )


def filter_triangles(
    triangles: I32,
    points_px: F32,
    inverse_depths: F32,
    sigmas: F32,
    observations: I32,
    camera: PinholeCamera,
    parameters: TriangleFilterParameters,
) -> BoolArray:
    """Which of the (T, 3) triangles to keep.

    points_px: (M, 2) vertices.    inverse_depths, sigmas: (M,) inverse depth along z and its
    standard deviation; not finite or not positive: the vertex is not used.    observations: (M,)
    frames that saw the vertex.
    """
    usable = (
        np.isfinite(points_px).all(axis=1)
        & np.isfinite(inverse_depths)
        & (inverse_depths > 0.0)
        & (sigmas <= parameters.max_relative_sigma * inverse_depths)
        & (observations >= parameters.min_observations)
    )
    rays = np.ones((len(points_px), 3))
    rays[:, 0] = (points_px[:, 0] - camera.cx) / camera.fx
    rays[:, 1] = (points_px[:, 1] - camera.cy) / camera.fy
    points = rays / np.where(usable, inverse_depths, 1.0)[:, None]
    min_cosine = math.cos(math.radians(parameters.max_slant_deg))
    return _kept(
        triangles, points_px, points, usable,
        parameters.max_edge_px, parameters.max_depth_ratio, min_cosine,
    )  # fmt: skip


@kernel
def _kept(
    triangles: I32, pixels: F32, points: F64, usable: BoolArray,
    max_edge_px: float, max_ratio: float, min_cosine: float,
) -> BoolArray:  # fmt: skip
    kept = np.zeros(len(triangles), np.bool_)
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if not (usable[a] and usable[b] and usable[c]):
            continue
        longest = 0.0
        for i, j in ((a, b), (b, c), (c, a)):
            du, dv = pixels[j, 0] - pixels[i, 0], pixels[j, 1] - pixels[i, 1]
            longest = max(longest, du * du + dv * dv)
        if longest > max_edge_px * max_edge_px:
            continue
        near = min(points[a, 2], points[b, 2], points[c, 2])
        far = max(points[a, 2], points[b, 2], points[c, 2])
        if far > max_ratio * near:
            continue
        p, q, r = points[a], points[b], points[c]
        e0, e1, e2 = q[0] - p[0], q[1] - p[1], q[2] - p[2]
        f0, f1, f2 = r[0] - p[0], r[1] - p[1], r[2] - p[2]
        n0, n1, n2 = e1 * f2 - e2 * f1, e2 * f0 - e0 * f2, e0 * f1 - e1 * f0
        m0, m1, m2 = p[0] + q[0] + r[0], p[1] + q[1] + r[1], p[2] + q[2] + r[2]
        dot = abs(n0 * m0 + n1 * m1 + n2 * m2)
        norms = math.sqrt((n0 * n0 + n1 * n1 + n2 * n2) * (m0 * m0 + m1 * m1 + m2 * m2))
        kept[t] = norms > 0.0 and dot >= min_cosine * norms
    return kept
