"""A breathing surface before a camera that travels: its tracks, and a rigid map of it."""

from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, matrix_to_pose, so3_exp, transform
from pliant.evaluation.surface_truth import MaterialPoints, SurfaceTruth
from pliant.formats.tum import write_tum
from pliant.map_history import FramePose, Keyframe, MapHistory
from pliant.rendering.deforming_scenes import BreathingOptions, deforming_scene
from pliant.trajectory import Trajectory

CAMERA = PinholeCamera(width=640, height=480, fx=525.0, fy=525.0, cx=319.5, cy=239.5)
FRAMES, FPS = 80, 10
STILL = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0])


def write_truth(folder: Path) -> SurfaceTruth:
    """The scene without images."""
    scene = deforming_scene("breathing", BreathingOptions(seconds=8.0, travel=0.25))
    times = np.arange(FRAMES) / FPS
    vertices = np.array([scene.sheets[0].shape(time) for time in times], np.float32)
    np.savez(folder / "surfaces.npz", names=np.array(["surface"]), vertices_0=vertices)
    T = np.array([scene.path.T_world_camera(time) for time in times])
    stamps = np.arange(FRAMES, dtype=np.int64) * (1_000_000_000 // FPS)
    write_tum(folder / "groundtruth.txt", Trajectory(stamps_ns=stamps, T_world_camera=T))
    return SurfaceTruth(folder, CAMERA)


def tracks(
    truth: SurfaceTruth, *, rigid: bool = False, still: bool = False
) -> list[tuple[int, I64, F64]]:
    """Material points in view, to a fifth of a pixel.

    rigid: those of the first frame.    still: as the first camera sees them.
    """
    rng = np.random.default_rng(8)
    where = rng.uniform((20.0, 20.0), (130.0, 100.0), (1500, 2))
    points = MaterialPoints(np.zeros(len(where), np.int32), where)
    out: list[tuple[int, I64, F64]] = []
    for frame in range(len(truth)):
        shape = truth.positions(points, 0 if rigid else frame)
        seen = transform(inverse(truth.T_world_camera[0 if still else frame]), shape)
        pixels = CAMERA.project(seen) + 0.2 * rng.standard_normal((len(seen), 2))
        inside = ((pixels > 0.0) & (pixels < (639.0, 479.0))).all(axis=1)
        out.append((frame, np.flatnonzero(inside), pixels[inside]))
    return out


def rigid_map(truth: SurfaceTruth) -> MapHistory:
    """Poses of a map in units of its own: some millimetres and half a degree off."""
    rng = np.random.default_rng(9)
    history = MapHistory()
    for frame, T_true in enumerate(truth.T_world_camera):
        T = inverse(truth.T_world_camera[0]) @ T_true
        T[:3, 3] = 1.7 * (T[:3, 3] + 0.004 * rng.standard_normal(3))
        T[:3, :3] = T[:3, :3] @ so3_exp(0.008 * rng.standard_normal(3))
        history.keyframes[frame] = Keyframe(frame, 0, matrix_to_pose(T))
        history.frames[frame] = FramePose(0, frame, STILL, 100)
        history.stamps_ns[frame] = frame * 1_000_000_000 // FPS
    return history
