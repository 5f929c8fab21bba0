"""The rays of the pixels of a lens with radial-tangential distortion.

A ray is the point (x, y) of the plane z = 1.
"""

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.rectification import Lens, undistort

Distortion = tuple[float, float, float, float]  # k1, k2, p1, p2
NO_DISTORTION: Distortion = (0.0, 0.0, 0.0, 0.0)


def lens(camera: PinholeCamera, distortion: Distortion) -> Lens:
    """The camera with a distortion before it."""
    return Lens(
        model="pinhole-radtan",
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        coefficients=(*distortion, 0.0),
    )


def pixel_rays(
    camera: PinholeCamera, distortion: Distortion, offset_px: tuple[float, float] = (0.0, 0.0)
) -> F64:
    """(H, W, 2) rays of all pixels, taken at ``offset_px`` from the pixels' centres.

    Raises ValueError if the model cannot be inverted (a distortion that folds the image).
    """
    u = (np.arange(camera.width) + offset_px[0] - camera.cx) / camera.fx
    v = (np.arange(camera.height) + offset_px[1] - camera.cy) / camera.fy
    grid: F64 = np.stack(np.meshgrid(u, v), axis=-1).astype(np.float64)
    rays = undistort(grid, lens(camera, distortion))
    if not np.all(np.isfinite(rays)):
        raise ValueError(f"distortion {distortion} folds the image: it has no inverse")
    return rays
