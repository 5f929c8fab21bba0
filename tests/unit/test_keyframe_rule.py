"""When a frame becomes a keyframe: the last one before too little is shared, or too much moved."""

import numpy as np
import pytest
from mapping_scene import CAMERA, INTERVAL_NS, Scene, sideways

from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.keyframe_rule import Overlap, is_due
from pliant.algorithms.slam.map.landmarks import MAPPED
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import KeyframeParameters, MappingParameters

LIMITS = KeyframeParameters()


def first_due(interval_s, share_after, flow=0.0):
    """How many frames after the last keyframe the next one is.   share_after(s): of its points."""
    for n in range(1, 1000):
        share = share_after(n * interval_s)
        overlap = Overlap(share, share, flow, n * interval_s, interval_s)
        if is_due(overlap, LIMITS):
            return n
    return None


@pytest.mark.parametrize("interval_s", [1 / 60, 1 / 10, 1 / 3])
@pytest.mark.parametrize("half_life_s", [0.1, 0.5, 3.0])
def test_keyframes_share_enough_at_any_rate(interval_s, half_life_s):
    def share(s):
        return 0.5 ** (s / half_life_s)

    n = first_due(interval_s, share)
    assert share((n + 1) * interval_s) < LIMITS.min_shared_share
    assert n == 1 or share(n * interval_s) >= LIMITS.min_shared_share


def test_what_moves_far_needs_one_and_what_stays_none():
    for flow, due in ((1.01 * LIMITS.max_flow_px, 1), (LIMITS.min_flow_px, None)):
        assert first_due(1 / 30, lambda s: 1.0, flow) == due


def test_what_moves_a_little_needs_one_after_some_time():
    n = first_due(1 / 30, lambda s: 1.0, 2.0 * LIMITS.min_flow_px)
    assert n == int(30 * LIMITS.max_s) + 1


@pytest.mark.parametrize("interval_s", [1 / 60, 1 / 10])
def test_tracks_that_noise_ends_need_one_only_once_the_camera_has_moved(interval_s):
    """Or once few remain: their points are still in the image."""

    def due(share, flow):
        overlap = Overlap(share, 1.0, flow, 4.0 * interval_s, interval_s)
        return is_due(overlap, LIMITS)

    still, moved = 0.9 * LIMITS.moved_flow_px, 1.1 * LIMITS.moved_flow_px
    assert not due(0.5, still)
    assert due(0.5, moved)
    assert due(0.3, still)
    assert not due(0.8, moved)


def test_a_view_that_turns_away_needs_one_however_many_tracks_are_left():
    overlap = Overlap(0.5, 0.5, 0.0, 0.1, 1 / 30)
    assert is_due(overlap, LIMITS)


@pytest.mark.parametrize(("mapped", "due"), [(900, False), (60, True)])
def test_tracks_of_noise_make_no_keyframes(monkeypatch, mapped, due):
    """Where most candidates end at once and points stay; few points are no measure."""
    mapper = Mapper(CAMERA, MappingParameters(), 0)
    for frame, tracks in enumerate(Scene.box().frames(sideways(30))):
        mapper.process(Frame(frame, frame * INTERVAL_NS, tracks))
    active = mapper.atlas.active
    assert active is not None

    def shared(least):
        return (mapped, mapped, 0.0) if least == MAPPED else (2000, 5000, 0.0)

    monkeypatch.setattr(active.window, "flow_since_keyframe", shared)
    monkeypatch.setattr(active.window, "in_view_since_keyframe", lambda: mapped)
    monkeypatch.setattr(active, "helping_candidates", lambda: np.arange(4000))
    assert is_due(active.overlap(0.1, 0.01), LIMITS) == due


@pytest.mark.parametrize("age_s", [0.01, 10.0])
def test_without_a_next_frame_the_share_decides_however_old_the_keyframe_is(age_s):
    """As where a start reaches back, of which no flow is known."""
    least = LIMITS.min_shared_share
    assert not is_due(Overlap(least, least, 0.0, age_s), LIMITS)
    assert is_due(Overlap(least - 1e-6, least - 1e-6, 0.0, age_s), LIMITS)
