"""Each pixel: the texture where its ray meets the scene, or the exact depth there."""

import math
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8
from pliant.compiler.kernel import fast_kernel, kernel
from pliant.rendering.colours import LEAST
from pliant.rendering.intersect import Scalar, face_point, load_tile, meet_tile
from pliant.rendering.solids import SolidArrays
from pliant.rendering.visible_tiles import TILE_PX, TILE_RAYS, Tiles, View


class Atlas(NamedTuple):
    """The textures of F faces: mip pyramids of L levels of 8 bit texels in one flat array."""

    texels: U8  # all levels of all faces, row by row
    offset: I64  # (F, L) where a level starts in ``texels``
    width: I32  # (F,) texels of a row at level 0, a multiple of 2**(L - 1)
    height: I32  # (F,) rows at level 0, likewise
    density: F64  # (F,) texels per metre


class ColourAtlas(NamedTuple):
    """The colours of F faces: shares of red and blue, as in ``colours``, in steps of 1 / SHARE."""

    red: Atlas
    blue: U8  # texels that lie as the red ones do


SHARE = 140.0
"""Steps of a share."""


@fast_kernel
def bilinear(
    texels: U8, offset: Scalar, width: Scalar, height: Scalar, x: Scalar, y: Scalar
) -> Scalar:
    """8 bit texels of one level of one face at (x, y), (0, 0) being the middle of the first."""
    x, y = min(max(x, 0.0), width - 1.001), min(max(y, 0.0), height - 1.001)
    col, row = int(x), int(y)
    p, q = x - col, y - row
    i = offset + row * width + col
    top = texels[i] * (1.0 - p) + texels[i + 1] * p
    bottom = texels[i + width] * (1.0 - p) + texels[i + width + 1] * p
    return top * (1.0 - q) + bottom * q


@fast_kernel
def accumulate(
    rays: F32,
    solids: SolidArrays,
    view: View,
    tiles: Tiles,
    atlas: Atlas,
    colours: ColourAtlas,
    pixel: float,
    weight: float,
    out: F32,
) -> None:
    """Add ``weight`` times the textured view to ``out``.

    rays: (H, W, 2) float32 on the plane z = 1.  pixel: size of a pixel on that plane.  out: (H, W,
    C) float32, changed in place: light, and where C is 3 light times the shares of red and blue.
    Rays that meet nothing add 0.
    """
    kind, half, first_face = solids.kind, solids.half, solids.first_face
    o, R = view.origin, view.rotation
    # Single precision finds the surface well enough (1 um) and twice as fast.
    half_32, o_32, R_32 = half.astype(np.float32), o.astype(np.float32), R.astype(np.float32)
    start, listed, bound = tiles.start, tiles.solids, tiles.nearest
    texels, offset, density = atlas.texels, atlas.offset, atlas.density
    texture_width, texture_height = atlas.width, atlas.height
    last_level, in_colour = offset.shape[1] - 1, out.shape[2] == 3
    red, blue = colours.red, colours.blue
    xs, ys = np.empty(TILE_RAYS, np.float32), np.empty(TILE_RAYS, np.float32)
    depths, seen = np.empty(TILE_RAYS, np.float32), np.empty(TILE_RAYS, np.int32)
    for tile in range(len(start) - 1):
        top, left, rows, cols = load_tile(rays, tile, xs, ys)
        meet_tile(kind, half_32, o_32, R_32, start, listed, bound, tile, xs, ys, depths, seen)
        for ray in range(rows * TILE_PX):
            row, col = ray // TILE_PX, ray % TILE_PX
            s = seen[ray]
            if s < 0 or col >= cols:
                continue
            row, col = row + top, col + left
            x, y, t = float(xs[ray]), float(ys[ray]), float(depths[ray])
            dx = R[s, 0, 0] * x + R[s, 0, 1] * y + R[s, 0, 2]
            dy = R[s, 1, 0] * x + R[s, 1, 1] * y + R[s, 1, 2]
            dz = R[s, 2, 0] * x + R[s, 2, 1] * y + R[s, 2, 2]
            px, py, pz = o[s, 0] + t * dx, o[s, 1] + t * dy, o[s, 2] + t * dz
            f, u, v, nx, ny, nz = face_point(
                kind[s], px, py, pz, half[s, 0], half[s, 1], half[s, 2]
            )
            face = first_face[s] + f
            a, b = u * density[face], v * density[face]
            # Between the short and the long side of the pixel's footprint on a slanted surface.
            length = math.sqrt(1.0 + x * x + y * y)
            slant = max(abs(nx * dx + ny * dy + nz * dz), 0.1 * length)
            footprint = density[face] * t * pixel * math.sqrt(length / slant)
            level = 0
            while footprint >= 2.0 and level < last_level - 1:
                footprint *= 0.5
                level += 1
            w, h = texture_width[face] >> level, texture_height[face] >> level
            a, b = a / (1 << level), b / (1 << level)
            value = bilinear(texels, offset[face, level], w, h, a - 0.5, b - 0.5)
            if footprint > 1.0:
                coarse = bilinear(
                    texels, offset[face, level + 1], w >> 1, h >> 1, 0.5 * a - 0.5, 0.5 * b - 0.5
                )
                value += min(footprint - 1.0, 1.0) * (coarse - value)
            out[row, col, 0] += weight * value
            if in_colour:
                # Where the light's texels are as fine, or finer than any.
                coarser = density[face] / red.density[face]
                while level > 0 and coarser >= 2.0:
                    level -= 1
                    coarser *= 0.5
                a, b = (u * red.density[face] / (1 << level), v * red.density[face] / (1 << level))
                w, h = red.width[face] >> level, red.height[face] >> level
                i = red.offset[face, level]
                share = bilinear(red.texels, i, w, h, a - 0.5, b - 0.5) / SHARE + LEAST
                out[row, col, 1] += weight * value * share
                share = bilinear(blue, i, w, h, a - 0.5, b - 0.5) / SHARE + LEAST
                out[row, col, 2] += weight * value * share


@kernel
def cast_depth(rays: F64, solids: SolidArrays, view: View, tiles: Tiles, depth: F64) -> None:
    """Exact depth for each ray.

    rays: (H, W, 2) float64.  Fills depth (H, W) float64, 0 where nothing is met.
    """
    start, listed, bound = tiles.start, tiles.solids, tiles.nearest
    xs, ys, depths = np.empty(TILE_RAYS), np.empty(TILE_RAYS), np.empty(TILE_RAYS)
    seen = np.empty(TILE_RAYS, np.int32)
    kind, half, o, R = solids.kind, solids.half, view.origin, view.rotation
    for tile in range(len(start) - 1):
        top, left, rows, cols = load_tile(rays, tile, xs, ys)
        meet_tile(kind, half, o, R, start, listed, bound, tile, xs, ys, depths, seen)
        for row in range(rows):
            for col in range(cols):
                t = depths[row * TILE_PX + col]
                depth[top + row, left + col] = t if t < np.inf else 0.0


@kernel
def cast(
    rays: F64,
    solids: SolidArrays,
    view: View,
    tiles: Tiles,
    depth: F64,
    faces: I32,
    normals: F64,
) -> None:
    """Exact depth, face number and normal for each ray.

    rays: (H, W, 2) float64.  Fills depth (H, W) float64, 0 where nothing is met, faces (H, W) int32
    (-1: nothing) and normals (H, W, 3) float64, in the world frame, towards the camera.
    """
    kind, half, first_face, W = solids.kind, solids.half, solids.first_face, solids.rotation
    o, R = view.origin, view.rotation
    start, listed, bound = tiles.start, tiles.solids, tiles.nearest
    xs, ys, depths = np.empty(TILE_RAYS), np.empty(TILE_RAYS), np.empty(TILE_RAYS)
    seen = np.empty(TILE_RAYS, np.int32)
    for tile in range(len(start) - 1):
        top, left, rows, cols = load_tile(rays, tile, xs, ys)
        meet_tile(kind, half, o, R, start, listed, bound, tile, xs, ys, depths, seen)
        for i in range(rows * cols):
            row, col = i // cols, i % cols
            ray = row * TILE_PX + col
            x, y, t, s = xs[ray], ys[ray], depths[ray], seen[ray]
            row, col = row + top, col + left
            depth[row, col], faces[row, col] = 0.0, -1
            normals[row, col, :] = 0.0
            if s < 0:
                continue
            px = o[s, 0] + t * (R[s, 0, 0] * x + R[s, 0, 1] * y + R[s, 0, 2])
            py = o[s, 1] + t * (R[s, 1, 0] * x + R[s, 1, 1] * y + R[s, 1, 2])
            pz = o[s, 2] + t * (R[s, 2, 0] * x + R[s, 2, 1] * y + R[s, 2, 2])
            f, _, _, nx, ny, nz = face_point(
                kind[s], px, py, pz, half[s, 0], half[s, 1], half[s, 2]
            )
            depth[row, col], faces[row, col] = t, first_face[s] + f
            for i in range(3):
                normals[row, col, i] = W[s, i, 0] * nx + W[s, i, 1] * ny + W[s, i, 2] * nz
