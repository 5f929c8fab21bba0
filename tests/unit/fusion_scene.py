"""Views of a floor, walls and a ball, whose depth is known, and measures of what is fused."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh

CAMERA = PinholeCamera(width=128, height=96, fx=105.0, fy=105.0, cx=63.5, cy=47.5)
# normal n towards the cameras and d: n . X = d on the plane.
PLANES = np.array(
    [[0.0, -1.0, 0.0, -1.2], [0.0, 0.0, -1.0, -4.0], [1.0, 0.0, 0.0, -2.2], [-0.8, 0.0, -0.6, -3.6]]
)
BALL, RADIUS = np.array([0.3, 0.4, 2.6]), 0.6


@dataclass(frozen=True)
class View:
    """What ``integrate`` takes."""

    depth: F32
    weight: F32
    colour: U8
    camera: PinholeCamera
    T_world_camera: F64

    def arguments(self) -> tuple[F32, F32, U8, PinholeCamera, F64]:
        return self.depth, self.weight, self.colour, self.camera, self.T_world_camera


def pose(step: int) -> F64:
    angle = 0.05 * step
    c, s = np.cos(angle), np.sin(angle)
    T = np.eye(4)
    T[:3, :3] = [[c, 0, s], [0, 1, 0], [-s, 0, c]]
    T[:3, 3] = [0.08 * step, 0.02 * step, -0.05 * step]
    return T


def rays(camera: PinholeCamera) -> F64:
    u, v = np.meshgrid(np.arange(float(camera.width)), np.arange(float(camera.height)))
    return np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], axis=-1
    )


def true_depth(T: F64, camera: PinholeCamera = CAMERA, *, ball: bool = True) -> F32:
    """(H, W) depth along z of the nearest surface."""
    directions, origin = rays(camera) @ T[:3, :3].T, T[:3, 3]
    depth = np.full(directions.shape[:2], np.inf)
    for plane in PLANES:
        with np.errstate(divide="ignore"):
            z = (plane[3] - plane[:3] @ origin) / (directions @ plane[:3])
        depth = np.where(z > 0.0, np.minimum(depth, z), depth)
    if ball:
        offset = origin - BALL
        a, b = np.sum(directions**2, axis=-1), directions @ offset
        root = b * b - a * (offset @ offset - RADIUS**2)
        z = (-b - np.sqrt(np.maximum(root, 0.0))) / a
        depth = np.where((root > 0.0) & (z > 0.0), np.minimum(depth, z), depth)
    return np.where(np.isfinite(depth), depth, 0.0).astype(np.float32)


def make_view(step: int, camera: PinholeCamera = CAMERA, *, ball: bool = True) -> View:
    depth = true_depth(pose(step), camera, ball=ball)
    generator = np.random.default_rng(step)
    weight = generator.uniform(0.2, 1.0, depth.shape).astype(np.float32)
    colour = generator.integers(0, 256, (*depth.shape, 3), dtype=np.uint8)
    return View(depth, weight, colour, camera, pose(step))


def surface_errors(mesh: TriangleMesh) -> tuple[F64, F64]:
    """(V,) distance of each vertex from the nearest surface; angle of its normal, degrees."""
    points = mesh.positions.astype(np.float64)
    from_centre = points - BALL
    radius = np.linalg.norm(from_centre, axis=1)
    off = np.abs(points @ PLANES[:, :3].T - PLANES[:, 3])
    off = np.column_stack([off, np.abs(radius - RADIUS)])
    which = off.argmin(axis=1)
    true = np.vstack([PLANES[:, :3], np.zeros(3)])[which]
    true[which == len(PLANES)] = (from_centre / radius[:, None])[which == len(PLANES)]
    cosine = np.clip(np.sum(true * mesh.normals, axis=1), -1.0, 1.0)
    return off.min(axis=1), np.degrees(np.arccos(cosine))


def edge_uses(triangles: I32) -> F64:
    """(E,) of how many triangles each edge is a side: 1 at a border, 2 within a manifold."""
    sides = np.concatenate([triangles[:, [0, 1]], triangles[:, [1, 2]], triangles[:, [2, 0]]])
    sides = np.sort(sides.astype(np.int64), axis=1)
    return np.unique(sides[:, 0] << 32 | sides[:, 1], return_counts=True)[1]
