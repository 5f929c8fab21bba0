"""What one frame tells of keyframes: which points they observe, and where in their images."""

from dataclasses import dataclass
from typing import Annotated

from pliant.algorithms.arrays import F32, I32, I64, BoolArray, Shape


@dataclass(frozen=True, kw_only=True)
class KeyframeDelta:
    """Observations of keyframes.  Poses and points are told by the MapDelta of the same frame.

    A keyframe is told of twice: when it is new, and when nothing about it will change any more
    but by the final adjustment, as it has left the window, its segment was lost, or the stream has
    ended.

    new: id of the keyframe that this frame became; -1 where it became none.
    keyframe_ids: keyframes whose observations follow.    settled: whether they will not change.
    counts: observations of each; they follow each other in ``point_ids``, ascending in each.
    point_ids: points of the map.    points_px: (u, v) where the keyframe sees them.
    """

    new: int
    keyframe_ids: Annotated[I64, Shape("K")]
    settled: Annotated[BoolArray, Shape("K")]
    counts: Annotated[I32, Shape("K")]
    point_ids: Annotated[I64, Shape("N")]
    points_px: Annotated[F32, Shape("N", 2)]
