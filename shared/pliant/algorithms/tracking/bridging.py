"""Tracks over frames in which nearly all of them are lost at once: blurred, dark or covered ones.

No template is found in a blurred frame, and the next sharp one has nothing that goes on.  So the
frame before such a loss is kept, with the templates of its tracks, and frames that follow are
compared with it directly: tracks that are found again there go on with their ids.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32
from pliant.algorithms.tracking.dominant_flow import BriefFeatures
from pliant.algorithms.tracking.track_table import Tracks, TrackTable

LOST_AT_ONCE = 0.5
"""Share of the tracks that a frame loses at least where the one before is kept."""

_LEAST = 100
"""Tracks of which a share says something."""

_AS_SHARP = 0.8
"""Share of the maxima of the kept frame that a later one has at least if it is no less sharp."""

_STILL_LOST = 0.2
"""Share of the kept tracks below which they are given up: the rest went from view."""


@dataclass(frozen=True, kw_only=True)
class LastSharp:
    """A frame, and its tracks (N,), whose templates are kept."""

    stamp_ns: int
    smooth: F32
    pyramid: list[F32]
    maxima: F32
    features: BriefFeatures
    local: F32
    tracks: Tracks

    def lost(self, table: TrackTable) -> Tracks:
        """Its tracks that are not there now."""
        gone = ~np.isin(self.tracks["id"], table.tracks["id"], assume_unique=True)
        return self.tracks[gone]


def are_lost(before: int, now: int) -> bool:
    """Whether so many tracks have become so few that the frame before is worth keeping."""
    return before >= _LEAST and now < (1.0 - LOST_AT_ONCE) * before


def is_as_sharp(maxima: F32, kept: LastSharp | None) -> bool:
    """Whether a frame with these maxima shows as much as the one that is kept, if any."""
    return kept is None or len(maxima) > _AS_SHARP * len(kept.maxima)


def is_over(kept: LastSharp, lost: Tracks, stamp_ns: int, longest_s: float) -> bool:
    """Whether nothing more comes of it."""
    late = stamp_ns - kept.stamp_ns > 1e9 * longest_s
    return late or len(lost) < _STILL_LOST * len(kept.tracks)


def keep_slots(table: TrackTable, freed_from: int, kept: LastSharp) -> None:
    """Slots that have just been freed, those from an index on, stay taken where a kept track has
    its template there."""
    freed = table.free_slots[freed_from : table.free_count]
    free = freed[~np.isin(freed, kept.tracks["slot"])]
    table.free_count = freed_from + len(free)
    table.free_slots[freed_from : table.free_count] = free


def release(table: TrackTable, kept: LastSharp) -> None:
    """Slots of tracks that are not there any more are free again."""
    slots = kept.lost(table)["slot"]
    table.free_slots[table.free_count : table.free_count + len(slots)] = slots
    table.free_count += len(slots)


def put_back(table: TrackTable, found: Tracks) -> None:
    """Let tracks go on in the table; where that is full the youngest of the others make room."""
    room = len(table.rows) - len(found)
    young = table.tracks[room:]["slot"] if table.count > room else np.zeros(0, np.int32)
    table.free_slots[table.free_count : table.free_count + len(young)] = young
    table.free_count += len(young)
    rows = np.concatenate([table.tracks[: max(room, 0)], found])
    table.count = len(rows)
    table.rows[: table.count] = rows[np.argsort(rows["id"], kind="stable")]
