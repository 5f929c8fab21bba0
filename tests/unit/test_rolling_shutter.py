"""Rolling shutter: the motion at a keyframe, and what it does to observations."""

import numpy as np
import pytest

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, so3_exp
from pliant.algorithms.mapping.map_store import Keyframe
from pliant.algorithms.mapping.rolling_shutter import Path, readout_flow

CAMERA = PinholeCamera(width=640, height=480, fx=500.0, fy=520.0, cx=320.0, cy=240.0)
OMEGA, NU = np.array([0.01, -0.02, 0.015]), np.array([0.03, -0.01, 0.02])


def pose(t):
    """T_world_camera after t frames of a motion whose (omega, nu) at t = 0 is (OMEGA, NU)."""
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3] = so3_exp(t * OMEGA)
    T_camera_world[:3, 3] = t * NU
    return inverse(T_camera_world)


def keyframe(number, T_world_camera):
    none = np.zeros(0, np.int32)
    return Keyframe(
        id=number, frame=10 * number, segment=0, T_world_camera=T_world_camera, rows=none,
        points_px=np.zeros((0, 2), np.float32),
    )  # fmt: skip


def test_the_motion_is_that_of_the_frames_around():
    path = Path()
    middle = keyframe(1, pose(0.0))
    for t in (-2, -1, 0, 1, 2):
        path.add(10 + t, middle, pose(t))
    # The keyframe is corrected: what hangs on it moves along, the motion stays.
    shift = np.eye(4)
    shift[:3, :3], shift[:3, 3] = so3_exp(np.array([0.3, 0.1, -0.2])), [1.0, 2.0, 3.0]
    middle.T_world_camera = shift @ middle.T_world_camera
    motion = path.motions([middle, keyframe(7, pose(0.0))])
    np.testing.assert_allclose(motion[0], [*OMEGA, *NU], rtol=1e-3)
    assert not motion[1].any()  # no frame is known there


def test_poses_on_keyframes_of_another_segment_are_passed_over():
    path = Path()
    for t in (-1, 0, 1):
        path.add(10 + t, keyframe(3, pose(0.0)), pose(t))
    assert not path.motions([keyframe(1, pose(0.0))]).any()


@pytest.mark.parametrize("t", [0.0, 0.4])
def test_the_flow_is_what_the_readout_does_to_the_projection(t):
    rng = np.random.default_rng(0)
    world = rng.uniform((-1.5, -1.0, 3.0), (1.5, 1.0, 6.0), (50, 3))

    def px(T_world_camera):
        return CAMERA.project((world - T_world_camera[:3, 3]) @ T_world_camera[:3, :3])

    observed = px(pose(t)).astype(np.float32)
    world[7] = [0.0, 0.0, -3.0]  # behind
    motion = np.concatenate([OMEGA, NU - t * np.cross(OMEGA, NU)])
    number, camera = np.arange(50, dtype=np.int32), np.zeros(50, np.int32)
    flow = readout_flow(pose(t)[None], motion[None], world, camera, number, observed, CAMERA)
    step = 1e-4
    velocity = (px(pose(t + step)) - px(pose(t - step))) / (2.0 * step)
    share = (observed[:, 1].astype(np.float64) - 239.5) / 480.0
    expected = share[:, None] * velocity
    expected[7] = 0.0
    np.testing.assert_allclose(flow, expected, rtol=1e-3, atol=1e-3)
