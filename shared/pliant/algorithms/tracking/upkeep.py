"""Keeps the set of tracks in order: the dead go, new extrema take their places."""

import numpy as np

from pliant.algorithms.arrays import F32, I32, I64
from pliant.algorithms.kernel import fast_kernel
from pliant.algorithms.tracking.deformation import keep_birth
from pliant.algorithms.tracking.patch_sums import BIRTH_FLOATS, TEMPLATE_FLOATS
from pliant.algorithms.tracking.patch_track import patch_inside, patch_origin, to_octave
from pliant.algorithms.tracking.patches import make_template, patch_strength, patch_tensor
from pliant.algorithms.tracking.pixel_bits import get_bit, no_bits, set_bit, set_square
from pliant.algorithms.tracking.track_table import (
    AGE,
    ALIVE,
    COASTED,
    ENERGY,
    EXTREMUM_U,
    EXTREMUM_V,
    KAPPA,
    LEFT,
    OCTAVE,
    PIXEL,
    SLOT,
    STATE,
    TOP,
    U,
    V,
)
from pliant.algorithms.tracks import EXTREMUM

BINS = 2048
"""Bins of |kappa|, eight to the octave: the upper bits of its float32."""


@fast_kernel
def compact(
    count: int, free_count: int, ids: I64, floats: F32, ints: I32, free_slots: I32
) -> tuple[int, int]:
    """Move living tracks up over dead ones, in order.  Returns (count, free_count)."""
    to = 0
    for i in range(count):
        if ints[i, ALIVE] == 0:
            free_slots[free_count] = ints[i, SLOT]
            free_count += 1
            continue
        if to != i:
            ids[to] = ids[i]
            floats[to] = floats[i]
            ints[to] = ints[i]
        to += 1
    return to, free_count


@fast_kernel
def start_tracks(
    smooth: F32,
    half: F32,
    pixels: I32,
    maxima: F32,
    spacing: int,
    cell: int,
    min_strength: np.float32,
    fine_strength: np.float32,
    min_isotropy: np.float32,
    subpixel: bool,
    patch_refinement: bool,
    next_id: int,
    count: int,
    free_count: int,
    ids: I64,
    floats: F32,
    ints: I32,
    templates: F32,
    births: F32,
    deformations: F32,
    free_slots: I32,
) -> tuple[int, int]:
    """Start tracks at extrema that no track is near to, the strongest of each cell first.

    pixels, maxima: from ``find_maxima``.  Every cell may hold
    its share of the table's capacity; what weak cells leave goes to the strongest of the rest.
    Returns (count, free_count); ids count on from next_id.
    """
    height, width = smooth.shape
    full, coarse = smooth.reshape(-1), half.reshape(-1)
    capacity = len(ids)
    rows, columns = (height + cell - 1) // cell, (width + cell - 1) // cell
    share = capacity // (rows * columns) + 1
    load = np.zeros((rows, columns), np.int32)
    occupied = no_bits(height, width)
    for i in range(count):
        x, y = int(floats[i, U] + np.float32(0.5)), int(floats[i, V] + np.float32(0.5))
        load[y // cell, x // cell] += 1
        set_square(occupied, x, y, spacing, height, width)
    order = _strongest_first(maxima)
    for turn in range(2):
        for rank in range(len(order)):
            if count >= capacity or free_count == 0:
                return count, free_count
            i = order[rank]
            at = int(pixels[i])
            if get_bit(occupied, at):
                continue
            x, y = at % width, at // width
            if turn == 0 and load[y // cell, x // cell] >= share:
                continue
            u, v = np.float32(x), np.float32(y)
            if subpixel:
                u, v = maxima[i, 0], maxima[i, 1]
            slot = free_slots[free_count - 1]
            energy = np.float32(0.0)
            octave, left, top = 0, 0, 0
            if patch_refinement:
                set_bit(occupied, at)
                left, top = patch_origin(u, v)
                if not patch_inside(left, top, width, height):
                    continue
                seen, across, down = full, width, height
                tensor = patch_tensor(full, width, left, top)
                strength, isotropy = patch_strength(tensor)
                if strength < fine_strength:
                    # Little to see so near: a patch of half the size sees twice as far.
                    octave = 1
                    left, top = patch_origin(to_octave(u, 1), to_octave(v, 1))
                    if not patch_inside(left, top, half.shape[1], half.shape[0]):
                        continue
                    seen, across, down = coarse, half.shape[1], half.shape[0]
                    tensor = patch_tensor(coarse, across, left, top)
                    strength, isotropy = patch_strength(tensor)
                    if strength < min_strength:
                        continue
                if strength <= np.float32(0.0) or isotropy < min_isotropy:
                    continue
                make_template(seen, across, left, top, tensor, templates, slot * TEMPLATE_FLOATS)
                energy = tensor[4]
                keep_birth(seen, across, down, left, top, births, slot * BIRTH_FLOATS)
                m = deformations[slot]
                m[:] = 0.0
                m[0] = m[3] = m[4] = m[7] = 1.0
            set_square(occupied, x, y, spacing, height, width)
            load[y // cell, x // cell] += 1
            free_count -= 1
            ids[count] = next_id
            next_id += 1
            track, state = floats[count], ints[count]
            track[U], track[V] = u, v
            track[EXTREMUM_U], track[EXTREMUM_V] = u, v
            track[KAPPA] = maxima[i, 2]
            track[LEFT] = np.float32(left) - to_octave(u, octave)
            track[TOP] = np.float32(top) - to_octave(v, octave)
            track[ENERGY] = energy
            state[AGE] = 0
            state[STATE] = EXTREMUM
            state[COASTED] = 0
            state[PIXEL] = pixels[i]
            state[OCTAVE] = octave
            state[SLOT] = slot
            state[ALIVE] = 1
            count += 1
    return count, free_count


@fast_kernel
def _strongest_first(maxima: F32) -> I32:
    """Order by |kappa| in steps of an eighth of an octave, scan order within one: a radix sort."""
    n = len(maxima)
    order = np.empty(n, np.int32)
    keys = np.empty(n, np.int32)
    strengths = np.abs(maxima[:, 2])
    bits = strengths.view(np.int32)
    starts = np.zeros(BINS + 1, np.int32)
    for i in range(n):
        keys[i] = BINS - 1 - (bits[i] >> 20)
        starts[keys[i] + 1] += 1
    for b in range(BINS):
        starts[b + 1] += starts[b]
    for i in range(n):
        order[starts[keys[i]]] = i
        starts[keys[i]] += 1
    return order
