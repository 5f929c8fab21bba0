"""What a camera sees of a triangle mesh: depth, and normals or colours between the corners."""

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, Shape
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.kernel import kernel

_NEAREST_SHARE = 1e-3
"""Triangles nearer than this share of the median depth are left out: there is no clipping."""


@dataclass(frozen=True)
class MeshView:
    """The nearest triangle at every pixel centre.

    depths: along z, 0 where there is none.    triangles: its row, -1 where there is none.
    shares: of its second and third corner at the place that is seen.
    """

    depths: Annotated[F32, Shape("H", "W")]
    triangles: Annotated[I32, Shape("H", "W")]
    shares: Annotated[F32, Shape("H", "W", 2)]

    def interpolate(self, faces: I32, values: F32) -> F32:
        """(H, W, C) of (V, C) values at the vertices, 0 where there is no triangle."""
        seen = self.triangles >= 0
        corners = values[faces[self.triangles[seen]]]
        b, c = self.shares[seen][:, 0:1], self.shares[seen][:, 1:2]
        result = np.zeros((*seen.shape, values.shape[1]), np.float32)
        result[seen] = corners[:, 0] * (1.0 - b - c) + corners[:, 1] * b + corners[:, 2] * c
        return result


def view_mesh(points: F32, faces: I32, camera: PinholeCamera, T_world_camera: F64) -> MeshView:
    """Render (V, 3) vertices and (F, 3) faces, from both sides."""
    shape = (camera.height, camera.width)
    nearest = np.zeros(shape)
    triangles = np.full(shape, -1, np.int32)
    shares = np.zeros((*shape, 2), np.float32)
    in_camera = (points - T_world_camera[:3, 3]) @ T_world_camera[:3, :3]
    front = in_camera[:, 2][in_camera[:, 2] > 0.0]
    if len(front):
        near = _NEAREST_SHARE * float(np.median(front))
        _draw(
            np.ascontiguousarray(in_camera), faces, near,
            camera.fx, camera.fy, camera.cx, camera.cy, nearest, triangles, shares,
        )  # fmt: skip
    depths = np.zeros(shape, np.float32)
    np.divide(1.0, nearest, out=depths, where=nearest > 0.0, casting="same_kind")
    return MeshView(depths, triangles, shares)


@kernel
def _draw(
    points: F64, faces: I32, near: float, fx: float, fy: float, cx: float, cy: float,
    nearest: F64, triangles: I32, shares: F32,
) -> None:  # fmt: skip
    height, width = nearest.shape
    for f in range(len(faces)):
        a, b, c = faces[f, 0], faces[f, 1], faces[f, 2]
        if min(points[a, 2], points[b, 2], points[c, 2]) < near:
            continue
        wa, wb, wc = 1.0 / points[a, 2], 1.0 / points[b, 2], 1.0 / points[c, 2]
        ua, va = points[a, 0] * wa * fx + cx, points[a, 1] * wa * fy + cy
        ub, vb = points[b, 0] * wb * fx + cx, points[b, 1] * wb * fy + cy
        uc, vc = points[c, 0] * wc * fx + cx, points[c, 1] * wc * fy + cy
        area = (ub - ua) * (vc - va) - (vb - va) * (uc - ua)
        if area == 0.0 or max(ua, ub, uc) < 0.0 or max(va, vb, vc) < 0.0:
            continue
        if min(ua, ub, uc) > width - 1 or min(va, vb, vc) > height - 1:
            continue
        left, right = math.ceil(max(min(ua, ub, uc), 0.0)), min(max(ua, ub, uc), width - 1.0)
        top, bottom = math.ceil(max(min(va, vb, vc), 0.0)), min(max(va, vb, vc), height - 1.0)
        for v in range(top, math.floor(bottom) + 1):
            for u in range(left, math.floor(right) + 1):
                # On an edge a pixel belongs to both: the first of two that are as near is taken.
                p = ((u - ua) * (vc - va) - (v - va) * (uc - ua)) / area
                q = ((ub - ua) * (v - va) - (vb - va) * (u - ua)) / area
                if p < 0.0 or q < 0.0 or p + q > 1.0:
                    continue
                w = wa + p * (wb - wa) + q * (wc - wa)
                if w > nearest[v, u]:
                    nearest[v, u] = w
                    triangles[v, u] = f
                    # Linear in the image are shares over depth.
                    shares[v, u, 0], shares[v, u, 1] = p * wb / w, q * wc / w
