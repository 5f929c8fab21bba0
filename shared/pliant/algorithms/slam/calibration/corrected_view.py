"""Images and pixels as the corrected camera sees them, where the calibration was found wrong."""

from dataclasses import replace
from functools import cached_property, lru_cache

import numpy as np

from pliant.algorithms.arrays import F32, F64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.image.moved_image import Move, moved_image
from pliant.algorithms.slam.estimate.calibration import ideal_pixels
from pliant.algorithms.slam.estimate.problem import SHARED


class CorrectedView:
    """Converts pixels to those of the ideal camera.

    correction: as MapDelta.calibration_correction, or () for none.  A rolling shutter's
    offset stays: it moves pixels along the image, with little effect on depth.
    camera: the ideal camera.   log_focal: of the image relative to the correction's, where it
    changes during a clip: the image is magnified by as much about ``centre``.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        correction: tuple[float, ...],
        log_focal: float = 0.0,
        centre: tuple[float, float] = (0.0, 0.0),
    ) -> None:
        self.camera = camera
        s, k1, k2, a, b, t = parts_of(correction)
        self._correction = np.array([s, k1, k2, 0.0, a, b, t])
        self._log_focal, self._centre = log_focal, centre

    @property
    def lens(self) -> tuple[float, float]:
        """(k1, k2) with which the ideal camera would see the image as it is."""
        return float(self._correction[1]), float(self._correction[2])

    def pixels(self, points_px: F32) -> F32:
        """(N, 2) pixels of the rectified image in the ideal one."""
        points_px = self._magnified(points_px, -self._log_focal)
        if not self._correction.any():
            return points_px
        return ideal_pixels(np.ascontiguousarray(points_px), self.camera, self._correction)

    def seen(self, points_px: F32) -> F32:
        """(N, 2) pixels of the ideal image in the rectified one: undoes ``pixels``."""
        if not self._correction.any():
            return self._magnified(points_px, self._log_focal)
        camera = self.camera
        x = (points_px[:, 0].astype(np.float64) - camera.cx) / camera.fx
        y = (points_px[:, 1].astype(np.float64) - camera.cy) / camera.fy
        u, v = self._seen(x, y)
        return self._magnified(np.stack([u, v], axis=1).astype(np.float32), self._log_focal)

    def magnified(self, points_px: F32, log_factors: F64) -> F32:
        """(N, 2) pixels of the rectified image moved about its centre, each by its own (N,)."""
        if not log_factors.any():
            return points_px
        moved = self._centre + np.exp(log_factors)[:, None] * (points_px - self._centre)
        return moved.astype(np.float32)

    def _magnified(self, points_px: F32, log_factor: float) -> F32:
        if not log_factor:
            return points_px
        return self.magnified(points_px, np.full(len(points_px), log_factor))

    def image(self, pixels: U8) -> U8:
        """(H, W) or (H, W, 3) the ideal image of a rectified one."""
        return pixels if self.move is None else moved_image(pixels, self.move)

    @property
    def move(self) -> Move | None:
        """The move that ``image`` applies, as of ``MovedImage``."""
        return self._places if self._correction.any() or self._log_focal else None

    @property
    def shows(self) -> BoolArray:
        """(H, W) which pixels of the ideal image have their centre within the rectified one: the
        others are made up of its border."""
        return shows(self._places)

    @cached_property
    def _places(self) -> Move:
        """(H, W) pixel of the rectified image that each of the ideal one shows: u, v."""
        camera = self.camera
        x: F64 = (np.arange(camera.width, dtype=np.float64) - camera.cx) / camera.fx
        y: F64 = (np.arange(camera.height, dtype=np.float64)[:, None] - camera.cy) / camera.fy
        u, v = self._seen(x, y)
        if self._log_focal:
            (cx, cy), factor = self._centre, np.exp(self._log_focal)
            u, v = cx + factor * (u - cx), cy + factor * (v - cy)
        return u.astype(np.float32), v.astype(np.float32)

    def _seen(self, x: F64, y: F64) -> tuple[F64, F64]:
        """Pixels of the rectified image that see points of the plane z = 1."""
        camera = self.camera
        s, k1, k2, _, a, b, t = self._correction.tolist()
        squared = x * x + y * y
        factor = 1.0 + k1 * squared + k2 * squared**2
        u = camera.cx + np.exp(s) * camera.fx * (x * factor + a)
        return u, camera.cy + np.exp(s + t) * camera.fy * (y * factor + b)


def moved_px(
    points_px: F32, before: CorrectedView, after: CorrectedView, log_factors: F64 | None = None
) -> F32:
    """(N, 2) pixels of one ideal camera in another one.

    log_factors: (N,) by which the focal length of each has been found to be larger; None: by 0.
    """
    seen = before.seen(points_px)
    return after.pixels(seen if log_factors is None else after.magnified(seen, -log_factors))


def shows(move: Move) -> BoolArray:
    """(H, W) which pixels of a moved image have their centre within the one before, of its size."""
    u, v = move
    height, width = u.shape
    return (u >= -0.5) & (u <= width - 0.5) & (v >= -0.5) & (v <= height - 0.5)


def parts_of(correction: tuple[float, ...]) -> tuple[float, float, float, float, float, float]:
    """(s, k1, k2, a, b, t) of a correction, also of a recording from before the last three."""
    known = (*correction, *np.zeros(SHARED))[:SHARED] if len(correction) >= 3 else np.zeros(SHARED)
    s, k1, k2, _, a, b, t = (float(each) for each in known)
    return s, k1, k2, a, b, t


@lru_cache(maxsize=4)
def corrected_view(
    camera: PinholeCamera, correction: tuple[float, ...], log_focal: float = 0.0
) -> CorrectedView:
    """The view whose camera is the pinhole that was found, so that its pixels move least.

    camera: the one that was believed in.    correction, log_focal: as of ``CorrectedView``.
    """
    s, k1, k2, a, b, t = parts_of(correction)
    fx, fy = camera.fx * float(np.exp(s)), camera.fy * float(np.exp(s + t))
    found = replace(camera, fx=fx, fy=fy, cx=camera.cx + fx * a, cy=camera.cy + fy * b)
    return CorrectedView(found, (0.0, k1, k2), log_focal, (camera.cx, camera.cy))
