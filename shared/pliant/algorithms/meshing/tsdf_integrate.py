"""A truncated signed distance in every voxel, as whole-number sums that can be taken back exactly.

Curless and Levoy 1996: distance and colour are weighted means over the sights of a voxel.  A voxel
holds the sums, in int32: of w d, w, and of w r, w g, w b, w over the sights within the truncation,
with w in WEIGHT_UNITS and d in DISTANCE_UNITS of the truncation.  Whole numbers add in any order to
the same sum, and what was added can be taken away without a trace.  The sum holds
2**31 / (WEIGHT_UNITS * DISTANCE_UNITS) = 32 768 sights of full weight.
"""

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8, BoolArray
from pliant.algorithms.kernel import fast_kernel, kernel
from pliant.algorithms.meshing.tsdf_blocks import SIDE
from pliant.algorithms.meshing.tsdf_pixels import TILE_PX

DISTANCE_UNITS = 512
"""Of one truncation."""
_MAX_BEHIND = 2.0
"""Truncations behind the surface along z beyond which a grazed plane says nothing."""
_NEAR = 1e-3


@kernel
def blocks_in_view(
    keys: I32, T_camera_world: F64, intrinsics: F64, furthest: F32, width: int, height: int,
    voxel: float, truncation: float,
) -> BoolArray:  # fmt: skip
    """(N,) which blocks may have voxels in view and not wholly behind the surface."""
    seen = np.zeros(len(keys), np.bool_)
    fx, fy, cx, cy = intrinsics[0], intrinsics[1], intrinsics[2], intrinsics[3]
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
    keys: I32, slots: I32, T_camera_world: F64, intrinsics: F64, planes: F32, weights: U8,
    colours: U8, voxel: float, truncation: float, free_space: bool, sign: int,
    distance_sums: I32, weight_sums: I32, colour_sums: I32,
) -> BoolArray:  # fmt: skip
    """Add (sign 1) or take away (sign -1) one sight in the blocks given; which of them it changed.

    keys, slots: (N, 3), (N,) blocks and where they stand in the sums.    planes, weights: see
    PixelPlanes.    colours: (H, W, 3).    distance_sums, weight_sums: (S, 8, 8, 8) indexed
    (slot, z, y, x).    colour_sums: (S, 8, 8, 8, 4) red, green, blue, weight.
    """
    changed = np.zeros(len(keys), np.bool_)
    height, width = weights.shape
    T = T_camera_world.astype(np.float32)
    fx, fy = np.float32(intrinsics[0]), np.float32(intrinsics[1])
    cx, cy = np.float32(intrinsics[2] + 0.5), np.float32(intrinsics[3] + 0.5)
    units = np.float32(DISTANCE_UNITS / truncation)
    band = np.float32(truncation)
    for i in range(len(keys)):
        slot = slots[i]
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
                        distance_sums[slot, z, y, x] += w * np.int32(DISTANCE_UNITS)
                    else:
                        level = np.int32(np.floor(distance * units + np.float32(0.5)))
                        distance_sums[slot, z, y, x] += w * level
                        for k in range(3):
                            colour_sums[slot, z, y, x, k] += w * np.int32(colours[v, u, k])
                        colour_sums[slot, z, y, x, 3] += w
                    weight_sums[slot, z, y, x] += w
                    touched = True
        changed[i] = touched
    return changed
