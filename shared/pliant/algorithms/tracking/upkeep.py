"""Keeps the set of tracks in order: doubles and the dead go, new extrema take their places."""

import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.arrays import F32, I32, I64
from pliant.algorithms.image.patch_alignment import make_template, patch_strength, patch_tensor
from pliant.algorithms.image.patch_sums import BIRTH_FLOATS, TEMPLATE_FLOATS
from pliant.algorithms.kernel import fast_kernel, leaf_kernel
from pliant.algorithms.tracking.deformation import keep_birth
from pliant.algorithms.tracking.patch_track import patch_inside, patch_origin, to_octave
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


@fast_kernel
def remove_doubles(count: int, floats: F32, ints: I32, owners: I32) -> None:
    """Clear ALIVE of tracks within 1 px of an older one.

    owners: (H, W) scratch.  All living tracks lie a pixel or more inside.  Hardly any has another
    beside it.  A bit for every pixel, which stays in cache as ``owners`` does not, finds those
    that do; only they are looked at closely.
    """
    height, width = owners.shape
    taken, crowded = no_bits(height, width), no_bits(height, width)
    found = False
    for i in range(count):
        if ints[i, ALIVE] == 0:
            continue
        at = _pixel(floats[i], width)
        if any_around(taken, at, width):
            found = True
            for row in range(-1, 2):
                for column in range(-1, 2):
                    set_bit(crowded, at + row * width + column)
        set_bit(taken, at)
    if found:
        taken[:] = np.uint64(0)
        _keep_oldest(count, floats, ints, crowded, taken, owners.reshape(-1), width)


@leaf_kernel
def _keep_oldest(
    count: int,
    floats: F32,
    ints: I32,
    crowded: NDArray[np.uint64],
    taken: NDArray[np.uint64],
    owners: I32,
    width: int,
) -> None:
    """Compare the tracks of crowded pixels with those around.  taken: bits, none of them set."""
    for i in range(count):
        at = _pixel(floats[i], width)
        if ints[i, ALIVE] == 0 or not get_bit(crowded, at):
            continue
        for row in range(-1, 2):
            for column in range(-1, 2):
                beside = at + row * width + column
                if not get_bit(taken, beside):
                    continue
                other = owners[beside]
                du = floats[other, U] - floats[i, U]
                dv = floats[other, V] - floats[i, V]
                if du * du + dv * dv < np.float32(1.0):
                    ints[i, ALIVE] = 0
        if ints[i, ALIVE] == 1:
            owners[at] = i
            set_bit(taken, at)


@leaf_kernel
def _pixel(track: F32, width: int) -> int:
    half = np.float32(0.5)
    return int(track[V] + half) * width + int(track[U] + half)


MAX_REACH = 31
"""Pixels: a row of a square of bits fits into one word."""


@fast_kernel
def no_bits(height: int, width: int) -> NDArray[np.uint64]:
    """Bits of an image, by flat pixel in words of 64, and one word more; none is set."""
    return np.zeros(height * width // 64 + 2, np.uint64)


@leaf_kernel
def get_bit(bits: NDArray[np.uint64], at: int) -> bool:
    """Whether the bit of a flat pixel is set."""
    return bool((bits[at >> 6] >> np.uint64(at & 63)) & np.uint64(1))


@leaf_kernel
def set_bit(bits: NDArray[np.uint64], at: int) -> None:
    """Set the bit of a flat pixel."""
    bits[at >> 6] |= np.uint64(1) << np.uint64(at & 63)


@leaf_kernel
def any_around(bits: NDArray[np.uint64], at: int, width: int) -> bool:
    """Whether a bit of a pixel or of its eight neighbours is set."""
    seen = np.uint64(0)
    for row in range(-1, 2):
        first = at + row * width - 1
        shift = np.uint64(first & 63)
        # The next word's bits come in from above; shifted twice, as by 64 is undefined.
        high = (bits[(first >> 6) + 1] << np.uint64(1)) << (np.uint64(63) - shift)
        seen |= (bits[first >> 6] >> shift) | high
    return bool(seen & np.uint64(7))


@leaf_kernel
def set_square(
    bits: NDArray[np.uint64], x: int, y: int, reach: int, height: int, width: int
) -> None:
    """Set the pixels of the image within ``reach`` (<= MAX_REACH) of (x, y) in both directions."""
    first, last = max(x - reach, 0), min(x + reach, width - 1)
    row_bits = (np.uint64(2) << np.uint64(last - first)) - np.uint64(1)
    for row in range(max(y - reach, 0), min(y + reach, height - 1) + 1):
        at = row * width + first
        shift = np.uint64(at & 63)
        bits[at >> 6] |= row_bits << shift
        bits[(at >> 6) + 1] |= (row_bits >> np.uint64(1)) >> (np.uint64(63) - shift)
