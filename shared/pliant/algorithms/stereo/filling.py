"""Depth where a keyframe has no surface of its own.

Between points that are not sure, across jumps and on slants a keyframe's surface has holes.  What
its images say there is worth less than any surface, yet better than nothing: it enters with a
weight so small that one keyframe with a sure surface outweighs many without.
"""

import numpy as np

from pliant.algorithms.arrays import F32
from pliant.algorithms.meshing.rendering import DepthMap
from pliant.compiler.kernel import kernel

_WEIGHT = 0.01
"""A surface face on, of certain depth, has 1."""
_ONE_SURFACE = 0.03
"""Share of the inverse depth by which pixels side by side on one surface differ at most."""


def filled(depth_map: DepthMap, inverse_depths: F32, times: int) -> DepthMap:
    """A keyframe's depth map (H, W), with other depth in the place of nothing.

    inverse_depths: (h, w), 0: unknown, of the image ``times`` smaller; h = H // times.
    """
    depths, weights = depth_map.depths.copy(), depth_map.weights.copy()
    if inverse_depths.size:
        _fill(inverse_depths, times, depths, weights)
    return DepthMap(depths=depths, weights=weights)


@kernel
def _fill(w: F32, times: int, depths: F32, weights: F32) -> None:
    """Bilinear within one surface, the nearest pixel elsewhere.  w: (h, w), 0: unknown."""
    height, width = w.shape
    half, one, scale = np.float32(0.5), np.float32(1.0), np.float32(times)
    for v in range(min(depths.shape[0], height * times)):
        y = min(max((np.float32(v) + half) / scale - half, np.float32(0.0)), np.float32(height - 1))
        top = int(y)
        low, q = min(top + 1, height - 1), y - np.float32(top)
        for u in range(min(depths.shape[1], width * times)):
            nearest = w[v // times, u // times]
            if depths[v, u] > np.float32(0.0) or not nearest > np.float32(0.0):
                continue
            x = (np.float32(u) + half) / scale - half
            x = min(max(x, np.float32(0.0)), np.float32(width - 1))
            left = int(x)
            right, p = min(left + 1, width - 1), x - np.float32(left)
            a, b, c, d = w[top, left], w[top, right], w[low, left], w[low, right]
            mixed = (one - q) * ((one - p) * a + p * b) + q * ((one - p) * c + p * d)
            apart = max(max(a, b), max(c, d)) - min(min(a, b), min(c, d))
            is_smooth = apart < np.float32(_ONE_SURFACE) * nearest
            depths[v, u] = one / (mixed if is_smooth else nearest)
            weights[v, u] = np.float32(_WEIGHT)
