"""A depth map as small planes, one for every pixel, with whole-number weights.

In a plane n . X = d the inverse depth along z is affine in the image, n . ray / d.  So its slope
between neighbouring pixels gives the plane, and with it the distance of any voxel near the ray: at
right angles to the surface, and without the steps that the nearest pixel's depth has on slants.
"""

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8, Shape
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.kernel import fast_kernel

WEIGHT_UNITS = 128
"""A weight of 1."""
TILE_PX = 16
_MIN_COSINE = 0.1
"""A surface more slanted than this is a step: it is taken at right angles to the view."""


@dataclass(frozen=True)
class PixelPlanes:
    """planes: unit normal (camera frame, away from the camera) and offset: n . X = offset.

    depths: along z, 0 where there is nothing.    weights: of WEIGHT_UNITS, 0 likewise.
    furthest: the largest depth in each tile of TILE_PX pixels.
    """

    planes: Annotated[F32, Shape("H", "W", 4)]
    depths: Annotated[F32, Shape("H", "W")]
    weights: Annotated[U8, Shape("H", "W")]
    furthest: Annotated[F32, Shape("A", "B")]


def intrinsics_of(camera: PinholeCamera) -> F64:
    """(4,) fx, fy, cx, cy."""
    return np.array([camera.fx, camera.fy, camera.cx, camera.cy])


def pixel_planes(depth: F32, weight: F32, camera: PinholeCamera) -> PixelPlanes:
    """depth: (H, W) along z, 0 or not finite where there is none.    weight: (H, W) in [0, 1].

    Raises ValueError where they are not of the camera's size.
    """
    shape = (camera.height, camera.width)
    if depth.shape != shape or weight.shape != shape:
        raise ValueError(f"depth and weight: expected {shape}, got {depth.shape}, {weight.shape}")
    planes, depths = np.zeros((*shape, 4), np.float32), np.zeros(shape, np.float32)
    weights = np.zeros(shape, np.uint8)
    tiles = (-(-camera.height // TILE_PX), -(-camera.width // TILE_PX))
    furthest = np.zeros(tiles, np.float32)
    inverse = np.zeros(shape, np.float32)
    usable = np.isfinite(depth) & (depth > 0.0) & (weight > 0.0)
    np.divide(np.float32(1.0), depth, out=inverse, where=usable)
    _fit(
        inverse, weight.astype(np.float32), camera.fx, camera.fy, camera.cx, camera.cy,
        planes, depths, weights, furthest,
    )  # fmt: skip
    return PixelPlanes(planes, depths, weights, furthest)


@fast_kernel
def _fit(
    inverse: F32, weight: F32, fx: float, fy: float, cx: float, cy: float,
    planes: F32, depths: F32, weights: U8, furthest: F32,
) -> None:  # fmt: skip
    height, width = inverse.shape
    for v in range(height):
        for u in range(width):
            here = inverse[v, u]
            if not here > 0.0:
                continue
            before = inverse[v, u - 1] if u > 0 else np.float32(0.0)
            behind = inverse[v, u + 1] if u + 1 < width else np.float32(0.0)
            above = inverse[v - 1, u] if v > 0 else np.float32(0.0)
            below = inverse[v + 1, u] if v + 1 < height else np.float32(0.0)
            nx, ny = fx * _slope(before, here, behind), fy * _slope(above, here, below)
            x, y = (u - cx) / fx, (v - cy) / fy
            nz = here - nx * x - ny * y
            norm = np.sqrt(nx * nx + ny * ny + nz * nz)
            length = np.sqrt(x * x + y * y + 1.0)
            if here < _MIN_COSINE * norm * length:
                nx, ny, nz = here * x / length**2, here * y / length**2, here / length**2
                norm = here / length
            planes[v, u, 0], planes[v, u, 1], planes[v, u, 2] = nx / norm, ny / norm, nz / norm
            planes[v, u, 3] = 1.0 / norm
            depths[v, u] = 1.0 / here
            share = min(weight[v, u], np.float32(1.0)) * WEIGHT_UNITS
            weights[v, u] = max(int(share + 0.5), 1)
            tile_v, tile_u = v // TILE_PX, u // TILE_PX
            furthest[tile_v, tile_u] = max(furthest[tile_v, tile_u], depths[v, u])


@fast_kernel
def _slope(before: np.float32, here: np.float32, behind: np.float32) -> np.float32:
    """The smaller of the slopes to both sides: the other one may cross a step.  0: no neighbour."""
    first, second = here - before, behind - here
    if not before > 0.0:
        return second if behind > 0.0 else np.float32(0.0)
    if not behind > 0.0:
        return first
    return first if abs(first) < abs(second) else second
