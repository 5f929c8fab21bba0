"""The depth that one keyframe's image and those of some others tell, before anyone else is asked.

Coarse to fine: planes parallel to the image at half of the views' size, over all depths that the
map's points have; then a few steps along the surface that was found, at the views' size.  Gallup
et al. 2007 sweep along planes of several slants; to follow the surface takes one sweep.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, I64, U8, Shape
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.stereo.matching import WORST, inverse_depths_between, matching_costs
from pliant.algorithms.stereo.semi_global import Penalties, Winners, best_steps
from pliant.algorithms.stereo.views import (
    NOT_SHOWN,
    DenseDepth,
    StereoView,
    motion,
    parallax_px,
)
from pliant.compiler.kernel import kernel

_MOST_DEPTHS = 64
_COARSE_STEP_PX = 0.6
"""Between two inverse depths, in the median source."""
_COARSE_RADIUS, FINE_RADIUS = 2, 3
"""Of windows, pixels."""
_FINE_STEP_PX = 0.4
_FINE_STEPS = 4
"""To either side of the surface; together as far as 1.3 coarse steps."""
_NEAREST, _FURTHEST = 1.25, 0.75
"""The sweep begins and ends so far beyond the inverse depths of the map's points ..."""
_QUANTILES = (0.01, 0.995)
"""... but for those that are likely wrong."""
_MIN_POINTS = 8
_MIN_PARALLAX_PX = 1.0
"""Between infinity and the median anchor, in the median source: with less depth is a guess."""
_ANCHOR = 0.9
"""How far a point of the map, sure to a step, outweighs the images at its pixel."""
_JUMP_STEPS = 2.0
_UNSURE = 3.0
"""Steps or sigmas from an anchor that cost as much as no correlation."""


@dataclass(frozen=True)
class Anchors:
    """Points of the map that a view observes.

    points_px: where, in pixels of the view.    inverse_depths, sigmas: along z.
    """

    points_px: Annotated[F64, Shape("N", 2)]
    inverse_depths: Annotated[F64, Shape("N")]
    sigmas: Annotated[F64, Shape("N")]

    def halved(self) -> "Anchors":
        """In pixels of an image of half the size."""
        return Anchors((self.points_px + 0.5) / 2 - 0.5, self.inverse_depths, self.sigmas)


def swept_depth(view: StereoView, sources: Sequence[StereoView], anchors: Anchors) -> DenseDepth:
    """Inverse depth of every pixel of a view that it and the sources show.

    sources: of the same camera.  Nothing is known where there are none, or hardly any anchors.
    """
    if len(anchors.inverse_depths) < _MIN_POINTS:
        return _nothing(view.grey.shape)
    slope = px_per_inverse_depth(view, sources, anchors)
    if not slope * float(np.median(anchors.inverse_depths)) > _MIN_PARALLAX_PX:
        return _nothing(view.grey.shape)
    # The coarse sweep: planes, windows of 5 x 5 pixels, SGM.
    coarse, around = view.halved(), [source.halved() for source in sources]
    low, high = np.quantile(anchors.inverse_depths, _QUANTILES)
    planes = inverse_depths_between(
        _FURTHEST * low, _NEAREST * high, 2.0 * _COARSE_STEP_PX / slope, _MOST_DEPTHS
    )
    step = float(planes[1] - planes[0])
    flat = np.zeros(coarse.grey.shape, np.float32)
    costs = _costs(coarse, around, flat, planes, _COARSE_RADIUS)
    pull_to_anchors(costs, planes, anchors.halved())
    found = best_steps(costs, coarse.grey, Penalties())
    surface = _median((planes[0] + step * found.steps).astype(np.float32), 5)
    # The fine sweep: along that surface, windows of 7 x 7 pixels, SGM.
    surface = upsampled(surface, view.grey.shape, _JUMP_STEPS * step)
    offsets = np.linspace(-_FINE_STEPS, _FINE_STEPS, 2 * _FINE_STEPS + 1) * _FINE_STEP_PX / slope
    costs = _costs(view, sources, surface, offsets, FINE_RADIUS)
    fine = best_steps(costs, view.grey, Penalties().halved())
    moved = (offsets[0] + (_FINE_STEP_PX / slope) * fine.steps).astype(np.float32)
    inverse_depths = _median(np.maximum(surface + moved, np.float32(0.0)), 3)
    return DenseDepth(inverse_depths, _confidences(inverse_depths, fine, view))


def px_per_inverse_depth(
    view: StereoView, sources: Sequence[StereoView], anchors: Anchors
) -> float:
    """Pixels that the anchors move in the median source per unit of inverse depth; 0: unknown."""
    if not sources:
        return 0.0
    moved = motion(view.camera, view.T_world_camera, poses_of(sources))
    slopes = parallax_px(moved, anchors.points_px, anchors.inverse_depths)
    known = np.isfinite(slopes)
    each = [float(np.median(s[k])) for s, k in zip(slopes, known, strict=True) if k.any()]
    return float(np.median(each)) if each else 0.0


def poses_of(views: Sequence[StereoView]) -> F64:
    """(S, 4, 4)"""
    return np.stack([view.T_world_camera for view in views])


def pull_to_anchors(costs: U8, planes: F64, anchors: Anchors) -> None:
    """Mix into the (H, W, D) costs at the pixel of a point how far each depth is from the point's.

    planes: (D,) evenly spaced.  A point that is sure to a step counts 0.9, a worse one less.
    """
    at = np.rint(anchors.points_px).astype(np.int64)
    _pull(costs, planes, at, anchors.inverse_depths, anchors.sigmas)


@kernel
def _pull(costs: U8, planes: F64, at: I64, inverse_depths: F64, sigmas: F64) -> None:
    """at: (N, 2) pixels of the points, some of them perhaps outside."""
    height, width, depths = costs.shape
    step = planes[1] - planes[0]
    for n in range(len(at)):
        u, v = at[n, 0], at[n, 1]
        if u < 0 or v < 0 or u >= width or v >= height:
            continue
        spread = max(sigmas[n], step)
        share = _ANCHOR * step / spread
        for d in range(depths):
            off = min(abs(planes[d] - inverse_depths[n]) / (_UNSURE * spread), 1.0)
            mixed = (1.0 - share) * costs[v, u, d] + share * WORST * off
            costs[v, u, d] = np.uint8(np.rint(mixed))


def _costs(
    view: StereoView, sources: Sequence[StereoView], base: F32, offsets: F64, radius: int
) -> U8:
    moved = motion(view.camera, view.T_world_camera, poses_of(sources))
    images = np.stack([source.grey for source in sources])
    return matching_costs(view.grey, images, moved, base, offsets.astype(np.float32), radius)


def _confidences(inverse_depths: F32, winners: Winners, view: StereoView) -> F32:
    """(H, W) in [0, 1]: of surfaces face on whose depth is distinct."""
    cosines = cosines_of(inverse_depths, view.camera)
    faces = np.clip(2.0 * cosines - 0.2, 0.0, 1.0)
    sure = faces * np.clip(2.0 * winners.distinctness, 0.0, 1.0)
    return np.where(view.grey != NOT_SHOWN, sure, 0.0).astype(np.float32)


def cosines_of(inverse_depths: F32, camera: PinholeCamera) -> F32:
    """(H, W) cosines of the angle between a surface's normal and the ray, 0: unknown."""
    cosines = np.zeros(inverse_depths.shape, np.float32)
    pinhole = camera.intrinsics.astype(np.float32)
    _cosines(inverse_depths, pinhole, cosines)
    return cosines


@kernel
def _cosines(w: F32, pinhole: F32, cosines: F32) -> None:
    """The plane n . X = 1 has the inverse depth n . ray: its slopes are n_x / fx and n_y / fy."""
    height, width = w.shape
    fx, fy, cx, cy = pinhole[0], pinhole[1], pinhole[2], pinhole[3]
    one = np.float32(1.0)
    for v in range(height):
        above, below = max(v - 1, 0), min(v + 1, height - 1)
        y = (np.float32(v) - cy) / fy
        for u in range(width):
            left, right = max(u - 1, 0), min(u + 1, width - 1)
            here = w[v, u]
            if not here > np.float32(0.0):
                continue
            nx = fx * (w[v, right] - w[v, left]) / np.float32(right - left)
            ny = fy * (w[below, u] - w[above, u]) / np.float32(below - above)
            x = (np.float32(u) - cx) / fx
            nz = here - nx * x - ny * y
            norms = (nx * nx + ny * ny + nz * nz) * (x * x + y * y + one)
            cosines[v, u] = min(here / np.sqrt(norms), one)


def upsampled(coarse: F32, shape: tuple[int, ...], jump: float) -> F32:
    """Values at twice the size: bilinear, but the nearest where that is more than ``jump`` off."""
    fine = np.empty(shape, np.float32)
    _upsample(coarse, np.float32(jump), fine)
    return fine


@kernel
def _upsample(coarse: F32, jump: np.float32, fine: F32) -> None:
    height, width = coarse.shape
    half, quarter = np.float32(0.5), np.float32(0.25)
    for v in range(fine.shape[0]):
        y = min(max(half * np.float32(v) - quarter, np.float32(0.0)), np.float32(height - 1))
        j = min(int(y), height - 2)
        q = y - np.float32(j)
        for u in range(fine.shape[1]):
            x = min(max(half * np.float32(u) - quarter, np.float32(0.0)), np.float32(width - 1))
            i = min(int(x), width - 2)
            p = x - np.float32(i)
            a, b, c, d = coarse[j, i], coarse[j, i + 1], coarse[j + 1, i], coarse[j + 1, i + 1]
            top, bottom = a + p * (b - a), c + p * (d - c)
            mixed = top + q * (bottom - top)
            nearest = coarse[j + int(q > half), i + int(p > half)]
            fine[v, u] = mixed if abs(mixed - nearest) <= jump else nearest


def _median(values: F32, side: int) -> F32:
    return np.asarray(cv2.medianBlur(values, side), np.float32)


def _nothing(shape: tuple[int, ...]) -> DenseDepth:
    return DenseDepth(np.zeros(shape, np.float32), np.zeros(shape, np.float32))
