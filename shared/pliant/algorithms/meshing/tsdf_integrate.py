"""A truncated signed distance in every voxel, as whole-number sums that can be taken back exactly.

Curless and Levoy 1996: distance and colour are weighted means over the sights of a voxel.  A voxel
holds the sums, in int32: of w d, w, and of w r, w g, w b, w over the sights within the truncation,
with w in WEIGHT_UNITS and d in DISTANCE_UNITS of the truncation.  Whole numbers add in any order to
the same sum, and what was added can be taken away without a trace.  The sum holds
2**31 / (WEIGHT_UNITS * DISTANCE_UNITS) = 32 768 sights of full weight.

A depth map is taken as small planes, one for every pixel.  In a plane n . X = d the inverse depth
along z is affine in the image, n . ray / d.  So its slope between neighbouring pixels gives the
plane, and with it the distance of any voxel near the ray: at right angles to the surface, and
without the steps that the nearest pixel's depth has on slants.
"""

import math
from typing import Annotated, NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray, Shape
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import KEY_LIMIT, SIDE, unpack
from pliant.algorithms.meshing.tsdf_blocks import (
    EMPTY,
    Scale,
    VoxelSums,
    grown,
    pack_one,
    slot_of,
    used_keys,
)
from pliant.compiler.kernel import fast_kernel, kernel

WEIGHT_UNITS = 128
"""A weight of 1."""
DISTANCE_UNITS = 512
"""Of one truncation."""
TILE_PX = 16
_MIN_COSINE = 0.1
"""A surface more slanted than this is a step: it is taken at right angles to the view."""
_MAX_BEHIND = 2.0
"""Truncations behind the surface along z beyond which a grazed plane has no effect."""
_NEAR = 1e-3
_MAX_STRIDE_PX = 8
_RAYS_PER_BLOCK = 6
"""Rays side by side that meet the most distant block, so that none is missed."""
_MAX_STRETCH = 2.0
"""The band along a ray is the truncation over the cosine of the slant, up to this many times."""


class PixelPlanes(NamedTuple):
    """planes: unit normal (camera frame, away from the camera) and offset: n . X = offset.

    depths: along z, 0 where there is nothing.    weights: of WEIGHT_UNITS, 0 likewise.
    furthest: the largest depth in each tile of TILE_PX pixels.    intrinsics: fx, fy, cx, cy.
    """

    planes: Annotated[F32, Shape("H", "W", 4)]
    depths: Annotated[F32, Shape("H", "W")]
    weights: Annotated[U8, Shape("H", "W")]
    furthest: Annotated[F32, Shape("A", "B")]
    intrinsics: Annotated[F64, Shape(4)]


def pixel_planes(depth: F32, weight: F32, camera: PinholeCamera) -> PixelPlanes:
    """depth: (H, W) along z, 0 or not finite where there is none.    weight: (H, W) in [0, 1].

    Raises ValueError if they are not of the camera's size.
    """
    shape = (camera.height, camera.width)
    if depth.shape != shape or weight.shape != shape:
        raise ValueError(f"depth and weight: expected {shape}, got {depth.shape}, {weight.shape}")
    inverse = np.zeros((camera.height + 2, camera.width + 2), np.float32)  # nothing around it
    weights = np.empty(shape, np.uint8)
    _invert(depth, weight, inverse, weights)
    planes, depths = np.empty((*shape, 4), np.float32), np.empty(shape, np.float32)
    furthest = np.zeros((-(-camera.height // TILE_PX), -(-camera.width // TILE_PX)), np.float32)
    x = ((np.arange(camera.width) - camera.cx) / camera.fx).astype(np.float32)
    y = ((np.arange(camera.height) - camera.cy) / camera.fy).astype(np.float32)
    _fit(inverse, x, y, (np.float32(camera.fx), np.float32(camera.fy)), planes, depths, furthest)
    intrinsics = camera.intrinsics
    return PixelPlanes(planes, depths, weights, furthest, intrinsics)


def blocks_in_band(pixels: PixelPlanes, T_world_camera: F64, scale: Scale) -> I32:
    """(K, 3) keys of the blocks within the truncation of the surface that a depth map shows.

    As many pixels are looked at as it takes to meet the most distant block _RAYS_PER_BLOCK times.
    """
    furthest = max(float(pixels.depths.max(initial=0.0)), 1e-9)
    across = SIDE * scale.voxel * float(pixels.intrinsics[:2].min()) / furthest
    stride = int(np.clip(across / _RAYS_PER_BLOCK, 1, _MAX_STRIDE_PX))
    return unpack(np.sort(_band(pixels, T_world_camera, scale, stride)))


@fast_kernel
def _invert(depth: F32, weight: F32, inverse: F32, weights: U8) -> None:
    """Inverse depths in the middle of (H + 2, W + 2), and weights in their units; 0 where there is
    none."""
    zero, one, half = np.float32(0.0), np.float32(1.0), np.float32(0.5)
    units, most = np.float32(WEIGHT_UNITS), np.float32(np.inf)
    for v in range(depth.shape[0]):
        to = inverse[v + 1]
        for u in range(depth.shape[1]):
            z, w = depth[v, u], weight[v, u]
            usable = z > zero and z < most and w > zero
            to[u + 1] = one / z if usable else zero
            share = max(min(w, one) * units + half, one)
            weights[v, u] = np.uint8(share if usable else zero)


@fast_kernel
def _fit(
    inverse: F32, x: F32, y: F32, focal: tuple[np.float32, np.float32], planes: F32, depths: F32,
    furthest: F32,
) -> None:  # fmt: skip
    """Planes, depths and the largest of each tile, all 0 where the inverse depth is.

    inverse: (H + 2, W + 2), 0 where there is none, and around it.   x: (W,), y: (H,) of the pixels
    on the plane z = 1.   The first loop over a row has no branch, so that it is SIMD code.
    """
    fx, fy = focal
    zero, one, least = np.float32(0.0), np.float32(1.0), np.float32(_MIN_COSINE)
    height, width = depths.shape
    found, column = np.empty((4, width), np.float32), np.zeros(width, np.float32)
    for v in range(height):
        above, row, below = inverse[v], inverse[v + 1], inverse[v + 2]
        a, b, c, d, z, y_v = found[0], found[1], found[2], found[3], depths[v], y[v]
        for u in range(width):
            here, x_u = row[u + 1], x[u]
            nx = fx * _slope(row[u], here, row[u + 2])
            ny = fy * _slope(above[u + 1], here, below[u + 1])
            nz = here - nx * x_u - ny * y_v
            squared = x_u * x_u + y_v * y_v + one
            norm = nx * nx + ny * ny + nz * nz
            across = here / squared
            step = here * across < least * least * norm
            nx, ny = across * x_u if step else nx, across * y_v if step else ny
            nz, norm = across if step else nz, across * here if step else norm
            d[u] = one / np.sqrt(norm) if here > zero else zero
            a[u], b[u], c[u] = nx * d[u], ny * d[u], nz * d[u]
            z[u] = one / here if here > zero else zero
            column[u] = max(column[u], z[u])
        for u in range(width):
            planes[v, u, 0], planes[v, u, 1] = a[u], b[u]
            planes[v, u, 2], planes[v, u, 3] = c[u], d[u]
        if v % TILE_PX == TILE_PX - 1 or v == height - 1:
            largest = furthest[v // TILE_PX]
            for u in range(width):
                largest[u // TILE_PX] = max(largest[u // TILE_PX], column[u])
            column[:] = zero


@fast_kernel
def _slope(before: np.float32, here: np.float32, behind: np.float32) -> np.float32:
    """The smaller of the slopes to both sides: the other one may cross a step.  0: no neighbour."""
    zero = np.float32(0.0)
    first = here - before if before > zero else zero
    second = behind - here if behind > zero else zero
    other = behind > zero and (not before > zero or not abs(first) < abs(second))
    return second if other else first


@kernel
def _band(pixels: PixelPlanes, T: F64, scale: Scale, stride: int) -> I64:
    planes, depth, intrinsics = pixels.planes, pixels.depths, pixels.intrinsics
    height, width = depth.shape
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
    block, truncation = SIDE * scale.voxel, scale.truncation
    packed = np.full(1024, EMPTY, np.int64)
    count = 0
    last = np.int64(EMPTY)
    for v in range(0, height, stride):
        for u in range(0, width, stride):
            z = depth[v, u]
            if not z > 0.0:
                continue
            x, y = (u - cx) / fx, (v - cy) / fy
            length = math.sqrt(x * x + y * y + 1.0)
            stretch = min(z / (planes[v, u, 3] * length), _MAX_STRETCH)
            reach = truncation * stretch / length
            steps = math.ceil(4.0 * truncation * stretch / block) + 1
            rx = T[0, 0] * x + T[0, 1] * y + T[0, 2]
            ry = T[1, 0] * x + T[1, 1] * y + T[1, 2]
            rz = T[2, 0] * x + T[2, 1] * y + T[2, 2]
            for s in range(steps):
                at_z = max(z - reach + 2.0 * reach * s / (steps - 1), 0.0)
                bx = math.floor((T[0, 3] + rx * at_z) / block + 0.5 / SIDE)
                by = math.floor((T[1, 3] + ry * at_z) / block + 0.5 / SIDE)
                bz = math.floor((T[2, 3] + rz * at_z) / block + 0.5 / SIDE)
                if not max(abs(bx), abs(by), abs(bz)) < KEY_LIMIT - 1:
                    continue
                key = pack_one(int(bx), int(by), int(bz))
                if key == last:
                    continue
                last = key
                at = slot_of(packed, key)
                if packed[at] == EMPTY:
                    packed[at] = key
                    count += 1
                    if 2 * count > len(packed):
                        packed = grown(packed)
    return used_keys(packed, count)


@kernel
def blocks_in_view(
    keys: I32, pixels: PixelPlanes, T_camera_world: F64, scale: Scale
) -> BoolArray:  # fmt: skip
    """(N,) which of the (N, 3) blocks may have voxels in view and not wholly behind the surface."""
    seen = np.zeros(len(keys), np.bool_)
    K, furthest, (height, width) = pixels.intrinsics, pixels.furthest, pixels.depths.shape
    fx, fy, cx, cy = K[0], K[1], K[2], K[3]
    voxel, truncation = scale.voxel, scale.truncation
    T = T_camera_world
    half = 0.5 * (SIDE - 1) * voxel
    radius = 1.7321 * half
    for i in range(len(keys)):
        x = keys[i, 0] * SIDE * voxel + half
        y = keys[i, 1] * SIDE * voxel + half
        z = keys[i, 2] * SIDE * voxel + half
        c = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if c + radius <= _NEAR:
            continue
        a = T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]
        b = T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]
        left, right, top, bottom = 0.0, width - 1.0, 0.0, height - 1.0
        near, far = c - radius, c + radius
        if near > _NEAR:
            left = max(left, cx + fx * min((a - radius) / near, (a - radius) / far) - 1.0)
            right = min(right, cx + fx * max((a + radius) / near, (a + radius) / far) + 1.0)
            top = max(top, cy + fy * min((b - radius) / near, (b - radius) / far) - 1.0)
            bottom = min(bottom, cy + fy * max((b + radius) / near, (b + radius) / far) + 1.0)
        if left > right or top > bottom:
            continue
        deepest = 0.0
        for tile_v in range(int(top) // TILE_PX, int(bottom) // TILE_PX + 1):
            for tile_u in range(int(left) // TILE_PX, int(right) // TILE_PX + 1):
                deepest = max(deepest, furthest[tile_v, tile_u])
        seen[i] = deepest > 0.0 and near < deepest + _MAX_BEHIND * truncation
    return seen


@fast_kernel
def add_sight(
    sign: int, keys: I32, rows: I64, pixels: PixelPlanes, colours: U8, T_camera_world: F64,
    scale: Scale, free_space: bool, sums: VoxelSums,
) -> BoolArray:  # fmt: skip
    """Add (sign 1) or take away (sign -1) one sight in the blocks given; which of them it changed.

    keys, rows: (N, 3), (N,) blocks and where they stand in the sums.    colours: (H, W, 3).
    """
    changed = np.zeros(len(keys), np.bool_)
    planes, weights, intrinsics = pixels.planes, pixels.weights, pixels.intrinsics
    distance_sums, weight_sums, colour_sums = sums
    voxel, truncation = scale.voxel, scale.truncation
    height, width = weights.shape
    T = T_camera_world.astype(np.float32)
    fx, fy = np.float32(intrinsics[0]), np.float32(intrinsics[1])
    cx, cy = np.float32(intrinsics[2] + 0.5), np.float32(intrinsics[3] + 0.5)
    units = np.float32(DISTANCE_UNITS / truncation)
    band = np.float32(truncation)
    for i in range(len(keys)):
        row = rows[i]
        # In double precision once: float32 would lose what is far from the origin.
        ox, oy, oz = keys[i, 0] * SIDE * voxel, keys[i, 1] * SIDE * voxel, keys[i, 2] * SIDE * voxel
        W = T_camera_world
        a0 = np.float32(W[0, 0] * ox + W[0, 1] * oy + W[0, 2] * oz + W[0, 3])
        b0 = np.float32(W[1, 0] * ox + W[1, 1] * oy + W[1, 2] * oz + W[1, 3])
        c0 = np.float32(W[2, 0] * ox + W[2, 1] * oy + W[2, 2] * oz + W[2, 3])
        touched = False
        for z in range(SIDE):
            for y in range(SIDE):
                dy, dz = np.float32(y * voxel), np.float32(z * voxel)
                a1 = a0 + T[0, 1] * dy + T[0, 2] * dz
                b1 = b0 + T[1, 1] * dy + T[1, 2] * dz
                c1 = c0 + T[2, 1] * dy + T[2, 2] * dz
                for x in range(SIDE):
                    dx = np.float32(x * voxel)
                    c = c1 + T[2, 0] * dx
                    if not c > np.float32(_NEAR):
                        continue
                    a, b = a1 + T[0, 0] * dx, b1 + T[1, 0] * dx
                    pu, pv = fx * a / c + cx, fy * b / c + cy
                    if not (pu >= 0.0 and pv >= 0.0 and pu < width and pv < height):
                        continue
                    u, v = int(pu), int(pv)
                    w = np.int32(weights[v, u])
                    if w == 0:
                        continue
                    along = planes[v, u, 0] * a + planes[v, u, 1] * b + planes[v, u, 2] * c
                    distance = planes[v, u, 3] - along
                    if distance < -band:
                        continue
                    # How far behind the surface along z; the plane passes the voxel's own ray.
                    if not along > 0.0 or -c * distance > _MAX_BEHIND * band * along:
                        continue
                    w *= np.int32(sign)
                    if distance >= band:
                        if not free_space:
                            continue
                        distance_sums[row, z, y, x] += w * np.int32(DISTANCE_UNITS)
                    else:
                        level = np.int32(np.floor(distance * units + np.float32(0.5)))
                        distance_sums[row, z, y, x] += w * level
                        for k in range(3):
                            colour_sums[row, z, y, x, k] += w * np.int32(colours[v, u, k])
                        colour_sums[row, z, y, x, 3] += w
                    weight_sums[row, z, y, x] += w
                    touched = True
        changed[i] = touched
    return changed
