"""Bridging: tracks survive frames in which nearly all are lost at once (blurred, dark or covered).

No template is found in a blurred frame, and the next sharp frame has no tracks left to continue.
So the frame before such a loss is stored, with the templates of its tracks, and later frames are
compared with it directly: tracks found there continue with their ids.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32
from pliant.algorithms.tracking.dominant_flow import BriefFeatures
from pliant.algorithms.tracking.track_table import Tracks, TrackTable

LOST_AT_ONCE = 0.5
"""Minimum share of tracks that a frame loses for the frame before to be stored."""

_LEAST = 100
"""Minimum tracks for such a share."""

_AS_SHARP = 0.8
"""Minimum share of the stored frame's maxima in a later frame that replaces it."""

_STILL_LOST = 0.2
"""Share of the stored tracks below which they are dropped: the rest left the view."""


@dataclass(frozen=True, kw_only=True)
class LastSharp:
    """A frame, and its tracks (N,), whose templates are stored."""

    stamp_ns: int
    smooth: F32
    pyramid: list[F32]
    maxima: F32
    features: BriefFeatures
    local: F32
    tracks: Tracks

    def lost(self, table: TrackTable) -> Tracks:
        """Return the tracks of that frame that are lost now."""
        gone = ~np.isin(self.tracks["id"], table.tracks["id"], assume_unique=True)
        return self.tracks[gone]


def are_lost(before: int, now: int) -> bool:
    """Whether enough tracks were lost to store the frame before."""
    return before >= _LEAST and now < (1.0 - LOST_AT_ONCE) * before


def is_as_sharp(maxima: F32, kept: LastSharp | None) -> bool:
    """Whether a frame with these maxima is as good as the stored one, if any."""
    return kept is None or len(maxima) > _AS_SHARP * len(kept.maxima)


def is_over(kept: LastSharp, lost: Tracks, stamp_ns: int, longest_s: float) -> bool:
    """Whether no more tracks can return."""
    late = stamp_ns - kept.stamp_ns > 1e9 * longest_s
    return late or len(lost) < _STILL_LOST * len(kept.tracks)


def keep_slots(table: TrackTable, freed_from: int, kept: LastSharp) -> None:
    """Keep the just freed slots, from an index on, that hold the template of a stored track."""
    freed = table.free_slots[freed_from : table.free_count]
    free = freed[~np.isin(freed, kept.tracks["slot"])]
    table.free_count = freed_from + len(free)
    table.free_slots[freed_from : table.free_count] = free


def release(table: TrackTable, kept: LastSharp) -> None:
    """Free the slots of tracks that have ended."""
    slots = kept.lost(table)["slot"]
    table.free_slots[table.free_count : table.free_count + len(slots)] = slots
    table.free_count += len(slots)


def put_back(table: TrackTable, found: Tracks) -> None:
    """Return tracks to the table; if it is full, the youngest others are removed."""
    room = len(table.rows) - len(found)
    young = table.tracks[room:]["slot"] if table.count > room else np.zeros(0, np.int32)
    table.free_slots[table.free_count : table.free_count + len(young)] = young
    table.free_count += len(young)
    rows = np.concatenate([table.tracks[: max(room, 0)], found])
    table.count = len(rows)
    table.rows[: table.count] = rows[np.argsort(rows["id"], kind="stable")]
