"""The keyframe rule: when a frame becomes a keyframe.

Landmarks leave the view at a constant rate, however often frames come.  So the share that the next
frame will see can be predicted.  A keyframe is due before that share is too small, or once the
landmarks have moved far enough to determine their depths.

A keyframe is worthwhile for a new view or for parallax.  If landmarks are lost that are still in
the image, and the camera has hardly moved, noise or blur ended their tracks: a keyframe there shows
nothing new, and would only map new tracks that end as soon.  It waits until fewer remain.

Landmarks are counted, not all tracks: in a noisy image most tracks are noise that ends within a
frame or two and is no evidence of the view.  Candidates count only if a frame shares fewer
landmarks with the last keyframe than a start needs.
"""

from typing import NamedTuple

from pliant.algorithms.slam.parameters import KeyframeParameters


class Overlap(NamedTuple):
    """The overlap of a frame with the last keyframe.

    share: of the keyframe's landmarks that are tracked.   in_view: share that is in the image.
    flow: median motion of the landmarks without the rotation, px at 640x480.
    age_s: since the keyframe.   interval_s: since the last frame; the next one is expected after
    the same time.
    """

    share: float
    in_view: float
    flow: float
    age_s: float
    interval_s: float = 0.0


def is_due(overlap: Overlap, limits: KeyframeParameters) -> bool:
    """Whether a frame with this overlap becomes a keyframe."""
    if overlap.flow > limits.max_flow_px:
        return True
    if overlap.age_s > limits.max_s and overlap.flow > limits.min_flow_px:
        return True
    until_next = 1.0 + overlap.interval_s / overlap.age_s
    if overlap.flow > limits.moved_flow_px:
        return overlap.share**until_next < limits.min_shared_share
    return (
        overlap.in_view**until_next < limits.min_shared_share
        or overlap.share**until_next < limits.min_tracked_share
    )
