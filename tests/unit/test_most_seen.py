"""Which points an adjustment of the whole map works with: those that most keyframes see."""

import numpy as np
import pytest

from pliant.algorithms.slam.adjust.final_adjustment import ObservationList

KEYFRAMES, POINTS = 12, 3000


@pytest.fixture
def listed():
    """A map whose points some keyframes that follow one another see, up to seven."""
    generator = np.random.default_rng(0)
    first = generator.integers(0, KEYFRAMES, POINTS)
    length = generator.integers(1, 8, POINTS)
    table = np.arange(KEYFRAMES)[:, None] - first
    camera, point = np.nonzero((table >= 0) & (table < length))
    count = len(point)
    return ObservationList(
        rows=np.arange(POINTS, dtype=np.int32) + 5,
        xyz=generator.normal(size=(POINTS, 3)),
        T_world_camera=np.tile(np.eye(4), (KEYFRAMES, 1, 1)),
        camera=camera.astype(np.int32),
        point=point.astype(np.int32),
        px=generator.uniform(0.0, 640.0, (count, 2)).astype(np.float32),
        weights=generator.uniform(size=count).astype(np.float32),
        fixed=np.arange(KEYFRAMES) == 0,
        flow=generator.normal(size=(count, 2)).astype(np.float32),
    )


def test_every_keyframe_has_its_points_most_observed_first(listed):
    few = listed.most_seen(100)
    counts = np.bincount(listed.point, minlength=POINTS)
    have, chosen = np.zeros(KEYFRAMES, int), []
    for n in np.argsort(-counts, kind="stable"):
        seen_by = listed.camera[listed.point == n]
        if len(seen_by) >= 2 and (have[seen_by] < 100).any():
            have[seen_by] += 1
            chosen.append(n)
    assert set(few.rows) == set(listed.rows[chosen])
    assert (np.bincount(few.camera, minlength=KEYFRAMES) == have).all()
    assert (have >= 100).all()
    assert len(few.rows) < 0.3 * POINTS


def test_all_that_is_said_of_a_chosen_point_stays(listed):
    few = listed.most_seen(100)
    place = few.rows - listed.rows[0]
    assert (few.xyz == listed.xyz[place]).all()
    kept = np.isin(listed.point, place)
    assert (place[few.point] == listed.point[kept]).all()
    for name in ("camera", "px", "weights", "flow"):
        assert (getattr(few, name) == getattr(listed, name)[kept]).all()
    assert few.T_world_camera is listed.T_world_camera


def test_where_there_are_no_more_all_that_two_keyframes_see_stay(listed):
    few = listed.most_seen(POINTS)
    counts = np.bincount(listed.point, minlength=POINTS)
    assert (few.rows == listed.rows[counts >= 2]).all()
    listed.flow = None
    assert listed.most_seen(POINTS).flow is None
