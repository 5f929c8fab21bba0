"""A texture for a mesh: where each texel lies on it, and what colour the views of it give."""

from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, I64, U8, BoolArray, Shape
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.meshing.mesh_components import components
from pliant.algorithms.meshing.rendering import view_mesh
from pliant.compiler.kernel import kernel

_PATCHES_ACROSS = 8
"""Cells of patches along the longest side of a scene."""
_GUTTER_TEXELS = 2
"""Around each piece of a mesh in its texture."""
_SCALES = 24
"""Steps by halves towards the largest scale at which a texture holds a mesh."""
_MIN_COSINE = 0.2
"""Of the slant: more slanted views do not colour a texel."""
_DEPTH_TOLERANCE = 0.03
"""Share of its depth by which what a view sees may lie before or behind a texel."""
_BORDER = 0.1
"""Share of the image at its border in which a view counts for less, so that no seam shows."""
_SATURATED = 0.01
"""Share of the texels that exposure may have saturate."""


@dataclass(frozen=True)
class Texels:
    """The texels of a square texture that lie on a mesh.

    inside: which.    triangles: of each of those, row by row, the triangle on which it lies.
    shares: of the second and third corner there.
    """

    inside: Annotated[BoolArray, Shape("S", "S")]
    triangles: Annotated[I32, Shape("N")]
    shares: Annotated[F32, Shape("N", 2)]

    def interpolate(self, corners: F32) -> F32:
        """(N, C) of (F, 3, C) values at the corners of the triangles."""
        b, c = self.shares[:, 0:1], self.shares[:, 1:2]
        first, second, third = corners[self.triangles].transpose(1, 0, 2)
        return first * (1.0 - b - c) + second * b + third * c


def patches(corners: F32) -> I64:
    """(F,) numbers of patches: by place, and by the axis along which triangles face most.

    corners: (F, 3, 3) positions.  In the direction of its axis hardly any patch hides itself.
    """
    turned = _turned(corners)
    axis = _axes(turned)
    side = np.take_along_axis(turned, axis[:, None], axis=1)[:, 0] > 0.0
    centres = corners.mean(axis=1)
    low = centres.min(axis=0)
    cell = max(float((centres.max(axis=0) - low).max()) / _PATCHES_ACROSS, 1e-30)
    cells = np.floor((centres - low) / cell).astype(np.int64)
    x, y, z = np.minimum(cells, _PATCHES_ACROSS - 1).T
    return ((x * _PATCHES_ACROSS + y) * _PATCHES_ACROSS + z) * 6 + axis * 2 + side


def cut_apart(triangles: I32, patch: I64) -> tuple[I32, I64]:
    """Cut a mesh between patches, and where it is no manifold.

    triangles: (F, 3).    patch: (F,).  Returns (F, 3) triangles of new vertices, and (V',) which
    old vertex each of them is.  Triangles share a vertex where a fan of neighbours joins them.
    """
    corners, following = triangles.ravel().astype(np.int64), np.roll(triangles, -1, axis=1).ravel()
    count = int(triangles.max(initial=0)) + 1
    ways, backs = corners * count + following, following.astype(np.int64) * count + corners
    known, first, uses = np.unique(ways, return_index=True, return_counts=True)
    at = np.minimum(np.searchsorted(known, backs), len(known) - 1)
    alone = uses[np.searchsorted(known, ways)] == 1
    joined = (known[at] == backs) & (uses[at] == 1) & alone
    joined &= np.repeat(patch, 3) == patch[first[at] // 3]
    half = np.flatnonzero(joined)
    twin = first[at[half]]
    # A half edge starts where its twin ends: the corners there are one vertex.
    here, there = np.concatenate([half, _next(half)]), np.concatenate([_next(twin), twin])
    vertex = components(len(corners), here, there)
    _, some_corner = np.unique(vertex, return_index=True)
    return vertex.reshape(-1, 3).astype(np.int32), corners[some_corner]


def make_atlas(corners: F32, cut: I32, size: int) -> F32:
    """(F, 3, 2) places in [0, 1] of all corners in a square texture of ``size`` texels a side.

    corners: (F, 3, 3) positions.    cut: (F, 3) their vertices in a mesh cut into patches.  Each
    connected piece is seen along its axis, all at one scale, in rows of falling height.
    """
    across = np.stack([_axes(_turned(corners)) + 1, _axes(_turned(corners)) + 2], axis=1) % 3
    flat = np.take_along_axis(corners, across[:, None, :], axis=2).astype(np.float64)
    edges = cut.ravel().astype(np.int64), np.roll(cut, -1, axis=1).ravel().astype(np.int64)
    label = components(int(cut.max(initial=0)) + 1, *edges)
    count, piece = int(label.max()) + 1, label[cut[:, 0]]
    low, high = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(low, piece, flat.min(axis=1))
    np.maximum.at(high, piece, flat.max(axis=1))
    flat -= low[piece][:, None]
    extent = high - low
    upright = extent[:, 1] > extent[:, 0]
    flat[upright[piece]] = flat[upright[piece]][:, :, ::-1]
    extent[upright] = extent[upright][:, ::-1]
    order = np.lexsort((np.arange(count), -extent[:, 1]))
    found, placed = np.zeros((count, 2)), np.zeros((count, 2))
    least, most = 0.0, size / max(float(extent.max()), 1e-30)
    for _ in range(_SCALES):
        scale = 0.5 * (least + most)
        texels = np.ceil(extent * scale).astype(np.int64) + 2 * _GUTTER_TEXELS
        if _pack(texels, order, size, placed):
            least, found = scale, placed.copy()
        else:
            most = scale
    places = flat * least + found[piece][:, None] + _GUTTER_TEXELS
    return (places / size).astype(np.float32)


def find_texels(uvs: F32, size: int) -> Texels:
    """Which triangle each texel of a texture shows.

    uvs: (F, 3, 2) of the corners of each triangle, in [0, 1], (0, 0) at the outer corner of the
    first texel.    size: texels along a side.
    """
    flat = np.concatenate([uvs.reshape(-1, 2), np.ones((uvs.size // 2, 1), np.float32)], axis=1)
    faces = np.arange(len(flat), dtype=np.int32).reshape(-1, 3)
    above = PinholeCamera(width=size, height=size, fx=size, fy=size, cx=-0.5, cy=-0.5)
    seen = view_mesh(flat.astype(np.float32), faces, above, np.eye(4))
    inside = seen.triangles >= 0
    return Texels(inside, seen.triangles[inside], seen.shares[inside])


class TexelColours:
    """The weighted mean of what views show of each texel: sharp, near and straight ones count most.

    points, triangles: (V, 3), (F, 3) of the mesh, which may hide itself.
    positions, normals: (N, 3) of the texels.
    """

    def __init__(self, texels: Texels, points: F32, triangles: I32) -> None:
        corners = points[triangles]
        turned = _turned(corners)
        length = np.maximum(np.linalg.norm(turned, axis=1, keepdims=True), 1e-30)
        self._texels = texels
        self.positions = texels.interpolate(corners)
        self.normals = (turned / length).astype(np.float32)[texels.triangles]
        self._points = points
        self._triangles = triangles
        self._sums = np.zeros((len(texels.triangles), 4))

    def depths(
        self, camera: PinholeCamera, T_world_camera: F64, used: BoolArray | None = None
    ) -> F32:
        """(H, W) of the mesh in a view, 0 for none.  used: (H, W) which of it shows the mesh."""
        depths = view_mesh(self._points, self._triangles, camera, T_world_camera).depths
        return depths if used is None else np.where(used, depths, np.float32(0.0))

    def add(
        self, image: U8, depths: F32, camera: PinholeCamera, T_world_camera: F64, *,
        gain: F64 | None = None, sharpness: float = 1.0,
    ) -> None:  # fmt: skip
        """A view.  image: (H, W, 3).  depths: as ``depths`` gives them.

        gain: (3,) exposure, by which the colours are divided; None: 1.    sharpness: of the image,
        in any unit that all views have.
        """
        _add_view(
            self.positions, self.normals, np.ascontiguousarray(image), depths,
            camera.intrinsics, inverse(T_world_camera),
            T_world_camera[:3, 3].copy(), 1.0 / (np.ones(3) if gain is None else gain), sharpness,
            self._sums,
        )  # fmt: skip

    def texture(self, otherwise: U8) -> U8:
        """(S, S, 3) texture; texels off the mesh have the colour of the nearest one on it.

        otherwise: (N, 3) colours of texels that no view shows.  All is darkened where gains would
        have more than 1 % of the seen texels saturate.
        """
        weights = self._sums[:, 3:]
        seen = weights > 0.0
        mean = np.divide(self._sums[:, :3], weights, out=np.zeros((len(seen), 3)), where=seen)
        inside = self._texels.inside
        texture = np.zeros((*inside.shape, 3), np.uint8)
        colours = np.where(seen, mean, otherwise)
        if seen.any():
            bright = float(np.quantile(mean[seen[:, 0]].max(axis=1), 1.0 - _SATURATED))
            colours *= min(1.0, 255.0 / max(bright, 1.0))
        texture[inside] = np.rint(np.minimum(colours, 255.0)).astype(np.uint8)
        if not inside.any():
            return texture
        _, found = cv2.distanceTransformWithLabels(
            (~inside).astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
        )
        labels = np.asarray(found, np.int32)
        known = np.zeros((int(labels.max()) + 1, 3), np.uint8)
        known[labels[inside]] = texture[inside]
        return known[labels]


def _turned(corners: F32) -> F32:
    """(F, 3) normals of triangles, as long as twice their area."""
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])


def _axes(turned: F32) -> I64:
    return np.abs(turned).argmax(axis=1)


@kernel
def _pack(extent: I64, order: I64, size: int, placed: F64) -> bool:
    """Place (N, 2) rectangles on shelves, in their order; whether a square holds them all."""
    x, y, height = 0, 0, 0
    for i in order:
        if x + extent[i, 0] > size:
            x, y, height = 0, y + height, 0
        if x + extent[i, 0] > size or y + extent[i, 1] > size:
            return False
        placed[i, 0], placed[i, 1] = x, y
        x += extent[i, 0]
        height = max(height, extent[i, 1])
    return True


def _next(corners: I64) -> I64:
    """The corners after these in their triangles."""
    return corners - corners % 3 + (corners + 1) % 3


@kernel
def _add_view(
    positions: F32, normals: F32, image: U8, depths: F32, K: F64, T: F64, centre: F64,
    factors: F64, sharpness: float, sums: F64,
) -> None:  # fmt: skip
    height, width = depths.shape
    for n in range(len(positions)):
        x, y, z = positions[n, 0], positions[n, 1], positions[n, 2]
        c = T[2, 0] * x + T[2, 1] * y + T[2, 2] * z + T[2, 3]
        if not c > 0.0:
            continue
        u = (T[0, 0] * x + T[0, 1] * y + T[0, 2] * z + T[0, 3]) / c * K[0] + K[2]
        v = (T[1, 0] * x + T[1, 1] * y + T[1, 2] * z + T[1, 3]) / c * K[1] + K[3]
        if not (u >= 1.0 and v >= 1.0 and u < width - 2.0 and v < height - 2.0):
            continue
        dx, dy, dz = centre[0] - x, centre[1] - y, centre[2] - z
        distance = np.sqrt(dx * dx + dy * dy + dz * dz)
        cosine = (normals[n, 0] * dx + normals[n, 1] * dy + normals[n, 2] * dz) / distance
        if cosine < _MIN_COSINE or not _is_seen(depths, u, v, c):
            continue
        share = min(u / width, v / height, 1.0 - u / width, 1.0 - v / height) / _BORDER
        weight = (sharpness * cosine / distance) ** 4 * min(share, 1.0)
        column, row = int(u), int(v)
        p, q = u - column, v - row
        for k in range(3):
            upper = (1.0 - p) * image[row, column, k] + p * image[row, column + 1, k]
            lower = (1.0 - p) * image[row + 1, column, k] + p * image[row + 1, column + 1, k]
            sums[n, k] += weight * factors[k] * ((1.0 - q) * upper + q * lower)
        sums[n, 3] += weight


@kernel
def _is_seen(depths: F32, u: float, v: float, depth: float) -> bool:
    """Whether the surface at a pixel lies at a depth, and nothing near it lies before."""
    column, row = int(u + 0.5), int(v + 0.5)
    if not abs(depths[row, column] - depth) < _DEPTH_TOLERANCE * depth:
        return False
    for b in range(row - 1, row + 2):
        for a in range(column - 1, column + 2):
            if 0.0 < depths[b, a] < (1.0 - _DEPTH_TOLERANCE) * depth:
                return False
    return True
