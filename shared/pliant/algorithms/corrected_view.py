"""Images and pixels as the corrected camera sees them, where the calibration was found wrong."""

from dataclasses import replace

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, U8
from pliant.algorithms.bundle.calibration import ideal_pixels
from pliant.algorithms.camera import PinholeCamera


class CorrectedView:
    """Moves what was seen to where the ideal camera would have seen it.

    correction: (s, k1, k2, ...) as MapDelta.calibration_correction, or () for none.  What a rolling
    shutter does is left: it moves pixels along the image, which depth hardly feels.
    camera: the ideal camera.
    """

    def __init__(self, camera: PinholeCamera, correction: tuple[float, ...]) -> None:
        self.camera = camera
        self._correction = np.array(correction[:3] if len(correction) >= 3 else (0.0, 0.0, 0.0))

    @property
    def lens(self) -> tuple[float, float]:
        """(k1, k2) with which the ideal camera would see the image as it is."""
        return float(self._correction[1]), float(self._correction[2])

    def pixels(self, points_px: F32) -> F32:
        """(N, 2) pixels of the rectified image in the ideal one."""
        if not self._correction.any():
            return points_px
        u, v = np.ascontiguousarray(points_px.T)
        return np.stack(ideal_pixels(u, v, self.camera, self._correction), axis=1)

    def seen(self, points_px: F32) -> F32:
        """(N, 2) pixels of the ideal image in the rectified one: undoes ``pixels``."""
        if not self._correction.any():
            return points_px
        camera = self.camera
        s, k1, k2 = self._correction.tolist()
        x = (points_px[:, 0].astype(np.float64) - camera.cx) / camera.fx
        y = (points_px[:, 1].astype(np.float64) - camera.cy) / camera.fy
        squared = x * x + y * y
        factor = np.exp(s) * (1.0 + k1 * squared + k2 * squared**2)
        u, v = camera.cx + camera.fx * x * factor, camera.cy + camera.fy * y * factor
        return np.stack([u, v], axis=1).astype(np.float32)

    def image(self, pixels: U8) -> U8:
        """(H, W) or (H, W, 3) the ideal image of a rectified one."""
        if not self._correction.any():
            return pixels
        camera = self.camera
        s, k1, k2 = self._correction.tolist()
        x = (np.arange(camera.width) - camera.cx) / camera.fx
        y = ((np.arange(camera.height) - camera.cy) / camera.fy)[:, None]
        squared = x * x + y * y
        factor = np.exp(s) * (1.0 + k1 * squared + k2 * squared**2)
        u = (x * factor * camera.fx + camera.cx).astype(np.float32)
        v = (y * factor * camera.fy + camera.cy).astype(np.float32)
        moved = cv2.remap(pixels, u, v, cv2.INTER_LINEAR, None, cv2.BORDER_REPLICATE)
        return np.asarray(moved, np.uint8)


def corrected_view(camera: PinholeCamera, correction: tuple[float, ...]) -> CorrectedView:
    """The view whose camera has the focal length that was found, so that its pixels move least.

    camera: the one that was believed in.    correction: as of ``CorrectedView``.
    """
    s, k1, k2 = correction[:3] if len(correction) >= 3 else (0.0, 0.0, 0.0)
    factor = float(np.exp(s))
    found = replace(camera, fx=camera.fx * factor, fy=camera.fy * factor)
    return CorrectedView(found, (0.0, k1, k2))
