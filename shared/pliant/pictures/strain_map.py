"""Strain of a surface drawn on its image."""

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8
from pliant.pictures.caption import with_caption
from pliant.pictures.strain_colours import strain_colours

_OPACITY = 0.6
_SHIFT = 4  # fractional bits of OpenCV's drawing coordinates


def draw_strain(
    image: U8, points_px: F32, triangles: I32, values: F64, full: float, words: str
) -> U8:
    """An image with coloured triangles and a bar of words under it, (H', W', 3) RGB.

    image: (H, W) grey or (H, W, 3) RGB.    points_px: (N, 2) of the vertices.    triangles: (T, 3).
    values: (T,) strain of each.    full: strain with the full colour.
    """
    rgb = np.repeat(image[:, :, None], 3, axis=2) if image.ndim == 2 else image.copy()
    painted = rgb.copy()
    corners = np.round(points_px[triangles] * (1 << _SHIFT)).astype(np.int32)
    for corner, colour in zip(corners, strain_colours(values, full).tolist(), strict=True):
        cv2.fillConvexPoly(painted, corner, colour, cv2.LINE_8, _SHIFT)
    mixed = cv2.addWeighted(painted, _OPACITY, rgb, 1.0 - _OPACITY, 0.0)
    return with_caption(np.asarray(mixed, np.uint8), words)
