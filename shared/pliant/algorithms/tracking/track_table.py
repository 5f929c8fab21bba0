"""The living tracks of the tracker as columns of two arrays, and their templates."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F32, I32, I64
from pliant.algorithms.image.patch_sums import BIRTH_FLOATS, TEMPLATE_FLOATS

U, V = 0, 1
"""Sub-pixel position of the point."""
EXTREMUM_U, EXTREMUM_V = 2, 3
"""Sub-pixel position of the last extremum."""
KAPPA = 4
"""Curvature at the last extremum, signed, DN^3."""
LEFT, TOP = 5, 6
"""First pixel of the template relative to the point, pixels of its octave."""
ENERGY = 7
"""Of the template; 0: there is none."""
MOTION_U, MOTION_V = 8, 9
"""From the frame before to this one."""
FLOATS = 10

AGE, STATE, COASTED, PIXEL, SLOT, ALIVE, OCTAVE = 0, 1, 2, 3, 4, 5, 6
"""Age; state; frames coasted; flat pixel of the extremum in this frame or -1; row of the template;
1 or 0; 0 for a template of the full-size image, 1 of half the size."""
INTS = 7


@dataclass
class TrackTable:
    """Tracks in order of their ids, in the first ``count`` rows.

    Templates stay where they are while rows move up: a row names its template by SLOT, and
    free_slots[:free_count] are the unused ones.  By slot too: births, BIRTH_FLOATS grey levels
    around the patch in the frame of birth; deformations, (capacity, 8), the 2x2 map from then to
    now, and the one that the template was made with.
    """

    count: int
    free_count: int
    ids: I64
    floats: F32
    ints: I32
    templates: F32
    births: F32
    deformations: F32
    free_slots: I32

    @staticmethod
    def with_capacity(capacity: int) -> "TrackTable":
        """No tracks, and room for so many."""
        return TrackTable(
            count=0,
            free_count=capacity,
            ids=np.zeros(capacity, np.int64),
            floats=np.zeros((capacity, FLOATS), np.float32),
            ints=np.zeros((capacity, INTS), np.int32),
            templates=np.zeros(capacity * TEMPLATE_FLOATS, np.float32),
            births=np.zeros(capacity * BIRTH_FLOATS, np.float32),
            deformations=np.zeros((capacity, 8), np.float32),
            free_slots=np.arange(capacity - 1, -1, -1, dtype=np.int32),
        )
