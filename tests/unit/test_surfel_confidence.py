"""The confidence of a surfel: its neighbours know what its own image cannot show."""

import numpy as np
import pytest
from surfel_scene import STEP_S, board_renderer, film, motion

from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.patch_sampling import X
from pliant.algorithms.surfels.surfel_table import SurfelTable, frame_of
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker


def tracked_table(neighbours: int) -> SurfelTable:
    """The surfels of a board in its second frame."""
    motions = [motion((0.0, 0.0, 0.0), (0.001 * k, 0.0, 0.0)) for k in range(2)]
    renderer, camera = board_renderer(motions)
    first, second = film(renderer, 2)
    parameters = SurfelParameters(max_surfels=60, levels=2, neighbours=neighbours)
    tracker = SurfelTracker(parameters)
    tracker.start(first.image, first.depth_m, camera)
    tracker.track(second.image, STEP_S)
    return tracker._table


def confidence(table: SurfelTable) -> np.ndarray:
    frame = frame_of(table, frame=1, segment=0, lost=False, T_world_camera=np.eye(4))
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
