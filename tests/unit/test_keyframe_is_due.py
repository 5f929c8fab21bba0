"""When a frame becomes a keyframe: the last one before too little is shared, or too much moved."""

import pytest
from mapping_scene import CAMERA, INTERVAL_NS, Scene, sideways

from pliant.algorithms.mapping.frame_pose import keyframe_is_due
from pliant.algorithms.mapping.mapper import Mapper
from pliant.algorithms.mapping.parameters import MappingParameters

PARAMETERS = MappingParameters()
LIMITS = PARAMETERS.keyframe


@pytest.fixture(scope="module")
def active():
    mapper = Mapper(CAMERA, PARAMETERS, 0)
    for frame, tracks in enumerate(Scene.box().frames(sideways(30))):
        mapper.process(frame, frame * INTERVAL_NS, tracks, None, None)
    return mapper.atlas.active


def first_due(active, monkeypatch, interval_s, share_after, flow_px=0.0):
    """How many frames after the last keyframe the next one is.   share_after(s): of its points."""
    for n in range(1, 1000):
        seen = (share_after(n * interval_s), flow_px)
        monkeypatch.setattr(active.window, "flow_since_keyframe", lambda least, seen=seen: seen)
        if keyframe_is_due(active, n * interval_s, interval_s):
            return n
    return None


@pytest.mark.parametrize("interval_s", [1 / 60, 1 / 10, 1 / 3])
@pytest.mark.parametrize("half_life_s", [0.1, 0.5, 3.0])
def test_keyframes_share_enough_at_any_rate(active, monkeypatch, interval_s, half_life_s):
    def share(s):
        return 0.5 ** (s / half_life_s)

    n = first_due(active, monkeypatch, interval_s, share)
    assert share((n + 1) * interval_s) < LIMITS.min_shared_share
    assert n == 1 or share(n * interval_s) >= LIMITS.min_shared_share


def test_what_moves_far_needs_one_and_what_stays_none(active, monkeypatch):
    for flow_px, due in ((1.01 * LIMITS.max_flow_px, 1), (LIMITS.min_flow_px, None)):
        assert first_due(active, monkeypatch, 1 / 30, lambda s: 1.0, flow_px) == due


def test_what_moves_a_little_needs_one_after_some_time(active, monkeypatch):
    n = first_due(active, monkeypatch, 1 / 30, lambda s: 1.0, 2.0 * LIMITS.min_flow_px)
    assert n == int(30 * LIMITS.max_s) + 1
