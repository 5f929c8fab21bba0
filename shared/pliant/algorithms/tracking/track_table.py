"""The living tracks of the tracker, a record for each, and their templates."""

from dataclasses import dataclass
from typing import Any, NamedTuple, TypeAlias

import numpy as np

from pliant.algorithms.arrays import F32, I32
from pliant.algorithms.image.patch_sums import BIRTH_FLOATS, TEMPLATE_FLOATS

TRACK = np.dtype(
    [
        ("id", np.int64),
        # Sub-pixel position of the point, and of the last extremum.
        ("u", np.float32),
        ("v", np.float32),
        ("extremum_u", np.float32),
        ("extremum_v", np.float32),
        # Curvature at the last extremum, signed, DN^3.
        ("kappa", np.float32),
        # First pixel of the template relative to the point, pixels of its octave.
        ("left", np.float32),
        ("top", np.float32),
        # Of the template; 0: there is none.
        ("energy", np.float32),
        # From the frame before to this one.
        ("motion_u", np.float32),
        ("motion_v", np.float32),
        ("age", np.int32),
        ("state", np.int32),
        # Seconds in a row without an extremum.
        ("coasted", np.float32),
        # Flat pixel of the extremum in this frame, or -1.
        ("pixel", np.int32),
        # Row of the template.
        ("slot", np.int32),
        ("alive", np.int32),
        # 0 for a template of the full-size image, 1 of half the size.
        ("octave", np.int32),
    ]
)
"""A track.  All that a step needs is contiguous in memory."""

Track: TypeAlias = Any
"""A record of type TRACK."""
Tracks: TypeAlias = Any
"""(N,) records of type TRACK."""


class Patches(NamedTuple):
    """Appearance of tracks, by the slot of a track.

    templates: flat, TEMPLATE_FLOATS each.  births: flat, BIRTH_FLOATS grey levels around the patch
    in the frame of birth.  deformations: (capacity, 8), the 2x2 map from birth to now, and that of
    the template.
    """

    templates: F32
    births: F32
    deformations: F32


@dataclass
class TrackTable:
    """Tracks in order of their ids, in the first ``count`` rows.

    Patches stay where they are while rows move up; free_slots[:free_count] are the unused ones.
    """

    count: int
    free_count: int
    rows: Tracks
    patches: Patches
    free_slots: I32

    @staticmethod
    def with_capacity(capacity: int) -> "TrackTable":
        """Return an empty table for this many tracks, and for half as many patches of lost ones."""
        patches = capacity + capacity // 2
        return TrackTable(
            count=0,
            free_count=patches,
            rows=np.zeros(capacity, TRACK),
            patches=Patches(
                templates=np.zeros(patches * TEMPLATE_FLOATS, np.float32),
                births=np.zeros(patches * BIRTH_FLOATS, np.float32),
                deformations=np.zeros((patches, 8), np.float32),
            ),
            free_slots=np.arange(patches - 1, -1, -1, dtype=np.int32),
        )

    @property
    def tracks(self) -> Tracks:
        """The living tracks, in order of their ids."""
        return self.rows[: self.count]
