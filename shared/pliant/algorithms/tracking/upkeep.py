"""Upkeep of the track set: removes dead tracks and starts new ones at extrema."""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.arrays import F32, I32
from pliant.algorithms.image.patch_alignment import make_template, patch_strength, patch_tensor
from pliant.algorithms.image.patch_sums import BIRTH_FLOATS, GAUSSIAN, TEMPLATE_FLOATS
from pliant.algorithms.tracking.advance import (
    FrameImages,
    patch_inside,
    patch_origin,
    to_octave,
)
from pliant.algorithms.tracking.deformation import keep_birth
from pliant.algorithms.tracking.track_table import Patches, Tracks
from pliant.algorithms.tracks import EXTREMUM
from pliant.compiler.kernel import fast_kernel

BINS = 2048
"""Bins of |kappa|, eight to the octave: the upper bits of its float32."""


class BirthLimits(NamedTuple):
    """Where new tracks start.  Limits without a default are parameters."""

    min_strength: np.float32
    fine_strength: np.float32
    min_isotropy: np.float32 = np.float32(0.05)
    """Minimum ratio of the eigenvalues of a new patch's structure tensor: a patch below it lies on
    a contour and slides along it."""
    spacing: int = 2
    """Minimum distance of a new track to all others, px."""
    cell: int = 40
    """Side of the cells over which new tracks are spread evenly, px."""


class _Birth(NamedTuple):
    """The patch of a new track: its octave and first pixel, and its energy, below 0: no use."""

    octave: int
    left: int
    top: int
    energy: np.float32


@fast_kernel
def compact(rows: Tracks, count: int, free_slots: I32, free_count: int) -> tuple[int, int]:
    """Move living tracks up over dead ones, in order.  Returns (count, free_count)."""
    to = 0
    for i in range(count):
        if rows[i].alive == 0:
            free_slots[free_count] = rows[i].slot
            free_count += 1
            continue
        if to != i:
            rows[to] = rows[i]
        to += 1
    return to, free_count


@fast_kernel
def start_tracks(
    now: FrameImages,
    pixels: I32,
    maxima: F32,
    limits: BirthLimits,
    next_id: int,
    rows: Tracks,
    count: int,
    patches: Patches,
    free_slots: I32,
    free_count: int,
) -> tuple[int, int]:
    """Start tracks at extrema that are far from all tracks, the strongest of each cell first.

    pixels, maxima: from ``find_maxima``.  Every cell may use its share of the table's capacity; the
    unused rest goes to the strongest remaining extrema.  Returns (count, free_count); ids continue
    from next_id.
    """
    height, width = now.full.height, now.full.width
    cell, spacing = limits.cell, limits.spacing
    lines, columns = (height + cell - 1) // cell, (width + cell - 1) // cell
    share = len(rows) // (lines * columns) + 1
    load = np.zeros((lines, columns), np.int32)
    occupied = no_bits(height, width)
    for i in range(count):
        x, y = int(rows[i].u + np.float32(0.5)), int(rows[i].v + np.float32(0.5))
        load[y // cell, x // cell] += 1
        set_square(occupied, x, y, spacing, height, width)
    order = _strongest_first(maxima)
    for turn in range(2):
        for rank in range(len(order)):
            if count >= len(rows) or free_count == 0:
                return count, free_count
            i = order[rank]
            at = int(pixels[i])
            if get_bit(occupied, at):
                continue
            x, y = at % width, at // width
            if turn == 0 and load[y // cell, x // cell] >= share:
                continue
            u, v = maxima[i, 0], maxima[i, 1]
            slot = free_slots[free_count - 1]
            set_bit(occupied, at)
            birth = _take_patch(now, u, v, limits, slot, patches)
            if birth.energy < np.float32(0.0):
                continue
            set_square(occupied, x, y, spacing, height, width)
            load[y // cell, x // cell] += 1
            free_count -= 1
            track = rows[count]
            track.id = next_id
            track.u, track.v = u, v
            track.extremum_u, track.extremum_v = u, v
            track.kappa = maxima[i, 2]
            track.left = np.float32(birth.left) - to_octave(u, birth.octave)
            track.top = np.float32(birth.top) - to_octave(v, birth.octave)
            track.energy = birth.energy
            track.motion_u, track.motion_v = np.float32(0.0), np.float32(0.0)
            track.age, track.coasted, track.alive = 0, np.float32(0.0), 1
            track.state = EXTREMUM
            track.pixel, track.slot, track.octave = at, slot, birth.octave
            next_id += 1
            count += 1
    return count, free_count


@fast_kernel
def _take_patch(
    now: FrameImages,
    u: np.float32,
    v: np.float32,
    limits: BirthLimits,
    slot: int,
    patches: Patches,
) -> _Birth:
    """Store the patch around a point, at half size if it has little texture."""
    nothing = _Birth(0, 0, 0, np.float32(-1.0))
    octave = 0
    image = now.full
    left, top = patch_origin(u, v)
    if not patch_inside(image, left, top):
        return nothing
    tensor = patch_tensor(image, left, top, GAUSSIAN)
    strength, isotropy = patch_strength(tensor)
    if strength < limits.fine_strength:
        octave = 1
        image = now.half
        left, top = patch_origin(to_octave(u, 1), to_octave(v, 1))
        if not patch_inside(image, left, top):
            return nothing
        tensor = patch_tensor(image, left, top, GAUSSIAN)
        strength, isotropy = patch_strength(tensor)
        if strength < limits.min_strength:
            return nothing
    if strength <= np.float32(0.0) or isotropy < limits.min_isotropy:
        return nothing
    make_template(image, left, top, tensor, GAUSSIAN, patches.templates, slot * TEMPLATE_FLOATS)
    keep_birth(image, left, top, patches.births, slot * BIRTH_FLOATS)
    m = patches.deformations[slot]
    m[:] = 0.0
    m[0] = m[3] = m[4] = m[7] = 1.0
    return _Birth(octave, left, top, tensor.energy)


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
def no_bits(height: int, width: int) -> NDArray[np.uint64]:
    """Return the cleared bits of an image, by flat pixel in words of 64, and one word more."""
    return np.zeros(height * width // 64 + 2, np.uint64)


@fast_kernel
def get_bit(bits: NDArray[np.uint64], at: int) -> bool:
    """Whether the bit of a flat pixel is set."""
    return bool((bits[at >> 6] >> np.uint64(at & 63)) & np.uint64(1))


@fast_kernel
def set_bit(bits: NDArray[np.uint64], at: int) -> None:
    """Set the bit of a flat pixel."""
    bits[at >> 6] |= np.uint64(1) << np.uint64(at & 63)


@fast_kernel
def set_square(
    bits: NDArray[np.uint64], x: int, y: int, reach: int, height: int, width: int
) -> None:
    """Set the pixels of the image within ``reach`` of (x, y) in both directions.

    reach: at most 31 px, so that a row of bits fits into one word.
    """
    first, last = max(x - reach, 0), min(x + reach, width - 1)
    row_bits = (np.uint64(2) << np.uint64(last - first)) - np.uint64(1)
    for row in range(max(y - reach, 0), min(y + reach, height - 1) + 1):
        at = row * width + first
        shift = np.uint64(at & 63)
        bits[at >> 6] |= row_bits << shift
        bits[(at >> 6) + 1] |= (row_bits >> np.uint64(1)) >> (np.uint64(63) - shift)
