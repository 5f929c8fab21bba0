"""A texture that moves, and the tracks on it."""

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.tracking.parameters import TrackingParameters
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.algorithms.tracks import FrameExtrema

HEIGHT, WIDTH = 240, 320


def smooth_texture(points_px: F64, seed: int = 3) -> F64:
    """Grey levels of an endless texture with structure at all scales, at (..., 2) positions."""
    rng = np.random.default_rng(seed)
    grey = np.full(points_px.shape[:-1], 120.0)
    for wavelength in np.geomspace(6.0, 120.0, 60):
        angle, phase = rng.uniform(0.0, 2.0 * np.pi, 2)
        k = 2.0 * np.pi / wavelength * np.array([np.cos(angle), np.sin(angle)])
        grey += 1.2 * wavelength**0.5 * np.sin(points_px @ k + phase)
    return grey


def motion(frame: int) -> F64:
    """(2, 3) affine that maps pixels of frame 0 to this frame: shift, rotation and zoom."""
    angle, zoom = 0.004 * frame, 1.0 + 0.003 * frame
    A = zoom * np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    centre = np.array([WIDTH, HEIGHT]) / 2.0
    shift = np.array([3.3 * frame, -1.7 * frame])
    return np.column_stack([A, centre + shift - A @ centre])


def render(frame: int, *, gain: float = 1.0, noise: float = 2.0) -> U8:
    """The texture as seen in a frame of the known motion."""
    M = motion(frame)
    v, u = np.mgrid[0:HEIGHT, 0:WIDTH].astype(np.float64)
    inverse = np.linalg.inv(M[:, :2])
    source = (np.stack([u, v], axis=-1) - M[:, 2]) @ inverse.T
    rng = np.random.default_rng(frame)
    grey = gain * smooth_texture(source) + rng.normal(0.0, noise, (HEIGHT, WIDTH))
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def stamp_ns(frame: int, fps: int = 30) -> int:
    """When a frame was taken."""
    return round(frame * 1e9 / fps)


def follow(
    images: list[U8], parameters: TrackingParameters, seed: int = 0, fps: int = 30
) -> list[FrameExtrema]:
    """Track a list of images."""
    tracker = ExtremaTracker(images[0].shape[1], images[0].shape[0], parameters, seed)
    return [tracker.track(image, stamp_ns(k, fps)) for k, image in enumerate(images)]
