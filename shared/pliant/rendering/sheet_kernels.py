"""Pixels of a scene of sheets: triangles into a depth buffer, then their texture."""

import math
from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32
from pliant.compiler.kernel import fast_kernel, kernel
from pliant.rendering.intersect import Scalar
from pliant.rendering.raycast import Atlas, bilinear

NEAR_M = 0.02
_INSIDE = -1e-9  # neighbours share an edge: rounding must leave no gap between them
_NO_AREA = 1e-12  # px^2
_SHININESS = 300.0


class Surface(NamedTuple):
    """How one sheet looks, at its (R, C) vertices.

    number: of the sheet.  light: (R, C) factors.  normals: (R, C, 3), camera frame.
    scale_u, scale_v: metres of texture for a column and a row.
    """

    number: int
    light: F32
    normals: F32
    scale_u: float
    scale_v: float


class Gloss(NamedTuple):
    """The highlight of a lamp on a sheet.  toward: (3,) the lamp, camera frame."""

    toward: F32
    strength: float


@fast_kernel
def _meet(
    a: F64, b: F64, c: F64, inverse: Scalar, x: Scalar, y: Scalar
) -> tuple[Scalar, Scalar, Scalar]:
    """1 / z of a triangle at a pixel and the shares of b and c there; (0, 0, 0) beside it.

    a, b, c: (3,) u, v, 1 / z.    inverse: of twice its area.
    """
    x, y = x - a[0], y - a[1]
    q = (x * (c[1] - a[1]) - y * (c[0] - a[0])) * inverse
    r = ((b[0] - a[0]) * y - (b[1] - a[1]) * x) * inverse
    p = 1.0 - q - r
    if p < _INSIDE or q < _INSIDE or r < _INSIDE:
        return 0.0, 0.0, 0.0
    # 1 / z is linear in the image, and so is what is divided by z.
    w = p * a[2] + q * b[2] + r * c[2]
    return w, q * b[2] / w, r * c[2] / w


@fast_kernel
def _area(a: F64, b: F64, c: F64) -> Scalar:
    """Twice the area in the image; 0 where a corner is behind the camera."""
    if a[2] <= 0.0 or b[2] <= 0.0 or c[2] <= 0.0:
        return 0.0
    area = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    return area if abs(area) > _NO_AREA else 0.0


@kernel
def _half_cell(number: int, columns: int) -> tuple[int, int, int, int]:
    """Row and column of its first corner, and the steps to the second; the third is across.

    Upper: (0, 0), (1, 0), (1, 1) in steps of (column, row).  Lower: (0, 0), (0, 1), (1, 1).
    """
    i, j, half = number // 2 // (columns - 1), number // 2 % (columns - 1), number % 2
    return i, j, 1 - half, half


@kernel
def rasterise(
    points: F64, number: int, offset_u: float, offset_v: float, nearness: F64, seen: I32, where: F32
) -> None:
    """Draw a sheet into the buffers where it is nearer than what they hold.

    points: (R, C, 3) u, v (pixels) and 1 / z of its vertices; 0: behind the camera, not drawn.
    Pixels are looked at (offset_u, offset_v) from their centres.  Changed in place: nearness (H, W)
    1 / z, seen (H, W) number of the sheet, where (H, W, 2) its column and row.
    """
    height, width = nearness.shape
    rows, columns = points.shape[:2]
    for cell in range((rows - 1) * (columns - 1) * 2):
        i, j, right, down = _half_cell(cell, columns)
        a, b, c = points[i, j], points[i + down, j + right], points[i + 1, j + 1]
        area = _area(a, b, c)
        if area == 0.0:
            continue
        left = max(math.ceil(min(a[0], b[0], c[0]) - offset_u), 0)
        last = min(math.floor(max(a[0], b[0], c[0]) - offset_u), width - 1)
        top = max(math.ceil(min(a[1], b[1], c[1]) - offset_v), 0)
        bottom = min(math.floor(max(a[1], b[1], c[1]) - offset_v), height - 1)
        for row in range(top, bottom + 1):
            for column in range(left, last + 1):
                w, q, r = _meet(a, b, c, 1.0 / area, column + offset_u, row + offset_v)
                if w > nearness[row, column]:
                    nearness[row, column], seen[row, column] = w, number
                    where[row, column, 0] = j + q * right + r
                    where[row, column, 1] = i + q * down + r


@kernel
def pick(points: F64, number: int, pixels: F64, nearness: F64, seen: I32, where: F64) -> None:
    """As ``rasterise``, at any (N, 2) pixels: nearness (N,), seen (N,), where (N, 2)."""
    rows, columns = points.shape[:2]
    for cell in range((rows - 1) * (columns - 1) * 2):
        i, j, right, down = _half_cell(cell, columns)
        a, b, c = points[i, j], points[i + down, j + right], points[i + 1, j + 1]
        area = _area(a, b, c)
        if area == 0.0:
            continue
        left, last = min(a[0], b[0], c[0]), max(a[0], b[0], c[0])
        for n in range(len(pixels)):
            if not left <= pixels[n, 0] <= last:
                continue
            w, q, r = _meet(a, b, c, 1.0 / area, pixels[n, 0], pixels[n, 1])
            if w > nearness[n]:
                nearness[n], seen[n] = w, number
                where[n, 0], where[n, 1] = j + q * right + r, i + q * down + r


@fast_kernel
def shade(
    depth: F64, seen: I32, where: F32, rays: F32, surface: Surface, atlas: Atlas, pixel: float,
    shine: Gloss, weight: float, out: F32,
) -> None:  # fmt: skip
    """Add ``weight`` times the light of the pixels that show a sheet to ``out`` (H, W).

    depth, seen, where: see ``Sight``.  rays: (H, W, 2) on the plane z = 1.  pixel: its size there.
    """
    sheet, light, normals, scale_u, scale_v = surface
    toward, gloss = shine
    height, width = seen.shape
    rows, columns = light.shape
    density, last_level = atlas.density[sheet], atlas.offset.shape[1] - 1
    for row in range(height):
        for column in range(width):
            if seen[row, column] != sheet:
                continue
            s, t = where[row, column, 0], where[row, column, 1]
            j, i = min(max(int(s), 0), columns - 2), min(max(int(t), 0), rows - 2)
            a, b = s - j, t - i
            w00, w01, w10, w11 = (1 - b) * (1 - a), (1 - b) * a, b * (1 - a), b * a
            nx = ny = nz = 0.0
            nx = w00 * normals[i, j, 0] + w01 * normals[i, j + 1, 0]
            nx += w10 * normals[i + 1, j, 0] + w11 * normals[i + 1, j + 1, 0]
            ny = w00 * normals[i, j, 1] + w01 * normals[i, j + 1, 1]
            ny += w10 * normals[i + 1, j, 1] + w11 * normals[i + 1, j + 1, 1]
            nz = w00 * normals[i, j, 2] + w01 * normals[i, j + 1, 2]
            nz += w10 * normals[i + 1, j, 2] + w11 * normals[i + 1, j + 1, 2]
            x, y, z = rays[row, column, 0], rays[row, column, 1], depth[row, column]
            length = math.sqrt(1.0 + x * x + y * y)
            norm = math.sqrt(nx * nx + ny * ny + nz * nz) + 1e-9
            facing = (nx * x + ny * y + nz) / norm
            slant = max(abs(facing), 0.1 * length)
            footprint = density * z * pixel * math.sqrt(length / slant)
            level = 0
            while footprint >= 2.0 and level < last_level - 1:
                footprint *= 0.5
                level += 1
            w, h = atlas.width[sheet] >> level, atlas.height[sheet] >> level
            p, q = s * scale_u * density / (1 << level), t * scale_v * density / (1 << level)
            value = bilinear(atlas.texels, atlas.offset[sheet, level], w, h, p - 0.5, q - 0.5)
            if footprint > 1.0:
                coarse = bilinear(
                    atlas.texels, atlas.offset[sheet, level + 1], w >> 1, h >> 1,
                    0.5 * p - 0.5, 0.5 * q - 0.5,
                )  # fmt: skip
                value += min(footprint - 1.0, 1.0) * (coarse - value)
            value *= (
                w00 * light[i, j] + w01 * light[i, j + 1]
                + w10 * light[i + 1, j] + w11 * light[i + 1, j + 1]
            )  # fmt: skip
            if gloss > 0.0:
                # Blinn and Phong: the normal against the middle between lamp and eye.
                lx, ly, lz = toward[0] - z * x, toward[1] - z * y, toward[2] - z
                far = math.sqrt(lx * lx + ly * ly + lz * lz)
                mx, my, mz = lx / far - x / length, ly / far - y / length, lz / far - 1.0 / length
                middle = math.sqrt(mx * mx + my * my + mz * mz) + 1e-9
                cosine = abs(nx * mx + ny * my + nz * mz) / (norm * middle)
                value += gloss * math.exp(_SHININESS * math.log(max(cosine, 1e-6)))
            out[row, column] += weight * min(value, 300.0)


def empty_buffers(height: int, width: int) -> tuple[F64, I32, F32]:
    """nearness, seen and where of nothing."""
    shape = (height, width)
    return np.zeros(shape), np.full(shape, -1, np.int32), np.zeros((*shape, 2), np.float32)
