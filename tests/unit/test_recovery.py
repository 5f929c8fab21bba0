"""A camera that was covered, or in the dark, goes on in its map as soon as it sees it again."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
from mapped_scene import Published, trajectory_error
from mapping_scene import CAMERA, INTERVAL_NS, Scene, looking, sideways
from pictured_scene import _SIDE, dark, picture, textures

from pliant.algorithms.arrays import U8
from pliant.algorithms.geometry import inverse, so3_exp
from pliant.algorithms.inertial.gyro import GyroTurn
from pliant.algorithms.map_delta import LOST, TRACKING
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.locate.landmark_search import MAX_RADIUS_SHARE, search_radius_px
from pliant.algorithms.slam.locate.localisation import Motion
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.tracks import FrameExtrema


def covered(tracks: FrameExtrema) -> tuple[FrameExtrema, U8]:
    """Something else, full of texture, and no track of before."""
    generator = np.random.default_rng(len(tracks.ids))
    noise = generator.uniform(0, 255, (CAMERA.height, CAMERA.width)).astype(np.float32)
    n = 4000
    places = generator.uniform((10, 10), (CAMERA.width - 10, CAMERA.height - 10), (n, 2))
    maxima = np.column_stack([places, generator.uniform(5.0, 500.0, n)]).astype(np.float32)
    seen = FrameExtrema(
        ids=10_000_000 + np.arange(n), points_px=maxima[:, :2].copy(), ages=np.zeros(n, np.int32),
        kappas=maxima[:, 2].copy(), states=np.zeros(n, np.uint8), maxima=maxima,
        dominant_flow=np.eye(2, 3),
    )  # fmt: skip
    return seen, cv2.GaussianBlur(noise, (0, 0), 1.2).astype(np.uint8)


def anew(tracks: FrameExtrema) -> FrameExtrema:
    """The same tracks as others: a tracker ends all of them in a frame that shows nothing."""
    kept = {name: getattr(tracks, name) for name in vars(tracks)}
    return FrameExtrema(**{**kept, "ids": tracks.ids + 1_000_000})


@pytest.fixture(scope="module")
def seen():
    """A scene, the camera's poses, and what it sees."""
    scene, poses = Scene.box(500, noise_px=0.1), sideways(36, step=0.04)
    squares = textures(len(scene.points))
    return scene, poses, [picture(scene, squares, T) for T in poses], list(scene.frames(poses))


@pytest.mark.parametrize("spoil", [dark, covered])
@pytest.mark.parametrize("count", [1, 3, 10])
def test_the_map_continues_after_frames_that_show_nothing_of_it(seen, spoil, count):
    _, poses, images, frames = seen
    mapper, published = Mapper(CAMERA, MappingParameters(), 0), Published()
    blind = range(20, 20 + count)
    for k, (tracks, grey) in enumerate(zip(frames, images, strict=True)):
        now = spoil(tracks) if k in blind else (anew(tracks) if k > blind[0] else tracks, grey)
        published.apply(mapper.process(Frame(k, k * INTERVAL_NS, now[0], now[1])))
    published.apply(mapper.finish())
    assert [k for k, state in enumerate(published.states) if state == LOST] == list(blind)
    assert set(range(len(poses))) - set(published.poses) == set(blind)
    assert {segment for _, _, segment in published.poses.values()} == {0}
    error, _ = trajectory_error(published, poses)
    assert error < 2e-3


def test_another_place_is_not_taken_for_the_map(seen):
    """A long loss: then the frames that were kept meanwhile are those of another map."""
    _, poses, images, frames = seen
    elsewhere = Scene.box(500, seed=9, noise_px=0.1)
    squares = textures(len(elsewhere.points))[::-1]
    mapper, published = Mapper(CAMERA, MappingParameters(), 0), Published()
    for k in range(22):
        published.apply(mapper.process(Frame(k, k * INTERVAL_NS, frames[k], images[k])))
    after = list(elsewhere.frames(poses))
    for k, tracks in enumerate(after):
        grey = picture(elsewhere, squares, poses[k])
        delta = mapper.process(Frame(22 + k, (22 + k) * INTERVAL_NS, anew(tracks), grey))
        published.apply(delta)
    segments = [segment for _, (_, _, segment) in sorted(published.poses.items())]
    assert segments == [0] * 22 + [1] * len(after)
    assert published.states[22] == LOST
    assert published.states[-1] == TRACKING


@pytest.mark.parametrize(("every", "state"), [(1, TRACKING), (6, LOST)])
def test_the_map_does_not_resume_with_fewer_points_than_it_starts_with(seen, every, state):
    """Of some 300 points in view all or a sixth are to be seen after the dark."""
    scene, poses, images, frames = seen
    flat, limits = np.full((_SIDE, _SIDE), 120, np.float32), MappingParameters()
    kept = [each if i % every == 0 else flat for i, each in enumerate(textures(500))]
    mapper = Mapper(CAMERA, limits, 0)
    for k in range(20):
        mapper.process(Frame(k, k * INTERVAL_NS, frames[k], images[k]))
    assert mapper.process(Frame(20, 20 * INTERVAL_NS, *dark(frames[20]))).state == LOST
    grey = picture(scene, kept, poses[21])
    found = mapper.process(Frame(21, 21 * INTERVAL_NS, anew(frames[21]), grey))
    assert found.state == state
    assert every > 1 or found.inliers >= limits.start.min_points


def test_a_few_tracks_that_a_cut_has_left_place_no_camera():
    """Forty of hundreds agree on a pose: only where the image proves it the camera is there."""
    scene, poses = Scene.box(2500, noise_px=0.1), sideways(20, step=0.04)
    squares = textures(len(scene.points))
    there = poses[-1] @ looking((0.4, 0.1, 0.0), (0.1, -0.2, 0.0))
    *frames, last = scene.frames([*poses, there])
    few = np.flatnonzero(np.isin(last.ids, frames[-1].ids))[::12][:40]
    cut = {name: getattr(last, name)[few] for name in ("ids", "points_px", "ages", "kappas")}
    cut = replace(last, **cut, states=last.states[few])
    after = {
        "what the pose shows": (cut, picture(scene, squares, there)),
        "something else": (replace(cut, maxima=covered(cut)[0].maxima), covered(cut)[1]),
    }
    seen = {}
    for what, shot in after.items():
        mapper, published = Mapper(CAMERA, MappingParameters(), 0), Published()
        for k, tracks in enumerate(frames):
            grey = picture(scene, squares, poses[k])
            published.apply(mapper.process(Frame(k, k * INTERVAL_NS, tracks, grey)))
        published.apply(mapper.process(Frame(len(frames), len(frames) * INTERVAL_NS, *shot)))
        seen[what] = published
    assert seen["something else"].states[-1] == LOST
    assert len(frames) not in seen["something else"].poses
    assert seen["what the pose shows"].states[-1] == TRACKING
    error, _ = trajectory_error(seen["what the pose shows"], [*poses, there])
    assert error < 3e-3


def test_time_not_frames_decides_how_far_the_camera_has_gone():
    first, second = looking((0.0, 0.0, 0.0)), looking((0.1, 0.0, 0.0), (0.0, 0.02, 0.0))
    motion = Motion(frames=(0, 1), stamps_ns=(0, INTERVAL_NS), poses=(first, second))
    moved, still = motion.predictions(4 * INTERVAL_NS)
    expected = np.linalg.matrix_power(inverse(first) @ second, 4)
    np.testing.assert_allclose(moved[:3, :3], expected[:3, :3], atol=1e-12)
    np.testing.assert_allclose(moved[:3, 3], [0.4, 0.0, 0.0], atol=0.02)
    np.testing.assert_array_equal(still, second)
    at_once = Motion(frames=(1, 1), stamps_ns=(5, 5), poses=(first, first))
    assert len(at_once.predictions(9)) == 1


def test_the_search_grows_with_the_time_without_a_pose_and_has_an_end():
    radii = [search_radius_px(s, CAMERA) for s in (0.03, 0.3, 100.0)]
    assert 0.0 < radii[0] < radii[1] < radii[2]
    assert radii[2] == MAX_RADIUS_SHARE * CAMERA.width


def test_predictions_and_their_prior_have_the_rotation_of_the_gyro():
    first, second = looking((0.0, 0.0, 0.0)), looking((0.1, 0.0, 0.0), (0.0, 0.05, 0.0))
    turn = GyroTurn(R=so3_exp(np.array([0.3, 0.0, 0.0])), covariance=1e-6 * np.eye(3))
    motion = Motion(frames=(0, 1), stamps_ns=(0, INTERVAL_NS), poses=(first, second), turn=turn)
    going, standing = motion.predictions(2 * INTERVAL_NS)
    for each in (going, standing):
        np.testing.assert_allclose(each[:3, :3], second[:3, :3] @ turn.R, atol=1e-12)
    assert np.linalg.norm(going[:3, 3] - second[:3, 3]) == pytest.approx(0.1)
    np.testing.assert_array_equal(standing[:3, 3], second[:3, 3])
    prior = motion.prior(CAMERA)
    assert prior.unless_contradicted(standing) is prior
    assert prior.unless_contradicted(second) is not prior
    assert not motion.then(2, 2 * INTERVAL_NS, going).prior(CAMERA).information.any()
