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

from pliant.algorithms.mapping.parameters import KeyframeParameters


class Overlap(NamedTuple):
    """What a frame shares with the last keyframe.

    share: of the points of the keyframe that are seen.   in_view: that are in the image.
    flow: how far the median point has moved beside the turn of the camera, px at 640x480.
    age_s: since the keyframe.   interval_s: since the last frame, so that the next one may be
    expected as long after this one.
    """

    share: float
    in_view: float
    flow: float
    age_s: float
    interval_s: float = 0.0


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
