"""What a camera sees of triangles: a depth map to be fused, or a mesh with what its corners have.

Inverse depth along z is affine in the image on a plane (1 / z = n . ray / d), so interpolating it
linearly in pixels is the perspective-correct interpolation of depth.
"""

import math
from dataclasses import dataclass
from typing import Annotated, TypeAlias

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, BoolArray, Shape
from pliant.algorithms.camera import PinholeCamera
from pliant.compiler.kernel import kernel

_NEAREST_SHARE = 1e-3
"""Triangles nearer than this share of the median depth are left out: there is no clipping."""

Pinhole: TypeAlias = tuple[float, float, float, float]
"""fx, fy, cx, cy, for the kernels."""


def _pinhole(camera: PinholeCamera) -> Pinhole:
    return camera.fx, camera.fy, camera.cx, camera.cy


@dataclass(frozen=True)
class DepthMap:
    """Depth along z, 0 where no triangle is, and the weight of each pixel in [0, 1], 0 likewise."""

    depths: Annotated[F32, Shape("H", "W")]
    weights: Annotated[F32, Shape("H", "W")]

    def within(self, used: BoolArray) -> "DepthMap":
        """Return the depth map inside a mask (H, W)."""
        nothing = np.float32(0.0)
        depths, weights = (np.where(used, each, nothing) for each in (self.depths, self.weights))
        return DepthMap(depths=depths, weights=weights)


@dataclass(frozen=True)
class DrawnTriangles:
    """What ``render_depth`` takes of a surface: far smaller than the depth map that it gives."""

    triangles: Annotated[I32, Shape("T", 3)]
    points_px: Annotated[F32, Shape("M", 2)]
    inverse_depths: Annotated[F32, Shape("M")]
    sigmas: Annotated[F32, Shape("M")]

    def depth_map(self, camera: PinholeCamera) -> DepthMap:
        """As ``render_depth`` gives it."""
        return render_depth(
            self.triangles, self.points_px, self.inverse_depths, self.sigmas, camera
        )


def render_depth(
    triangles: I32, points_px: F32, inverse_depths: F32, sigmas: F32, camera: PinholeCamera
) -> DepthMap:
    """The nearest surface at every pixel centre (integer coordinates).

    triangles: (T, 3), turning either way.    points_px: (M, 2).    inverse_depths, sigmas: (M,)
    inverse depth along z and its standard deviation.    Triangles with a corner that is not finite
    or not in front of the camera are left out.

    The weight is the cosine of the slant, over 1 + the variance of depth in units of (1 % of
    depth)^2.  A pixel centre on an edge belongs to the triangle on whose upper or left side it is.
    So two triangles with a common edge leave no gap and cover no pixel twice.
    """
    shape = (camera.height, camera.width)
    nearest, weights = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    _rasterise(
        triangles, points_px.astype(np.float64), inverse_depths.astype(np.float64),
        sigmas.astype(np.float64), _pinhole(camera), nearest, weights,
    )  # fmt: skip
    depths = np.zeros(shape, np.float32)
    np.divide(np.float32(1.0), nearest, out=depths, where=nearest > 0.0)
    return DepthMap(depths, weights)


def normals_of(depths: F32, camera: PinholeCamera) -> F32:
    """(H, W, 3) unit normals of a depth map (H, W), in the camera and towards it; 0: unknown.

    On a plane n . X = 1 inverse depth is n . ray, so its slopes in the image are n_x / fx and
    n_y / fy.  Of the slopes to either side the lesser one counts: the other may lead over an edge.
    """
    inverse = np.where(depths > 0.0, 1.0 / np.where(depths > 0.0, depths, 1.0), np.nan)
    gu, gv = _slopes(inverse), _slopes(inverse.T).T
    u = np.arange(camera.width) - camera.cx
    v = np.arange(camera.height)[:, None] - camera.cy
    normals = np.stack([camera.fx * gu, camera.fy * gv, inverse - gu * u - gv * v], axis=-1)
    normals /= -np.linalg.norm(normals, axis=-1, keepdims=True)
    return np.nan_to_num(normals).astype(np.float32)


def _slopes(values: F64) -> F64:
    """(H, W) differences along the rows of an image, NaN where neither neighbour is known."""
    nothing = np.full((len(values), 1), np.nan)
    steps = np.diff(values, axis=1)
    left, right = np.hstack([nothing, steps]), np.hstack([steps, nothing])
    return np.where(np.isnan(right) | (np.abs(left) < np.abs(right)), left, right)


@kernel
def _rasterise(
    triangles: I32, pixels: F64, inverse: F64, sigmas: F64, pinhole: Pinhole,
    nearest: F32, weights: F32,
) -> None:  # fmt: skip
    height, width = nearest.shape
    fx, fy, cx, cy = pinhole
    for t in range(len(triangles)):
        a, b, c = triangles[t, 0], triangles[t, 1], triangles[t, 2]
        if not (min(inverse[a], inverse[b], inverse[c]) > 0.0):
            continue
        total = pixels[a, 0] + pixels[b, 0] + pixels[c, 0] + pixels[a, 1] + pixels[b, 1]
        total += pixels[c, 1] + inverse[a] + inverse[b] + inverse[c]
        if not (abs(total) < np.inf):
            continue
        ua, va = pixels[a, 0], pixels[a, 1]
        eu, ev, fu, fv = pixels[b, 0] - ua, pixels[b, 1] - va, pixels[c, 0] - ua, pixels[c, 1] - va
        area = eu * fv - ev * fu
        if area == 0.0:
            continue
        # The plane: inverse depth g + gu u + gv v.  Its normal is (fx gu, fy gv, g at the centre).
        ri, rf = inverse[b] - inverse[a], inverse[c] - inverse[a]
        gu, gv = (ri * fv - rf * ev) / area, (rf * eu - ri * fu) / area
        nu, nv, nw = fx * gu, fy * gv, inverse[a] + gu * (cx - ua) + gv * (cy - va)
        normal = math.sqrt(nu * nu + nv * nv + nw * nw)
        su, sv = sigmas[b] - sigmas[a], sigmas[c] - sigmas[a]
        hu, hv = (su * fv - sv * ev) / area, (sv * eu - su * fu) / area
        low = min(va, pixels[b, 1], pixels[c, 1])
        high = max(va, pixels[b, 1], pixels[c, 1])
        for v in range(max(0, _ceil(low, height)), min(height - 1, _floor(high, height)) + 1):
            left, right = -np.inf, np.inf
            left, right = _cut(pixels, a, b, v, area > 0.0, left, right)
            left, right = _cut(pixels, b, c, v, area > 0.0, left, right)
            left, right = _cut(pixels, c, a, v, area > 0.0, left, right)
            # Half open, [left, right): what is on the right edge is the neighbour's.
            if not (-np.inf < left < right < np.inf):
                continue
            first, end = max(0, _ceil(left, width)), min(width, _ceil(right, width))
            for u in range(first, end):
                x = inverse[a] + gu * (u - ua) + gv * (v - va)
                if not x > nearest[v, u]:
                    continue
                nearest[v, u] = x
                ray_u, ray_v = (u - cx) / fx, (v - cy) / fy
                # n . ray is the inverse depth itself.
                cosine = x / (normal * math.sqrt(1.0 + ray_u * ray_u + ray_v * ray_v))
                relative = 100.0 * (sigmas[a] + hu * (u - ua) + hv * (v - va)) / x
                weights[v, u] = min(cosine, 1.0) / (1.0 + relative * relative)


@kernel
def _cut(
    pixels: F64, i: int, j: int, v: int, turns_right: bool, left: float, right: float
) -> tuple[float, float]:
    """Narrow a row's interval by one edge: rows from the upper end to before the lower one."""
    if pixels[i, 1] == pixels[j, 1]:
        return left, right
    downwards = pixels[j, 1] > pixels[i, 1]
    # Always from the upper end: both triangles at an edge must compute the same crossing.
    top, bottom = (i, j) if downwards else (j, i)
    if v < pixels[top, 1] or v >= pixels[bottom, 1]:
        return left, right
    slope = (pixels[bottom, 0] - pixels[top, 0]) / (pixels[bottom, 1] - pixels[top, 1])
    u = pixels[top, 0] + slope * (v - pixels[top, 1])
    # With positive area in (u, v) the inside is on the left of an edge that goes up.
    if downwards == turns_right:
        return left, u
    return u, right


@kernel
def _ceil(value: float, limit: int) -> int:
    """The ceiling, within -1 and limit, whatever the value."""
    return math.ceil(min(max(value, -1.0), float(limit)))


@kernel
def _floor(value: float, limit: int) -> int:
    return math.floor(min(max(value, -1.0), float(limit)))


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
        points_in_camera = np.ascontiguousarray(in_camera)
        _draw(points_in_camera, faces, near, _pinhole(camera), nearest, triangles, shares)
    depths = np.zeros(shape, np.float32)
    np.divide(1.0, nearest, out=depths, where=nearest > 0.0, casting="same_kind")
    return MeshView(depths, triangles, shares)


@kernel
def _draw(
    points: F64, faces: I32, near: float, pinhole: Pinhole,
    nearest: F64, triangles: I32, shares: F32,
) -> None:  # fmt: skip
    height, width = nearest.shape
    fx, fy, cx, cy = pinhole
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
