"""The pinhole camera: everything behind the ingest works on rectified images.

Pixels are (u, v) with (0, 0) at the centre of the top-left pixel; the camera frame is x right,
y down, z forward.
"""

import math
from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, F64


@dataclass(frozen=True, kw_only=True)
class PinholeCamera:
    """A camera without distortion.  Focal lengths and principal point in pixels."""

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float

    @property
    def K(self) -> F64:
        """(3, 3) intrinsic matrix."""
        return np.array([[self.fx, 0.0, self.cx], [0.0, self.fy, self.cy], [0.0, 0.0, 1.0]])

    @property
    def intrinsics(self) -> F64:
        """(4,) fx, fy, cx, cy: what kernels take."""
        return np.array([self.fx, self.fy, self.cx, self.cy])

    def project(self, points_camera: F32 | F64) -> F64:
        """Project (N, 3) camera-frame points to (N, 2) pixels.  Points behind give nonsense."""
        points = np.asarray(points_camera, np.float64)
        return points[:, :2] / points[:, 2:3] * (self.fx, self.fy) + (self.cx, self.cy)

    def normalise(self, points_px: F32 | F64) -> F64:
        """(N, 2) pixels to (N, 2) coordinates on the plane z = 1."""
        return (np.asarray(points_px, np.float64) - (self.cx, self.cy)) / (self.fx, self.fy)


def size_unit(width: int, height: int) -> float:
    """How many times as large as 640x480 images are, by the diagonal: however they are held."""
    return math.hypot(width, height) / math.hypot(640.0, 480.0)
