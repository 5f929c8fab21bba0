"""Keyframes of a rolling shutter: how they move, and their surface and colours without it."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from map_updates import IDENTITY, nothing

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, matrix_to_pose, so3_exp
from pliant.algorithms.map_delta import TRACKING, KeyframeDelta, MapDelta
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.meshing.parameters import MeshingParameters
from pliant.fusion.keyframe_motions import KeyframeMotions
from pliant.fusion.keyframe_spool import KeyframeSpool
from pliant.fusion.mesher import Mesher
from pliant.map_history import CurrentMap

CAMERA = PinholeCamera(width=160, height=120, fx=130.0, fy=130.0, cx=79.5, cy=59.5)
OMEGA, NU = np.array([0.01, 0.06, -0.02]), np.array([0.02, -0.01, 0.005])
READOUT, DEPTH = 0.9, 2.0


def pose(t: float) -> F64:
    """T_world_camera after t frames."""
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3] = so3_exp(t * OMEGA)
    T_camera_world[:3, 3] = t * NU
    return inverse(T_camera_world)


def told(frames: tuple[int, ...], inliers: int = 100) -> MapDelta:
    """Keyframe 3 at frame 10, on which the frames hang."""
    return replace(
        nothing(TRACKING),
        pose_frames=np.array(frames),
        pose_segments=np.zeros(len(frames), np.int32),
        pose_keyframes=np.full(len(frames), 3),
        poses_keyframe_camera=np.stack([matrix_to_pose(pose(f - 10.0)) for f in frames]),
        pose_inliers=np.full(len(frames), inliers, np.int32),
        keyframe_ids=np.array([3]),
        keyframe_frames=np.array([10]),
        keyframe_segments=np.zeros(1, np.int32),
        keyframe_poses=IDENTITY[None],
    )


def motion(*updates: MapDelta) -> F64 | None:
    current, motions = CurrentMap(), KeyframeMotions()
    for frame, update in enumerate(updates):
        current.take(update, frame)
        motions.take(update)
    return motions.motion(3, current.keyframes)


@pytest.mark.parametrize("frames", [(9, 10, 11), (9, 10), (11,), (4, 9, 10, 11, 12, 30)])
def test_the_motion_is_that_between_the_frames_beside(frames: tuple[int, ...]) -> None:
    found = motion(told(frames))
    assert found is not None
    np.testing.assert_allclose(found, [*OMEGA, *NU], rtol=0.05, atol=1e-3)


def test_there_is_no_motion_without_supported_frames_beside() -> None:
    assert motion(told((8, 10, 12))) is None
    assert motion(told((9, 11), inliers=5)) is None


def test_frames_of_another_segment_do_not_count() -> None:
    """Each segment is a world of its own: a cut after frame 9, of keyframe 2."""
    earlier = replace(
        told((8, 9)), pose_keyframes=np.full(2, 2), keyframe_ids=np.array([2]),
        keyframe_frames=np.array([5]), pose_segments=np.ones(2, np.int32),
        keyframe_segments=np.ones(1, np.int32),
    )  # fmt: skip
    assert motion(earlier, told((10,))) is None
    found = motion(earlier, told((10, 11)))
    assert found is not None
    np.testing.assert_allclose(found, [*OMEGA, *NU], rtol=0.05, atol=1e-3)


def test_the_motion_grows_with_the_map_and_follows_corrected_poses() -> None:
    grown = replace(
        nothing(TRACKING),
        moved_keyframes=np.array([0]),
        moves=np.array([[1.0, 2, 3, 0, 0, 0, 1, 2]]),
    )
    before, after = motion(told((9, 10, 11))), motion(told((9, 10, 11)), grown)
    assert before is not None
    assert after is not None
    np.testing.assert_allclose(after, before * [1, 1, 1, 2, 2, 2], rtol=1e-9)
    still = replace(told((9, 11)), poses_keyframe_camera=np.stack([IDENTITY, IDENTITY]))
    corrected = motion(told((9, 10, 11)), still)
    assert corrected is not None
    assert not corrected.any()


def seen_by_rows(points: F64) -> F32:
    """(N, 2) where points are seen, each by the row that is exposed when it is there."""
    pixels = CAMERA.project(points)
    for _ in range(10):
        times = READOUT * (pixels[:, 1] - 59.5) / 120.0
        there = [inverse(pose(t)) @ [*x, 1.0] for t, x in zip(times, points, strict=True)]
        pixels = CAMERA.project(np.array(there)[:, :3])
    return pixels.astype(np.float32)


def wall() -> F64:
    u, v = np.meshgrid(np.arange(4.0, 158.0, 6.0), np.arange(4.0, 118.0, 6.0))
    rays = CAMERA.normalise(np.stack([u.ravel(), v.ravel()], axis=1))
    return DEPTH * np.concatenate([rays, np.ones((u.size, 1))], axis=1)


def image() -> bytes:
    """A wall, blue beyond x = 0, each row as it is when that is exposed."""
    pixels = np.full((120, 160, 3), (0, 0, 200), np.uint8)
    for v in range(120):
        T = pose(READOUT * (v - 59.5) / 120.0)
        u = np.arange(160.0)
        rays = CAMERA.normalise(np.stack([u, np.full(160, float(v))], axis=1))
        rays = np.concatenate([rays, np.ones((160, 1))], axis=1) @ T[:3, :3].T
        x = T[0, 3] + (DEPTH - T[2, 3]) / rays[:, 2] * rays[:, 0]
        pixels[v, x > 0.0] = (200, 0, 0)
    return bytes(cv2.imencode(".png", pixels)[1])


def meshed(readout: float, frames: tuple[int, ...] = (9, 10, 11)) -> TriangleMesh:
    """The fine mesh of one keyframe's points."""
    points = wall()
    count = len(points)
    update = replace(
        told(frames),
        point_ids=np.arange(count),
        point_segments=np.zeros(count, np.int32),
        points_world=points,
        point_colours=np.zeros((count, 3), np.uint8),
        point_keyframes=np.full(count, 5, np.int32),
        point_parallax_rad=np.full(count, 0.1, np.float32),
        point_sigmas=np.full(count, 0.001, np.float32),
        calibration_correction=(0.0, 0.0, 0.0, readout, 0.0, 0.0, 0.0),
    )
    seen = KeyframeDelta(
        new=3,
        keyframe_ids=np.array([3]),
        settled=np.ones(1, np.bool_),
        counts=np.array([count], np.int32),
        point_ids=np.arange(count),
        points_px=seen_by_rows(points),
    )
    parameters = MeshingParameters(depth="points")
    with KeyframeSpool() as spool:
        mesher = Mesher(CAMERA, parameters, spool)
        mesher.take(update, seen, {3: image()}, 10)
        mesher.fuse()
        return next(iter(mesher.finish())).mesh


def height(mesh: TriangleMesh) -> float:
    return float(np.ptp(mesh.positions[:, 1]))


def test_a_surface_reaches_the_borders_in_spite_of_a_rolling_shutter() -> None:
    whole = float(np.ptp(wall()[:, 1]))
    right, ignored, unknown = meshed(READOUT), meshed(0.0), meshed(READOUT, (8, 10, 12))
    assert height(right) > 0.95 * whole
    # Points seen pixels away from where they should be are wrong ones.
    assert height(ignored) < 0.8 * whole
    assert height(unknown) < 0.8 * whole
    np.testing.assert_allclose(right.positions[:, 2], DEPTH, rtol=2e-3)


def test_colours_are_where_they_were_when_the_middle_row_was_exposed() -> None:
    mesh = meshed(READOUT)
    blue = mesh.colours[:, 2] > mesh.colours[:, 0]
    clear = np.abs(mesh.positions[:, 0]) > 0.5 * DEPTH / CAMERA.fx
    assert clear.mean() > 0.9
    assert (blue == (mesh.positions[:, 0] > 0.0))[clear].mean() > 0.998  # 0.993 where it is ignored
