"""A floor, walls and a ball with a texture in space: images, exact depths and some map points."""

import numpy as np
from fusion_scene import CAMERA, pose, rays, true_depth

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.stereo.sweep import Anchors
from pliant.algorithms.stereo.views import StereoView

__all__ = ["CAMERA", "anchors", "grey", "pose", "true_depth_points", "true_inverse", "view"]


def grey(T: F64, depth: F32, *, seed: int = 7) -> U8:
    """What the camera sees: waves of 4 to 20 pixels' length, the same from everywhere."""
    points = rays(CAMERA) * depth[..., None] @ T[:3, :3].T + T[:3, 3]
    generator = np.random.default_rng(seed)
    value = np.zeros(depth.shape)
    for _ in range(40):
        direction = generator.standard_normal(3)
        direction /= np.linalg.norm(direction)
        length = generator.uniform(0.12, 0.6)
        value += np.sin(2 * np.pi * points @ direction / length + generator.uniform(0.0, 6.3))
    return np.clip(128.0 + 18.0 * value, 1.0, 255.0).astype(np.uint8)


def view(step: int) -> StereoView:
    return StereoView(grey(pose(step), true_depth(pose(step))), CAMERA, pose(step))


def true_inverse(step: int) -> F64:
    return 1.0 / true_depth(pose(step)).astype(np.float64)


def anchors(step: int, count: int = 150, noise: float = 0.01) -> Anchors:
    """Points of a map, in the unit of the scene, sure to a share of their depth."""
    generator = np.random.default_rng(1000 + step)
    u = generator.integers(2, CAMERA.width - 2, count)
    v = generator.integers(2, CAMERA.height - 2, count)
    w = true_inverse(step)[v, u]
    return Anchors(
        points_px=np.stack([u, v], axis=1).astype(np.float64),
        inverse_depths=w * (1.0 + noise * generator.standard_normal(count)),
        sigmas=noise * w,
    )


def true_depth_points(step: int) -> F64:
    """(P, 3) some of what a view sees, in the world."""
    T = pose(step)
    local = rays(CAMERA) * true_depth(T)[..., None]
    return local[::12, ::12].reshape(-1, 3) @ T[:3, :3].T + T[:3, 3]
