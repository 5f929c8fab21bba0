"""The confidence of a surfel: its neighbours know what its own image cannot show."""

import numpy as np
import pytest
from surfel_scene import STEP_S, board_renderer, film, motion

from pliant.algorithms.surfels.deformation_graph import patch_distortions
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.patch_sampling import A, X
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.algorithms.surfels.surfel_table import SurfelTable, frame_of
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker
from pliant.algorithms.surfels.validation import INSIDE


def tracked_table(neighbours: int) -> SurfelTable:
    """The surfels of a board in its second frame."""
    motions = [motion((0.0, 0.0, 0.0), (0.001 * k, 0.0, 0.0)) for k in range(2)]
    renderer, camera = board_renderer(motions)
    first, second = film(renderer, 2)
    parameters = SurfelParameters(max_surfels=60, levels=2, neighbours=neighbours)
    tracker = SurfelTracker(parameters)
    tracker.start(first.image, first.depth_m, camera)
    tracker.track(second.image, STEP_S)
    return tracker._now.table


def confidence(table: SurfelTable) -> np.ndarray:
    frame = frame_of(
        table, frame=1, segment=0, lost=False, T_world_camera=np.eye(4), depth_is_known=True
    )
    assert frame.confidence.shape == frame.ids.shape
    return frame.confidence


def test_a_surfel_off_its_neighbours_along_its_ray_is_doubtful() -> None:
    table = tracked_table(8)
    before = confidence(table)
    assert before.min() > 0.9
    row = int(np.argmin(np.linalg.norm(table.poses[:, X : X + 2], axis=1)))
    table.poses[row, X : X + 3] *= 1.1  # it is seen at the same pixel, and its ZNCC stays
    after = confidence(table)
    assert after[row] < 0.3
    assert np.median(after) > 0.9
    assert after.argmin() == row


def test_surfels_without_neighbours_have_the_zncc_of_birth() -> None:
    table = tracked_table(0)
    table.birth_zncc[:3] = -0.5, 0.4, 1.0
    np.testing.assert_allclose(confidence(table)[:3], [0.0, 0.4, 1.0])
    assert confidence(table) == pytest.approx(np.clip(table.birth_zncc, 0.0, 1.0))


def test_old_positions_of_lost_surfels_do_not_count() -> None:
    table = tracked_table(8)
    before = confidence(table)
    lost = np.arange(len(table)) % 3 == 0
    table.state[lost] = SurfelState.OUTLIER
    table.poses[lost, X : X + 3] *= 1.1
    table.birth_zncc[lost] = 0.6
    after = confidence(table)
    alone = np.isin(np.arange(len(table)), table.edges.ends[~lost[table.edges.ends].any(axis=1)])
    assert alone[~lost].mean() > 0.9
    np.testing.assert_allclose(after[alone], before[alone], atol=0.05)
    np.testing.assert_allclose(after[lost], 0.3)


def test_a_surfel_that_has_lost_most_of_its_neighbours_is_doubtful() -> None:
    """What took them may have led it astray, together with the few that are left.  Neighbours that
    have left the image are no evidence."""
    table = tracked_table(8)
    before = confidence(table)
    row = int(np.argmin(np.linalg.norm(table.poses[:, X : X + 2], axis=1)))
    ends = table.edges.ends[(table.edges.ends == row).any(axis=1)]
    neighbours = np.setdiff1d(ends, row)
    few = max(1, len(neighbours) // 5)
    table.state[neighbours[few:]] = SurfelState.OCCLUDED
    left = few / len(neighbours)
    assert confidence(table)[row] == pytest.approx((0.5 + left) * before[row], abs=0.05)
    table.state[neighbours] = SurfelState.OCCLUDED
    assert confidence(table)[row] == pytest.approx(0.5 * table.birth_zncc[row])
    table.validations[neighbours, INSIDE] = 0.0
    assert confidence(table)[row] == pytest.approx(table.birth_zncc[row])


def test_a_measured_depth_overrules_the_neighbours() -> None:
    motions = [motion((0.0, 0.0, 0.0), (0.001 * k, 0.0, 0.0)) for k in range(4)]
    renderer, camera = board_renderer(motions)
    first, second, third, fourth = film(renderer, 4)
    tracker = SurfelTracker(SurfelParameters(max_surfels=60, levels=2))
    tracker.start(first.image, first.depth_m, camera)
    right = tracker.track(second.image, STEP_S, depth=second.depth_m)
    assert right.confidence[right.state == SurfelState.TRACKED].min() > 0.5
    old = right.ids
    wrong = tracker.track(third.image, STEP_S, depth=1.05 * third.depth_m)
    tracked = (wrong.state == SurfelState.TRACKED) & np.isin(wrong.ids, old)
    assert tracked.sum() > 30
    assert (wrong.confidence[tracked] == 0.0).all()
    unmeasured = tracker.track(fourth.image, STEP_S)
    tracked = (unmeasured.state == SurfelState.TRACKED) & np.isin(unmeasured.ids, old)
    assert np.median(unmeasured.confidence[tracked]) > 0.5


def test_on_made_up_depth_a_patch_that_is_distorted_otherwise_is_doubtful() -> None:
    motions = [motion((0.0, 0.0, 0.0), (0.001 * k, 0.0, 0.0)) for k in range(2)]
    renderer, camera = board_renderer(motions)
    first, second = film(renderer, 2)
    tracker = SurfelTracker(SurfelParameters(max_surfels=60, levels=2, depth_from="flat"))
    tracker.start(first.image, np.ones_like(first.depth_m), camera)
    before = tracker.track(second.image, STEP_S)
    tracked = before.state == SurfelState.TRACKED
    assert before.confidence[tracked].min() > 0.9
    assert before.confirmed[tracked].all()
    table = tracker._now.table
    row = int(np.argmin(np.linalg.norm(table.poses[:, X : X + 2], axis=1)))
    poses = table.poses.copy()
    poses[row, A : A + 3] *= 1.8
    known = np.ones(len(table), np.bool_)
    table.distortions = patch_distortions(poses, table.edges, known)
    assert table.distortions[row] == pytest.approx(0.8, abs=0.1)
    assert np.median(table.distortions) < 0.1
    after = frame_of(
        table, frame=1, segment=0, lost=False, T_world_camera=np.eye(4), depth_is_known=False
    )
    assert after.confidence.argmin() == row
    assert after.confirmed.argmin() == row
    assert after.confirmed.sum() == len(table) - 1
