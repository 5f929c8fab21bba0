"""Depth of a true surface between pixels, where that is well defined, and who hides whom."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, BoolArray
from pliant.algorithms.camera import PinholeCamera

DISCONTINUITY = 0.005
"""Second difference of inverse depth, as a share of it, from which a pixel is on a jump.

Inverse depth is affine in the pixel on a plane, however steep, so its second difference is 0
there; a jump in depth of 1 % shows as 1 %.
"""
OCCLUSION = 0.01
"""A point is hidden when it lies farther behind the surface than this share of its depth."""


@dataclass(frozen=True, kw_only=True)
class DepthView:
    """One frame of ground truth.

    inverse_depth: (H, W), 1 / metres, 0 where there is no surface.
    broken: (H, W) pixels on a depth jump or beside one (within 1.5 px, so all 8 neighbours), or
        without surface.
    """

    camera: PinholeCamera
    T_world_camera: F64
    inverse_depth: F64
    broken: BoolArray

    @staticmethod
    def of(camera: PinholeCamera, T_world_camera: F64, depth_m: F64) -> "DepthView":
        """depth_m: (H, W), along the optical axis; 0 or not finite where nothing is known."""
        depth = np.asarray(depth_m, np.float64)
        known = np.isfinite(depth) & (depth > 0.0)
        w = np.where(known, 1.0 / np.where(known, depth, 1.0), 0.0)
        jump = ~known
        across = np.abs(w[:, :-2] - 2.0 * w[:, 1:-1] + w[:, 2:])
        along = np.abs(w[:-2] - 2.0 * w[1:-1] + w[2:])
        jump[:, 1:-1] |= across > DISCONTINUITY * w[:, 1:-1]
        jump[1:-1] |= along > DISCONTINUITY * w[1:-1]
        broken = jump.copy()
        broken[1:] |= jump[:-1]
        broken[:-1] |= jump[1:]
        rows = broken.copy()
        broken[:, 1:] |= rows[:, :-1]
        broken[:, :-1] |= rows[:, 1:]
        return DepthView(
            camera=camera, T_world_camera=T_world_camera, inverse_depth=w, broken=broken
        )

    def inside(self, points_px: F64) -> BoolArray:
        """(N,) whether pixels lie between four pixel centres of the image."""
        u, v = points_px[:, 0], points_px[:, 1]
        height, width = self.inverse_depth.shape
        return (u >= 0.0) & (v >= 0.0) & (u <= width - 1.0) & (v <= height - 1.0)

    def corners(self, points_px: F64) -> tuple[F64, F64, BoolArray]:
        """Inverse depth and brokenness of the four pixels about (N, 2) points inside the image.

        Returns inverse depths (N, 4), bilinear weights (N, 4), and (N,) any of the four broken.
        """
        height, width = self.inverse_depth.shape
        u0 = np.clip(np.floor(points_px[:, 0]).astype(np.int64), 0, width - 2)
        v0 = np.clip(np.floor(points_px[:, 1]).astype(np.int64), 0, height - 2)
        a, b = points_px[:, 0] - u0, points_px[:, 1] - v0
        v = v0[:, None] + np.array([0, 0, 1, 1])
        u = u0[:, None] + np.array([0, 1, 0, 1])
        weights = np.stack([(1 - a) * (1 - b), a * (1 - b), (1 - a) * b, a * b], axis=1)
        return self.inverse_depth[v, u], weights, np.any(self.broken[v, u], axis=1)

    def lift(self, points_px: F64) -> tuple[F64, BoolArray]:
        """World points (N, 3) of the surface seen at (N, 2) pixels, and where they are defined.

        Inverse depth is interpolated between the four pixels around, which is exact on planes;
        a point with a broken pixel among them, or outside the image, has no defined surface.
        """
        good = self.inside(points_px)
        safe = np.where(good[:, None], points_px, 0.0)
        corners, weights, broken = self.corners(safe)
        good &= ~broken
        inverse_depth = np.where(good, (corners * weights).sum(axis=1), 1.0)
        rays = np.concatenate([self.camera.normalise(safe), np.ones((len(safe), 1))], axis=1)
        T = self.T_world_camera
        return rays / inverse_depth[:, None] @ T[:3, :3].T + T[:3, 3], good

    def project(self, points_world: F64) -> tuple[F64, F64]:
        """(N, 2) pixels and (N,) depths of (N, 3) world points; NaN pixels behind the camera."""
        T = self.T_world_camera
        points = (points_world - T[:3, 3]) @ T[:3, :3]
        z = points[:, 2]
        front = z > 1e-9
        px = self.camera.project(np.where(front[:, None], points, 1.0))
        return np.where(front[:, None], px, np.nan), z

    def visible(self, points_px: F64, depths: F64) -> BoolArray:
        """(N,) whether projected points are in the image and not behind the surface.

        A point is hidden where it lies more than OCCLUSION behind the farthest of the four pixels
        around it: on the edge of what hides it, it still counts as visible.
        """
        inside = self.inside(points_px)
        corners, _, _ = self.corners(np.where(inside[:, None], points_px, 0.0))
        # No surface (0) is infinitely far: nothing hides a point there.
        return inside & (corners.min(axis=1) * depths <= 1.0 + OCCLUSION)
