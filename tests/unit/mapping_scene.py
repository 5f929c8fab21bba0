"""A synthetic scene for the mapper: points in a box, a camera that moves, and its exact tracks."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, so3_exp, transform
from pliant.algorithms.tracks import FrameExtrema

CAMERA = PinholeCamera(width=640, height=480, fx=520.0, fy=520.0, cx=319.5, cy=239.5)

INTERVAL_NS = 33_333_333
"""Between two frames: 30 a second."""


def looking(position, rotation_vector=(0.0, 0.0, 0.0)):
    T = np.eye(4)
    T[:3, :3] = so3_exp(np.array(rotation_vector, np.float64))
    T[:3, 3] = position
    return T


def sideways(frames, step=0.05):
    """A camera that slides sideways, bobs and turns a little."""
    return [
        looking((step * k, 0.03 * np.sin(0.3 * k), 0.02 * k), (0.0, 0.01 * k, 0.005 * np.sin(k)))
        for k in range(frames)
    ]


@dataclass
class Scene:
    """Points with their curvatures; tracks die and start anew when their point leaves the image."""

    points: np.ndarray
    kappas: np.ndarray
    noise_px: float = 0.2
    seed: int = 0
    death: float = 0.0

    @staticmethod
    def box(count=1500, seed=0, **kwargs):
        generator = np.random.default_rng(seed)
        points = generator.uniform((-4.0, -3.0, 3.0), (6.0, 3.0, 9.0), (count, 3))
        kappas = generator.uniform(5.0, 500.0, count).astype(np.float32)
        return Scene(points, kappas, seed=seed, **kwargs)

    def _px(self, T_world_camera):
        camera_points = transform(inverse(T_world_camera), self.points)
        return CAMERA.project(np.where(camera_points[:, 2:] > 0.1, camera_points, 1.0))

    def frames(self, poses, *, later=None, readout=0.0):
        """FrameExtrema of every pose.

        later(t): the pose after t frames, where the readout takes that share of the interval.
        """
        generator = np.random.default_rng(self.seed + 1)
        track_of = np.full(len(self.points), -1, np.int64)
        born = np.zeros(len(self.points), np.int32)
        next_id = 0
        for frame, T_world_camera in enumerate(poses):
            camera_points = transform(inverse(T_world_camera), self.points)
            px = self._px(T_world_camera)
            if readout:
                # Quadratic in the time since the middle row, which depends on the row again.
                before, after = (self._px(later(frame + 0.5 * side)) for side in (-1, 1))
                slope, bend = after - before, 2.0 * (after + before - 2.0 * px)
                middle = px
                for _ in range(5):
                    row = np.clip(px[:, 1:], 0.0, CAMERA.height - 1.0)
                    t = readout * (row - 0.5 * (CAMERA.height - 1)) / CAMERA.height
                    px = middle + t * slope + t * t * bend
            px += generator.normal(0.0, self.noise_px, px.shape)
            inside = (camera_points[:, 2] > 0.1) & (px > 10).all(axis=1)
            inside &= (px < (CAMERA.width - 10, CAMERA.height - 10)).all(axis=1)
            lost = generator.random(len(px)) < self.death
            track_of[~inside | lost] = -1
            new = np.flatnonzero(inside & ~lost & (track_of < 0))
            track_of[new] = next_id + np.arange(len(new))
            born[new] = frame
            next_id += len(new)
            alive = np.flatnonzero(track_of >= 0)
            alive = alive[np.argsort(track_of[alive])]
            yield FrameExtrema(
                ids=track_of[alive].copy(),
                points_px=px[alive].astype(np.float32),
                ages=(frame - born[alive]).astype(np.int32),
                kappas=self.kappas[alive],
                states=np.zeros(len(alive), np.uint8),
                maxima=np.column_stack([px[inside], self.kappas[inside]]).astype(np.float32),
                dominant_flow=np.eye(2, 3),
            )
