"""Rolling shutter: the motion at a keyframe, and what it does to observations."""

import mapping_scene
import numpy as np
import pytest
from mapping_scene import INTERVAL_NS, Scene, looking

from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import align_umeyama, inverse, so3_exp
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView
from pliant.algorithms.slam.calibration.rolling_shutter import FramePoses, RolledFrame, readout_flow
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.estimate.problem import CalibrationUncertainty
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.locate.localisation import Motion
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.start.start import with_minimum_parallax
from pliant.map_history import MapHistory

CAMERA = PinholeCamera(width=640, height=480, fx=500.0, fy=520.0, cx=320.0, cy=240.0)
VIEW = CorrectedView(CAMERA, ())
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
        points_px=np.zeros((0, 2), np.float32), rolled_px=np.zeros((0, 2), np.float32),
    )  # fmt: skip


def test_the_motion_of_an_earlier_session_scales_with_the_map():
    path = FramePoses({3: np.concatenate([OMEGA, NU])})
    known, unknown = keyframe(3, np.eye(4)), keyframe(4, np.eye(4))
    np.testing.assert_array_equal(path.motions([known])[0], [*OMEGA, *NU])
    assert not path.motions([unknown]).any()
    moves = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0]])
    path.scale(MapMoves(keyframe_ids=np.array([0], np.int64), moves=moves))
    np.testing.assert_allclose(path.motions([known])[0], [*OMEGA, *2.0 * NU])


def test_the_motion_is_that_of_the_frames_around():
    path = FramePoses()
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


def test_the_information_of_a_pose_scales_with_the_map():
    path, host = FramePoses(), keyframe(0, pose(0.0))
    path.add(10, host, pose(0.0), 50)
    path.add(11, host, pose(1.0), 60)
    path.add(12, keyframe(5, pose(0.0)), pose(2.0), 70)
    path.refine(11, host, pose(1.1), 65, np.ones((6, 6)))
    path.refine(13, host, pose(3.0), 80, np.ones((6, 6)))  # of no segment
    moves = np.array([[0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 2.0]])
    path.scale(MapMoves(keyframe_ids=np.array([0], np.int64), moves=moves))
    frames, T_world_camera, information = path.frames_on([host])
    assert [(each.frame, each.inliers) for each in frames] == [(10, 50), (11, 65)]
    np.testing.assert_allclose(T_world_camera[1, :3, 3], 2.0 * pose(1.1)[:3, 3])
    assert np.isnan(information[0]).all()
    np.testing.assert_allclose(np.diag(information[1]), [0.25, 0.25, 0.25, 1.0, 1.0, 1.0])
    np.testing.assert_allclose(information[1][0, 3:], 0.5)


def test_poses_on_keyframes_of_another_segment_are_passed_over():
    path = FramePoses()
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


def taken_at_once(world):
    """(q, p) of points (N, 3): where pose(0.0) shows them, and where a readout of READOUT does."""

    def px(t, X):
        T = pose(t)
        return CAMERA.project((X - T[:3, 3])[None] @ T[:3, :3])[0]

    q = np.array([px(0.0, X) for X in world])
    p = q.copy()
    for _ in range(20):
        times = READOUT * (p[:, 1] - 239.5) / 480.0
        p = np.array([px(t, X) for t, X in zip(times, world, strict=True)])
    return q.astype(np.float32), p.astype(np.float32)


READOUT = 0.7
MOTION = np.array([*OMEGA, *NU])


def test_what_a_readout_has_moved_is_moved_back():
    rng = np.random.default_rng(1)
    world = rng.uniform((-1.5, -1.0, 3.0), (1.5, 1.0, 6.0), (200, 3))
    q, p = taken_at_once(world)
    rolled = RolledFrame(VIEW, READOUT, MOTION, 0.25)
    error = np.linalg.norm(p - rolled.shifts(p, 1.0 / world[:, 2]) - q, axis=1)
    assert np.linalg.norm(p - q, axis=1).max() > 2.5
    assert error.max() < 0.03  # the motion is taken as straight
    # Found in an image of a common depth, and then put where its own depth puts it.
    common = p - rolled.shifts(p)
    points_px, shifts = rolled.found(common, 1.0 / world[:, 2])
    assert np.linalg.norm(points_px - q, axis=1).max() < 0.03
    np.testing.assert_allclose(points_px + shifts, p, atol=0.01)


def test_an_upright_image_is_read_out_across():
    """A camera and a world with x and y in turned places, which also mirrors them."""
    upright = PinholeCamera(width=480, height=640, fx=520.0, fy=500.0, cx=240.0, cy=320.0)
    rng, swapped = np.random.default_rng(2), np.array([1, 0, 2])
    world = rng.uniform((-1.5, -1.0, 3.0), (1.5, 1.0, 6.0), (50, 3))
    turned = np.concatenate([-OMEGA[swapped], NU[swapped]])
    px = CAMERA.project(world).astype(np.float32)
    other_px = np.ascontiguousarray(px[:, ::-1])
    number, camera = np.arange(50, dtype=np.int32), np.zeros(50, np.int32)
    at = np.eye(4)[None], camera, number
    flow = readout_flow(at[0], MOTION[None], world, *at[1:], px, CAMERA)
    other = readout_flow(at[0], turned[None], world[:, swapped], *at[1:], other_px, upright)
    np.testing.assert_allclose(other, flow[:, ::-1], atol=1e-4)
    shifts = RolledFrame(VIEW, READOUT, MOTION, 0.25).shifts(px)
    other = RolledFrame(CorrectedView(upright, ()), READOUT, turned, 0.25)
    np.testing.assert_allclose(other.shifts(other_px), shifts[:, ::-1], atol=1e-4)
    image = rng.integers(0, 255, (480, 640), np.uint8)
    at_once = RolledFrame(VIEW, READOUT, MOTION, 0.25).image(image)
    swapped_image = other.image(np.ascontiguousarray(image.T)).T
    assert np.abs(swapped_image.astype(int) - at_once).max() <= 1


def test_an_image_is_as_if_taken_at_once():
    rolled = RolledFrame(VIEW, READOUT, MOTION, 0.25)
    u, v = np.meshgrid(np.arange(640.0), np.arange(480.0))
    for seen in np.array([[100.3, 40.8], [320.0, 239.5], [560.7, 420.2]], np.float32):
        blob = 250.0 * np.exp(-((u - seen[0]) ** 2 + (v - seen[1]) ** 2) / 18.0)
        image = rolled.image(np.round(blob).astype(np.uint8)).astype(np.float64)
        centre = np.array([(image * u).sum(), (image * v).sum()]) / image.sum()
        np.testing.assert_allclose(centre, seen - rolled.shifts(seen[None])[0], atol=0.1)


def test_a_motion_continues_to_change_as_before():
    frames, poses = (3, 4), (pose(-2.0), pose(-1.0))
    steady = Motion(frames=frames, stamps_ns=(0, 1), poses=poses)
    np.testing.assert_allclose(steady.velocity_at(5, pose(0.0)), MOTION, rtol=0.05, atol=1e-3)
    faster = Motion(frames=frames, stamps_ns=(0, 1), poses=(pose(-1.0), pose(-1.0)))
    assert np.linalg.norm(faster.velocity_at(5, pose(0.0))) > 1.2 * np.linalg.norm(MOTION)


class Shaken:
    """A hand-held camera that slides along a box of points, with this readout."""

    def __init__(self, readout):
        self.readout = readout
        self.poses = [self.at(k) for k in range(100)]

    def at(self, t):
        shake = np.array([np.sin(0.3 * t), np.cos(0.25 * t), 0.6 * np.sin(0.2 * t)])
        position = (0.04 * t, 0.0, 0.0) + 0.1 * shake
        return looking(position, (0.04 * np.sin(0.27 * t), 0.04 * np.cos(0.2 * t), 0.0))

    def mapped(self, *, prior=0.1, known=0.0):
        """The mapper, the history at its end, and the tracks and keyframes of each frame.

        prior: of the readout.   known: the readout that the mapper is told.
        """
        parameters = MappingParameters(calibration=CalibrationUncertainty(readout=prior))
        parameters = with_minimum_parallax(parameters)
        calibration = SelfCalibration.of(mapping_scene.CAMERA, parameters.calibration)
        calibration = calibration.with_readout(known, 1e-3)
        mapper = Mapper(mapping_scene.CAMERA, parameters, 0, calibration)
        history, tracks, keyframes = MapHistory(), [], []
        for frame, some in enumerate(
            Scene.box().frames(self.poses, later=self.at, readout=self.readout)
        ):
            tracks.append(some)
            delta = mapper.process(Frame(frame, frame * INTERVAL_NS, some))
            history.apply(delta, frame=frame, stamp_ns=frame)
            keyframes.append(mapper.publish_keyframes())
        return mapper, history, tracks, keyframes

    def error(self, history, poses):
        """Sim(3) RMSE of the online or final poses."""
        at = history.trajectory(poses).T_world_camera[:, :3, 3]
        true = np.array(self.poses)[sorted(poses), :3, 3]
        scale, R, t = align_umeyama(at, true, with_scale=True)
        return np.sqrt(((scale * at @ R.T + t - true) ** 2).sum(axis=1).mean())


@pytest.fixture(scope="module")
def rolling():
    shaken = Shaken(0.6)
    return shaken, *shaken.mapped()


@pytest.fixture(scope="module")
def straight():
    """As a global shutter has it."""
    shaken = Shaken(0.0)
    return shaken, *shaken.mapped()


@pytest.fixture(scope="module")
def known():
    """The readout was told."""
    shaken = Shaken(0.6)
    return shaken, *shaken.mapped(known=0.6)


def test_the_readout_is_found_and_straightens_the_map(rolling, straight):
    shaken, mapper, history, _, _ = rolling
    assert mapper.calibration.readout == pytest.approx(0.6, abs=0.03)
    final = finished(mapper, history)
    _, _, best, _, _ = straight
    bent, without, _, _ = shaken.mapped(prior=0.0)
    assert shaken.error(history, final) < 0.5 * shaken.error(without, finished(bent, without))
    assert shaken.error(best, best.online) < shaken.error(history, final)
    assert mapper.calibration.readout == pytest.approx(0.6, abs=0.02)


def finished(mapper, history):
    """The final poses."""
    history.apply(mapper.finish(), frame=99, stamp_ns=99, final=True)
    return history.final()


def test_frames_with_a_given_readout_are_as_good_as_global_shutter(known, straight):
    shaken, _, history, _, _ = known
    _, _, best, _, _ = straight
    reached = shaken.error(history, history.online)
    assert reached < 2.0 * shaken.error(best, best.online)  # unknown it would be 13 times


def test_published_pixels_are_the_measured_ones(known):
    _, mapper, _, tracks, keyframes = known
    newest = mapper.atlas.active.keyframes[-1]
    assert np.abs(newest.rolled_px).max() > 0.5
    told = next(delta for delta in reversed(keyframes) if delta.new >= 0)
    seen = tracks[newest.frame].points_px
    told_px = told.points_px[-told.counts[-1] :]
    nearest = np.abs(told_px[:, None] - seen[None]).max(axis=2).min(axis=1)
    assert len(told_px) > 100
    assert np.quantile(nearest, 0.9) < 1e-3


def test_a_global_shutter_stays_one(straight):
    _, mapper, _, _, _ = straight
    assert mapper.calibration.readout == 0.0
    assert not any(keyframe.rolled_px.any() for keyframe in mapper.atlas.active.keyframes)
