"""The map of the last seconds of a scene that deforms, and what surfels take from it."""

from itertools import pairwise

import numpy as np
import pytest
from breathing_truth import CAMERA, rigid_map, tracks, write_truth
from surfel_scene import STEP_S, board_renderer

from pliant.algorithms.arrays import F64
from pliant.algorithms.deformable.deforming_window import DeformingWindow
from pliant.algorithms.deformable.moving_landmarks import WindowMap
from pliant.algorithms.geometry import inverse, pose_to_matrix, so3_exp, transform
from pliant.algorithms.slam.calibration.corrected_view import corrected_view
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker
from pliant.algorithms.surfels.window_follower import WindowFollower
from pliant.evaluation.surface_truth import SurfaceTruth
from pliant.messages import codec
from pliant.messages.types import WORLD_FRAME_ID, DeformingLandmarks, Header
from pliant.state import load_state, save_state

STEP_NS = 100_000_000
VIEW = corrected_view(CAMERA, ())


@pytest.fixture(scope="module")
def truth(tmp_path_factory: pytest.TempPathFactory) -> SurfaceTruth:
    return write_truth(tmp_path_factory.mktemp("truth"))


def windows(
    truth: SurfaceTruth, *, rigid: bool = False, still: bool = False, saved: bool = False
) -> list[WindowMap]:
    """saved: the state goes through bytes after each frame."""
    placed = rigid_map(truth).final()
    poses = {frame: pose_to_matrix(pose[None])[0] for frame, (_, pose) in placed.items()}
    window, out = DeformingWindow(), list[WindowMap]()
    for frame, ids, pixels in tracks(truth, rigid=rigid, still=still):
        points_px = pixels.astype(np.float32)
        T = window.follow(ids, points_px, VIEW)
        if window.take(frame, frame * STEP_NS, ids, points_px, T):
            out.append(window.adjust(poses, VIEW))
        if saved:
            window = load_state(save_state(window))
    return out


@pytest.fixture(scope="module")
def found(truth: SurfaceTruth) -> list[WindowMap]:
    return windows(truth)


def ratios(truth: SurfaceTruth, found: WindowMap) -> F64:
    """Metres by a unit of the window, for each landmark in view."""
    rows, frame = found.in_view, int(found.frames[-1])
    points = truth.at_pixels(frame, found.points_px[rows].astype(np.float64))
    exact = transform(inverse(truth.T_world_camera[frame]), truth.positions(points, frame))
    there = (found.rest + found.moved()[-1])[rows]
    depths = transform(inverse(found.T_world_camera[-1]), there)[:, 2]
    of_each = exact[:, 2] / depths
    return of_each[np.isfinite(of_each)]


def test_each_second_has_a_map_of_the_last_three(
    truth: SurfaceTruth, found: list[WindowMap]
) -> None:
    assert [each.problem for each in found] == [""] * 7
    assert [int(each.frames[-1]) for each in found] == [10, 20, 30, 40, 50, 60, 70]
    assert [len(each.frames) for each in found] == [6, 11] + [15] * 5
    for each in found:
        of_each = ratios(truth, each)
        assert len(of_each) > 300
        assert np.std(of_each / np.median(of_each)) < 0.01


def test_windows_continue_each_other(truth: SurfaceTruth, found: list[WindowMap]) -> None:
    """In one unit, and one world: a camera of both is the same, and moves as it did."""
    units = [float(np.median(ratios(truth, each))) for each in found]
    np.testing.assert_allclose(units, np.median(units), rtol=0.01)
    for before, after in pairwise(found):
        first = after.frames.tolist().index(int(before.frames[-1]))
        rotation = after.T_world_camera[first, :3, :3].T @ before.T_world_camera[-1, :3, :3]
        assert np.trace(rotation) > 3.0 - 0.02**2
        motion = inverse(after.T_world_camera[first]) @ after.T_world_camera[-1]
        exact = truth.T_world_camera[after.frames[[first, -1]]]
        error = units[0] * motion[:3, 3] - (inverse(exact[0]) @ exact[1])[:3, 3]
        assert np.linalg.norm(error) < 0.01 * units[0] * np.median(np.abs(after.rest[:, 2]))


def test_until_the_next_window_each_frame_is_placed_by_the_last(truth: SurfaceTruth) -> None:
    """The surface breathes on, so its displacements are those of each frame."""
    poses = {f: pose_to_matrix(p[None])[0] for f, (_, p) in rigid_map(truth).final().items()}
    window, errors = DeformingWindow(), list[float]()
    start, there, unit = -1, np.eye(4), 1.0
    for frame, ids, pixels in tracks(truth):
        points_px = pixels.astype(np.float32)
        here = window.follow(ids, points_px, VIEW)
        assert (here is None) == (start < 0)
        if here is not None:
            exact = (inverse(truth.T_world_camera[start]) @ truth.T_world_camera[frame])[:3, 3]
            errors.append(float(np.linalg.norm(unit * (inverse(there) @ here)[:3, 3] - exact)))
        if window.take(frame, frame * STEP_NS, ids, points_px, here):
            found = window.adjust(poses, VIEW)
            start, there = frame, found.T_world_camera[-1]
            unit = float(np.median(ratios(truth, found)))
    assert len(errors) == 69
    assert np.sqrt(np.mean(np.square(errors))) < 0.007 * 0.6  # 0.6 m away
    # Other tracks say nothing.
    assert window.follow(np.arange(5000, 6000), np.zeros((1000, 2), np.float32), VIEW) is None


def test_the_first_window_has_the_keyframes_of_the_rigid_map(truth: SurfaceTruth) -> None:
    """Surfels start on one of them."""
    poses = {f: pose_to_matrix(p[None])[0] for f, (_, p) in rigid_map(truth).final().items()}
    window, found = DeformingWindow(), list[WindowMap]()
    for frame, ids, pixels in tracks(truth)[:25]:
        points_px = pixels.astype(np.float32)
        if window.take(frame, frame * STEP_NS, ids, points_px, of_map=frame in (3, 13)):
            found.append(window.adjust(poses, VIEW))
    first, second = found
    assert first.between.tolist() == [3]
    assert not len(second.between)
    unit = float(np.median(ratios(truth, first)))
    motion = inverse(first.T_world_camera[0]) @ first.T_between[0]
    exact = inverse(truth.T_world_camera[0]) @ truth.T_world_camera[3]
    assert np.linalg.norm(unit * motion[:3, 3] - exact[:3, 3]) < 0.01 * 0.6


def test_a_scene_that_is_rigid_or_a_camera_that_is_still_has_none(truth: SurfaceTruth) -> None:
    for each in windows(truth, rigid=True):
        assert each.problem == "a rigid map predicts its tracks as well, or nearly so"
        assert not len(each.ids)
    for each in windows(truth, still=True):
        assert each.problem
        assert not len(each.frames)


def test_the_same_from_a_saved_state_and_as_a_message(
    truth: SurfaceTruth, found: list[WindowMap]
) -> None:
    header = Header(frame=0, stamp_ns=0, frame_id=WORLD_FRAME_ID)

    def encoded(each: WindowMap) -> bytes:
        return codec.encode(DeformingLandmarks.of(header, each))

    assert [encoded(e) for e in windows(truth, saved=True)] == [encoded(e) for e in found]
    again = codec.decode(DeformingLandmarks, encoded(found[0]))
    np.testing.assert_array_equal(again.moved(), found[0].moved())


def test_frames_that_the_rigid_map_lost_are_left_out(truth: SurfaceTruth) -> None:
    placed = rigid_map(truth).final()
    poses = {f: pose_to_matrix(p[None])[0] for f, (_, p) in placed.items() if f % 4 == 0}
    window = DeformingWindow()
    for frame, ids, pixels in tracks(truth):
        if window.take(frame, frame * STEP_NS, ids, pixels.astype(np.float32)):
            each = window.adjust(poses, VIEW)
            if frame not in poses:
                assert each.problem == "the rigid map has lost the camera"
            assert all(f in poses for f in each.frames.tolist())


def test_surfels_follow_a_window_in_its_unit() -> None:
    """A board that is rigid: what a window says of it moves camera and surfels, and no pixel."""
    motions = [np.eye(4), np.eye(4)]
    motions[1][0, 3] = 0.02
    renderer, camera = board_renderer(motions)
    images = [renderer.frame(n, float(n)).image for n in range(2)]
    depth = renderer.frame(0, 0.0).depth_m
    tracker = SurfelTracker(SurfelParameters(camera="moving", max_surfels=60))
    follower = WindowFollower()
    first = tracker.start(images[0], depth, camera)
    follower.note(0, 0, first)
    second = tracker.track(images[1], STEP_S)
    # The same scene in units of 2 m; the camera has turned and is elsewhere, some of it has moved.
    there = transform(inverse(second.T_world_camera), second.positions)
    T = np.stack([np.eye(4), np.eye(4)])
    T[1, :3, :3], T[1, :3, 3] = so3_exp(np.array([0.0, 0.01, 0.0])), (0.02, 0.0, 0.0)
    some = (there[:, 0] > np.quantile(there[:, 0], 0.8)).astype(np.float64)
    displacements = np.zeros((2, 2, 3))
    displacements[:, 1, 2] = (-0.01, 0.01)
    newest = transform(T[1], 0.5 * there)
    weights = np.stack([1.0 - some, some, 0.0 * some, 0.0 * some], axis=1)
    window = WindowMap(
        frames=np.array([0, 1]),
        T_world_camera=T,
        ids=np.arange(len(there)),
        points_px=second.points_px.astype(np.float32),
        rest=newest - some[:, None] * (0.0, 0.0, 0.01),
        displacements=displacements,
        carriers=np.tile(np.arange(4) % 2, (len(there), 1)),
        weights=weights,
    )
    assert follower.judge(window)
    ratio = follower.place(tracker, second, window)
    assert ratio == pytest.approx(2.0, rel=0.01)
    placed = first.T_world_camera @ T[1]
    placed[:3, 3] = ratio * T[1, :3, 3]
    added = tracker.add(images[1], np.zeros_like(depth))
    np.testing.assert_allclose(added.T_world_camera, placed, atol=1e-9)
    np.testing.assert_allclose(added.points_px, second.points_px, atol=1e-3)
    # So is the camera of a frame between two windows.
    assert follower.camera(2, WindowMap()) is None
    between = follower.camera(2, WindowMap(T_frame=T[1:]))
    assert between is not None
    np.testing.assert_allclose(between, placed, atol=1e-9)
    # The same image again: what is stiff keeps the camera where it is.
    again = tracker.track(images[1], STEP_S)
    np.testing.assert_array_equal(again.ids, second.ids)
    np.testing.assert_allclose(again.T_world_camera[:3, 3], placed[:3, 3], atol=3e-3)
    assert not follower.judge(WindowMap(problem="it is wrong"))
    assert not follower.deforms


def test_windows_that_continue_each_other_keep_the_world_of_the_surfels() -> None:
    """The newest camera of a window is its least certain: the next one must not be laid on it."""
    motions = [np.eye(4), np.eye(4)]
    renderer, camera = board_renderer(motions)
    image, depth = renderer.frame(0, 0.0).image, renderer.frame(0, 0.0).depth_m
    tracker = SurfelTracker(SurfelParameters(camera="moving", max_surfels=60))
    follower, cameras = WindowFollower(), np.tile(np.eye(4), (4, 1, 1))
    follower.note(0, 0, tracker.start(image, depth, camera))
    for frame in (1, 2, 3):
        surfels = tracker.track(image, STEP_S)
        follower.note(frame, int(1e9 * frame * STEP_S), surfels)
        if frame == 1:
            continue
        # Frame 2 is 0.03 off at first; the next window knows better.
        cameras[2, 0, 3] = 0.03 if frame == 2 else 0.0
        T = cameras[: frame + 1]
        there = transform(inverse(surfels.T_world_camera), surfels.positions)
        count = len(there)
        window = WindowMap(
            frames=np.arange(frame + 1),
            T_world_camera=T.copy(),
            ids=np.arange(count),
            points_px=surfels.points_px.astype(np.float32),
            rest=transform(T[-1], there),
            displacements=np.zeros((frame + 1, 1, 3)),
            carriers=np.zeros((count, 4), np.int64),
            weights=np.full((count, 4), 0.25),
        )
        assert follower.judge(window)
        follower.place(tracker, surfels, window)
    found = tracker.add(image, np.zeros_like(depth))
    np.testing.assert_allclose(found.T_world_camera, np.eye(4), atol=1e-3)
