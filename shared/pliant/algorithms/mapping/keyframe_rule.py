"""When a frame becomes a keyframe.

Points leave the view at a constant rate, however often frames come.  So the share that the next
frame will see is known, and a keyframe is due before that is too little, or once the points have
moved far enough to tell their depths.

A keyframe earns its place by a new view or by parallax.  Where points are lost that are still in
the image, and the camera has hardly moved, noise or blur ended their tracks: a keyframe there shows
nothing new, and would only let new tracks be mapped that end as soon.  It waits until fewer remain.

Points of the map are counted, not all tracks: in a noisy image most tracks are noise that ends
within a frame or two, which says nothing of the view.  Candidates count only where a frame shares
fewer points with the last keyframe than a map starts with.
"""

from typing import NamedTuple

from pliant.algorithms.camera import size_unit
from pliant.algorithms.mapping.active_map import ActiveMap
from pliant.algorithms.mapping.frame_pose import directions_of
from pliant.algorithms.mapping.landmarks import CANDIDATE, MAPPED
from pliant.algorithms.mapping.parameters import KeyframeParameters


class Overlap(NamedTuple):
    """What a frame shares with the last keyframe.

    share: of the points of the keyframe that are seen.   in_view: that are in the image.
    flow: how far the median point has moved beside the turn of the camera, px at 640x480.
    age_s: since the keyframe.   interval_s: since the last frame.
    """

    share: float
    in_view: float
    flow: float
    age_s: float
    interval_s: float


def is_due(overlap: Overlap, limits: KeyframeParameters) -> bool:
    """Whether a frame with so much overlap is to become a keyframe."""
    if overlap.flow > limits.max_flow_px:
        return True
    if overlap.age_s > limits.max_s and overlap.flow > limits.min_flow_px:
        return True
    until_next = 1.0 + overlap.interval_s / overlap.age_s
    if overlap.flow > limits.telling_flow_px:
        return overlap.share**until_next < limits.min_shared_share
    return (
        overlap.in_view**until_next < limits.min_shared_share
        or overlap.share**until_next < limits.min_tracked_share
    )


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
        in_view = shared  # the others have no place to look for them
    else:
        in_view = max(shared, active.window.in_view_since_keyframe())
    unit = size_unit(active.camera.width, active.camera.height)
    before = max(before, 1)
    overlap = Overlap(shared / before, in_view / before, flow_px / unit, age_s, interval_s)
    return is_due(overlap, active.parameters.keyframe)
