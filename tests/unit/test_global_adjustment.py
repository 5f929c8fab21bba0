"""Global bundle adjustment: requested, run in parallel, applied, and folded by readers."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from mapped_scene import error_of, similarity
from mapping_scene import CAMERA, Scene, looking

from pliant.algorithms.geometry import (
    align_umeyama,
    inverse,
    matrix_to_pose,
    move_by_similarity,
    similarity_to_matrix,
    so3_exp,
    transform,
)
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.adjust import global_adjustment
from pliant.algorithms.slam.adjust.final_adjustment import _spread_out, adjust_list
from pliant.algorithms.slam.adjust.global_adjustment import find_moves
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.map.landmarks import MAPPED
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import (
    MappingParameters,
    WholeMapParameters,
    WindowParameters,
)
from pliant.algorithms.tracks import FrameExtrema
from pliant.map_history import MapHistory
from pliant.state import load_state, save_state
from pliant_services.nodes.bundle_adjustment import AdjustmentWorker

FRAMES = 150
GROWING = MappingParameters(
    window=WindowParameters(keyframes=6, keyframe_iterations=2),
    whole_map=WholeMapParameters(growth=0.2, distance_frames=7, observations_per_frame=1000),
)
AT_THE_END = GROWING.model_copy(update={"whole_map": WholeMapParameters(growth=0.0)})


def path(frames):
    """A camera that slides along a wall of points."""
    return [looking((0.06 * k, 0.03 * np.sin(0.3 * k), 0.0)) for k in range(frames)]


def fold(parameters, *, frames=FRAMES, camera=CAMERA, poses=None, in_thread=False, killed=False):
    """The mapper, its deltas, and what a reader makes of them.

    in_thread: the result is found in a thread.   killed: the mapper is another one in every frame.
    """
    worker = AdjustmentWorker()
    mapper, history, deltas = Mapper(camera, parameters, 0), MapHistory(), []
    generator = np.random.default_rng(0)
    points = generator.uniform((-4.0, -3.0, 3.0), (14.0, 3.0, 9.0), (1500, 3))
    kappas = generator.uniform(5.0, 500.0, len(points)).astype(np.float32)
    tracks = Scene(points, kappas, death=0.02).frames(poses or path(frames))
    for frame, some in enumerate(tracks):
        if killed and mapper.global_adjustment.job is not None:
            mapper = load_state(save_state(mapper))
        if in_thread:
            worker.start(mapper.global_adjustment)
            worker.hand_over(mapper.global_adjustment, frame)
        deltas.append(mapper.process(Frame(frame, frame * 33_000_000, some)))
        history.apply(deltas[-1], frame=frame, stamp_ns=frame)
    return mapper, deltas, history


@pytest.fixture(scope="module")
def grown():
    return fold(GROWING)


def test_what_is_not_listed_moves_with_what_is_listed_before_it():
    moves = MapMoves(
        keyframe_ids=np.array([3, 5]),
        moves=np.array([similarity(2.0, (0, 0, 0.1), (1, 2, 3)), similarity(0.5, (0, 1, 0), 0)]),
    )
    S = moves.matrices(np.array([0, 3, 4, 5, 9]))
    first, last = similarity_to_matrix(moves.moves)
    np.testing.assert_array_equal(S, [np.eye(4), first, first, last, last])
    moved = moves.points(np.array([[1.0, 0, 0], [1, 0, 0]]), np.array([0, 4]))
    np.testing.assert_allclose(moved[0], (1, 0, 0))
    np.testing.assert_allclose(moved[1], 2 * so3_exp(np.array([0, 0, 0.1]))[:, 0] + (1, 2, 3))


def test_adjustments_come_at_their_distance_and_seldom(grown):
    _, deltas, _ = grown
    asked = [k for k, delta in enumerate(deltas) if len(delta.moved_keyframes)]
    keyframes = [len(deltas[k].moved_keyframes) for k in asked]
    assert len(asked) >= 2
    assert all(b - a > GROWING.whole_map.distance_frames for a, b in pairwise(asked))
    assert all(b >= 1.1 * a for a, b in pairwise(keyframes))
    _, deltas, _ = fold(AT_THE_END, frames=60)
    assert not any(len(delta.moved_keyframes) for delta in deltas)


def test_readers_have_the_map_that_the_mapper_has(grown):
    mapper, _, history = grown
    active = mapper.atlas.active
    for keyframe in active.keyframes:
        known = history.keyframes[keyframe.id].pose_world_camera
        np.testing.assert_allclose(known, matrix_to_pose(keyframe.T_world_camera), atol=1e-9)
    rows = active.segment.mapped_rows()
    points, told = active.points, history.points()
    rows = rows[np.argsort(points.ids[rows])]
    np.testing.assert_array_equal(told.ids, points.ids[rows])
    np.testing.assert_array_equal(told.hosts, points.first_keyframe[rows])
    far = np.linalg.norm(points.xyz[rows] - active.keyframes[-1].T_world_camera[:3, 3], axis=1)
    off = np.linalg.norm(told.positions - points.xyz[rows], axis=1)
    near = off < (0.003 + 0.3 * points.sigmas[rows]) * far  # so much need not be published
    assert near.mean() > 0.99  # nor what has moved since the last keyframe


def test_a_drifted_map_comes_back():
    """Scale that drifts along the keyframes, and what hangs on them with it, is taken out."""
    mapper, _, _ = fold(AT_THE_END, frames=120)
    active = mapper.atlas.active
    ids = np.array([keyframe.id for keyframe in active.keyframes])
    usual = error(active)
    drift = np.array([similarity(1.002**k, (0, 0, 0), (0, 0, 0)) for k in range(len(ids))])
    active.move(MapMoves(keyframe_ids=ids, moves=drift))
    drifted = error(active)
    assert drifted > 10.0 * usual
    parameters = GROWING.model_copy(update={"window": WindowParameters(keyframes=3)})
    mapper.global_adjustment.request(120, active.segment, mapper.calibration, parameters)
    moves = find_moves(mapper.global_adjustment.job).moves
    np.testing.assert_array_equal(moves.keyframe_ids, ids)  # those in the window, too
    active.move(moves)
    assert error(active) < 0.1 * drifted


def test_an_adjustment_that_comes_apart_moves_nothing(monkeypatch):
    mapper, _, _ = fold(AT_THE_END, frames=120)
    parameters = GROWING.model_copy(update={"window": WindowParameters(keyframes=3)})
    mapper.global_adjustment.request(
        120, mapper.atlas.active.segment, mapper.calibration, parameters
    )

    def apart(seen, *arguments, **others):
        found = adjust_list(seen, *arguments, **others)
        seen.T_world_camera = np.full_like(seen.T_world_camera, np.nan)
        return found

    monkeypatch.setattr(global_adjustment, "adjust_list", apart)
    result = find_moves(mapper.global_adjustment.job)
    assert result.moves is None
    assert result.calibration is mapper.calibration


def test_a_map_moves_as_little_as_it_can():
    """No other similarity brings keyframes and what they see nearer to where they were."""
    mapper, _, _ = fold(AT_THE_END, frames=120)
    active = mapper.atlas.active
    ids = np.array([keyframe.id for keyframe in active.keyframes])
    drift = [similarity(1.004**k, (0, 0.002 * k, 0), (0, 0, 0.001 * k)) for k in range(len(ids))]
    active.move(MapMoves(keyframe_ids=ids, moves=np.array(drift)))
    parameters = GROWING.model_copy(update={"window": WindowParameters(keyframes=3)})
    mapper.global_adjustment.request(120, active.segment, mapper.calibration, parameters)
    job = mapper.global_adjustment.job
    moves = find_moves(job).moves
    before, S = job.seen.T_world_camera, similarity_to_matrix(moves.moves)
    after, scales = move_by_similarity(S, before), moves.moves[:, 7]
    assert np.ptp(scales) > 0.01
    depth = np.median(job.seen.depths())
    U, _, Vt = np.linalg.svd(np.einsum("nij,nkj->ik", before[:, :3, :3], after[:, :3, :3]))
    np.testing.assert_allclose(U @ Vt, np.eye(3), atol=1e-9)

    def moved(scale, t):
        centres = scale * after[:, :3, 3] + t - before[:, :3, 3]
        return (centres**2).sum() + (depth**2 * (scale * scales - 1.0) ** 2).sum()

    least = moved(1.0, np.zeros(3))
    assert least > 0.0
    for scale in (0.999, 1.0, 1.001):
        centre = (1.0 - scale) * after[:, :3, 3].mean(axis=0)
        for t in (*(1e-3 * np.eye(3)), *(-1e-3 * np.eye(3)), np.zeros(3)):
            assert moved(scale, centre + t) > least or (scale == 1.0 and not t.any())


def depth_of(keyframe, mapper):
    """The median of what it sees of the map."""
    points = mapper.atlas.points
    rows = keyframe.rows[points.state[keyframe.rows] == MAPPED]
    return np.median(transform(inverse(keyframe.T_world_camera), points.xyz[rows])[:, 2])


@pytest.mark.parametrize("lost", [False, True])
def test_at_the_end_the_beginning_is_where_it_was(lost):
    mapper, deltas, history = fold(GROWING)
    first = mapper.atlas.active.keyframes[0]
    # Far from where it was, by a scale as well, as if it had strayed for hours.
    far = MapMoves(
        keyframe_ids=np.array([0]), moves=similarity(1.3, (0, 0.1, 0), (0.4, 0, 0.2))[None]
    )
    assert any(len(delta.moved_keyframes) for delta in deltas)
    assert np.abs(first.T_world_camera - np.eye(4)).max() > 1e-6
    strayed = mapper.atlas.active.segment.strayed
    depth = depth_of(first, mapper) / np.cbrt(np.linalg.det(strayed[:3, :3]))
    mapper.follow([mapper.atlas.move(far)])
    if lost:
        for frame in range(FRAMES, FRAMES + 60):
            delta = mapper.process(Frame(frame, frame * 33_000_000, FrameExtrema.empty()))
            history.apply(delta, frame=frame, stamp_ns=frame)
        assert mapper.atlas.active is None
    frame = deltas[-1].pose_frames[-1]
    history.apply(mapper.finish(), frame=int(frame), stamp_ns=0, final=True)
    np.testing.assert_allclose(first.T_world_camera, np.eye(4), atol=1e-9)
    known = history.keyframes[first.id].pose_world_camera
    np.testing.assert_allclose(known, matrix_to_pose(np.eye(4)), atol=1e-9)
    assert depth_of(first, mapper) == pytest.approx(depth, rel=0.02)
    poses = history.final()
    estimated = np.array([poses[k][1][:3] for k in sorted(poses)])
    true = np.array([path(FRAMES)[k][:3, 3] for k in sorted(poses)])
    scale, R, t = align_umeyama(estimated, true, with_scale=True)
    assert np.abs(scale * estimated @ R.T + t - true).max() < 0.02


def test_a_large_map_is_taken_over_later():
    """By what it has, not by how long it took; and no sooner where it is small."""
    mapper, _, _ = fold(AT_THE_END, frames=60)
    active = mapper.atlas.active
    mapper.global_adjustment.request(60, active.segment, mapper.calibration, GROWING)
    job = mapper.global_adjustment.job
    observations, keyframes = len(job.seen.px), len(job.keyframe_ids)
    assert keyframes > 7
    for per_frame, distance in (
        (observations, 7),
        (observations // 20, 20),
        (observations // 90, 90),
    ):
        limits = WholeMapParameters(distance_frames=7, observations_per_frame=per_frame)
        parameters = GROWING.model_copy(update={"whole_map": limits})
        mapper.global_adjustment.job = replace(job, parameters=parameters)
        assert not mapper.global_adjustment.is_due(60 + distance - 1)
        assert mapper.global_adjustment.is_due(60 + distance)


def test_a_point_in_many_keyframes_keeps_observations_from_the_whole_time():
    """So that a room that is seen again and again takes no more time than a path as long."""
    seen = np.array([3, 10, 200, 201])
    point = np.concatenate([np.flatnonzero(seen > k) for k in range(201)]).astype(np.int32)
    kept = _spread_out(point, seen, 10)
    assert np.bincount(point[kept]).tolist() == [3, 10, 10, 10]
    for number in (2, 3):
        at = np.flatnonzero(kept[point == number])
        assert set(np.diff(at).tolist()) <= {20, 21}
    assert not np.array_equal(kept[point == 2], kept[point == 3][:200])


def error(active):
    return error_of(active, path(FRAMES))


def test_a_common_move_changes_nothing_that_a_camera_sees(grown):
    mapper, _, _ = fold(GROWING, frames=40)
    active = mapper.atlas.active
    rows = active.segment.mapped_rows()
    last = active.keyframes[-1]
    before = transform(inverse(last.T_world_camera), active.points.xyz[rows])
    one = similarity(1.7, (0.1, -0.2, 0.3), (4, 5, 6))
    first = np.array([active.keyframes[0].id])
    S = active.move(MapMoves(keyframe_ids=first, moves=one[None]))
    after = transform(inverse(last.T_world_camera), active.points.xyz[rows])
    np.testing.assert_allclose(after, 1.7 * before, atol=1e-9)
    np.testing.assert_allclose(S, similarity_to_matrix(one))


def test_poses_of_frames_scale_with_the_map_around_them(grown):
    _, deltas, _ = grown
    history = MapHistory()
    for frame, delta in enumerate(deltas[:40]):
        history.apply(delta, frame=frame, stamp_ns=frame)
    before = {frame: pose for frame, (_, pose) in history.final().items()}
    one = similarity(2.0, (0, 0.1, 0), (1, 1, 1))
    nothing = {
        name: value[:0]
        for name, value in vars(deltas[40]).items()
        if isinstance(value, np.ndarray) and value.ndim
    }
    nothing.update(moved_keyframes=np.array([0]), moves=one[None])
    history.apply(replace(deltas[40], **nothing), frame=40, stamp_ns=40)
    assert len(before) > 30
    for frame, pose in before.items():
        T = similarity_to_matrix(np.append(pose, 1.0))
        expected = matrix_to_pose(move_by_similarity(similarity_to_matrix(one), T))
        np.testing.assert_allclose(history.final()[frame][1], expected, atol=1e-9)


WRONG = replace(CAMERA, fx=1.06 * CAMERA.fx, fy=1.06 * CAMERA.fy)
"""As it is given; the scene is seen by ``CAMERA``."""


def turning(frames=FRAMES):
    """As ``path``, and it looks about, which tells the focal length."""
    turns = [(0.2 * np.sin(0.15 * k), 0.3 * np.sin(0.1 * k), 0.0) for k in range(frames)]
    return [looking(T[:3, 3], turn) for T, turn in zip(path(frames), turns, strict=True)]


@pytest.fixture(scope="module")
def mistaken():
    return fold(GROWING, camera=WRONG, poses=turning())


def test_a_wrong_lens_is_taken_over(mistaken, monkeypatch):
    mapper, deltas, history = mistaken
    found = mapper.calibration
    assert abs(found.correction[0] + np.log(1.06)) < found.sigmas[0]
    assert abs(found.view.camera.fx / CAMERA.fx - 1.0) < 0.004
    assert mapper.atlas.active.camera == found.view.camera
    told = [delta.calibration_correction for delta in deltas]
    assert 1 <= len(set(told) - {()}) <= 3  # seldom, and then for all that follow
    assert told[-1] == tuple(found.correction.tolist())
    monkeypatch.setattr(SelfCalibration, "is_refuted", lambda *_: False)
    other, _, without = fold(GROWING, camera=WRONG, poses=turning())
    assert other.calibration.view.camera == WRONG
    assert online_error(history) < 0.5 * online_error(without)
    assert error_of(mapper.atlas.active, turning()) < 0.5 * error_of(other.atlas.active, turning())


def test_a_lens_that_is_found_at_once_needs_no_prior(mistaken):
    """The final adjustment is not drawn to what has been refuted."""
    mapper = load_state(save_state(mistaken[0]))
    mapper.finish()
    assert abs(mapper.calibration.correction[0] + np.log(1.06)) < 0.005


def test_a_right_lens_stays(grown):
    mapper, deltas, _ = grown
    assert mapper.calibration.view.camera == CAMERA
    assert not any(delta.calibration_correction for delta in deltas)


def test_readers_have_the_map_under_another_lens(mistaken):
    test_readers_have_the_map_that_the_mapper_has(mistaken)


@pytest.mark.parametrize("how", ["in_thread", "killed"])
def test_where_the_answer_was_found_changes_nothing(mistaken, how):
    """Of a job whose result moves keyframes, and of one that finds a lens; large ones wait for
    longer than the others."""
    _, deltas, _ = mistaken
    assert sum(len(delta.moved_keyframes) > 0 for delta in deltas) > len(
        {delta.calibration_correction for delta in deltas} - {()}
    )
    _, others, _ = fold(GROWING, camera=WRONG, poses=turning(), **{how: True})
    for one, other in zip(deltas, others, strict=True):
        for name, value in vars(one).items():
            np.testing.assert_array_equal(value, getattr(other, name), err_msg=name)


def online_error(history):
    """Sim(3) RMSE of the poses of the last frames as they were known at once."""
    last = [frame for frame in history.online if frame >= FRAMES - 30]
    true = np.array(turning())[last, :3, 3]
    at = np.array([history.online[frame][1][:3] for frame in last])
    scale, R, t = align_umeyama(at, true, with_scale=True)
    return np.sqrt(((scale * at @ R.T + t - true) ** 2).sum(axis=1).mean())
