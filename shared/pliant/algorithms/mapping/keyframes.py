"""When a frame becomes a keyframe.

Points leave the view at a constant rate, however often frames come.  So the share that the next
frame will see is known, and a keyframe is due before that is too little, or once the points have
moved far enough to tell their depths.

Points of the map are counted, not all tracks: in a noisy image most tracks are noise that ends
within a frame or two, which says nothing of the view.  Candidates count only where a frame shares
fewer points with the last keyframe than a map starts with.
"""

from typing import NamedTuple

from pliant.algorithms.camera import size_unit
from pliant.algorithms.mapping.active_map import ActiveMap
from pliant.algorithms.mapping.frame_pose import directions_of
from pliant.algorithms.mapping.map_store import CANDIDATE, MAPPED
from pliant.algorithms.mapping.parameters import KeyframeParameters


class Overlap(NamedTuple):
    """What a frame shares with the last keyframe.

    share: of the points of the keyframe.   flow: how far the median point has moved beside the turn
    of the camera, px at 640x480.   age_s: since the keyframe.   interval_s: since the last frame.
    """

    share: float
    flow: float
    age_s: float
    interval_s: float


def is_due(overlap: Overlap, limits: KeyframeParameters) -> bool:
    """Whether a frame with so much overlap is to become a keyframe."""
    share_of_next = overlap.share ** (1.0 + overlap.interval_s / overlap.age_s)
    if share_of_next < limits.min_shared_share or overlap.flow > limits.max_flow_px:
        return True
    return overlap.age_s > limits.max_s and overlap.flow > limits.min_flow_px


def keyframe_is_due(active: ActiveMap, age_s: float, interval_s: float) -> bool:
    """Whether the frame in the window is to become a keyframe.

    age_s: since the last keyframe.   interval_s: since the last frame, so that the next one may be
    expected as long after this one.
    """
    if active.segment.resumes:
        return True  # the camera has been recognised
    shared, before, flow_px = active.window.flow_since_keyframe(MAPPED)
    if shared < active.parameters.start.min_points and len(directions_of(active)):
        shared, before, flow_px = active.window.flow_since_keyframe(CANDIDATE)
    unit = size_unit(active.camera.width, active.camera.height)
    overlap = Overlap(shared / max(before, 1), flow_px / unit, age_s, interval_s)
    return is_due(overlap, active.parameters.keyframe)
