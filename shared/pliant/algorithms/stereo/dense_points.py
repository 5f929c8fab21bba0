"""Pixels whose depth is sure, as further points of a keyframe beside those of the map."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Annotated

import cv2
import numpy as np

from pliant.algorithms.arrays import F64, Shape
from pliant.algorithms.stereo.sweep import poses_of
from pliant.algorithms.stereo.views import DenseDepth, StereoView, motion, parallax_px

_CLEAR_STRIDES = 2
"""A match as near to a point of the map, in the same window, tells less than it."""
_MATCHING_PX = 0.7
"""Standard deviation of a match, pixels of the swept view."""


@dataclass(frozen=True)
class SurePixels:
    """points_px: in pixels of the swept view.    inverse_depths: along z."""

    points_px: Annotated[F64, Shape("N", 2)]
    inverse_depths: Annotated[F64, Shape("N")]


def sure_pixels(
    depth: DenseDepth, points_px: F64, *, stride: int, min_support: float
) -> SurePixels:
    """Pixels with much support away from the map's own points.

    depth: as of ``consensus``.    points_px: (N, 2) the map's, in pixels of the view.
    stride: in rows and columns.    min_support: as many confident views agree.
    """
    height, width = depth.confidences.shape
    c = _CLEAR_STRIDES * stride
    taken = np.zeros((height + 2 * c, width + 2 * c), np.uint8)
    at = np.rint(points_px[np.isfinite(points_px).all(axis=1)]).astype(np.int64) + c
    inside = (at >= 0).all(axis=1) & (at < (width + 2 * c, height + 2 * c)).all(axis=1)
    taken[at[inside, 1], at[inside, 0]] = 1
    around = np.asarray(cv2.dilate(taken, np.ones((2 * c + 1, 2 * c + 1), np.uint8)), np.uint8)
    free = np.zeros((height, width), np.bool_)
    free[::stride, ::stride] = around[c : c + height : stride, c : c + width : stride] == 0
    sure = free & (depth.confidences > min_support)
    v, u = np.nonzero(sure)
    return SurePixels(
        np.stack([u, v], axis=1).astype(np.float64),
        depth.inverse_depths[sure].astype(np.float64),
    )


def matching_sigmas(pixels: SurePixels, view: StereoView, sources: Sequence[StereoView]) -> F64:
    """(N,) standard deviations of inverse depths, as a share of them, times ``noise_px``.

    Where a source sees the pixel move by p per unit of inverse depth, an error of e pixels in
    matching is one of e / p in w: a share e / (p w).  Of the sources the median one counts.
    """
    moved = motion(view.camera, view.T_world_camera, poses_of(sources))
    with np.errstate(all="ignore"):
        slopes = parallax_px(moved, pixels.points_px, pixels.inverse_depths)
        slope = np.median(np.nan_to_num(slopes), axis=0)
        return _MATCHING_PX / (slope * pixels.inverse_depths)
