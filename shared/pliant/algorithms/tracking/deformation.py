"""Deformation of patches: templates rotate and scale with their surface.

A patch of the birth frame stops resembling its point once the view has rotated or approached, and
slides along its contours.  The tracks' own motion gives the deformation: its slope over
neighbouring cells is exact to about 0.1 % a frame, far better than one patch could determine.
"""

import numpy as np

from pliant.algorithms.arrays import F32, I32, BoolArray
from pliant.algorithms.image.patch_alignment import make_template, patch_strength, patch_tensor
from pliant.algorithms.image.patch_sums import (
    BIRTH_FLOATS,
    BIRTH_MARGIN,
    BIRTH_SIZE,
    GAUSSIAN,
    PATCH_SIZE,
    TEMPLATE_FLOATS,
)
from pliant.algorithms.image.pixels import Pixels
from pliant.algorithms.image.vector_code import CACHE_LINE_FLOATS, prefetch
from pliant.algorithms.tracking.local_flow import CELL_PX, fit_planes, grid_shape
from pliant.algorithms.tracking.track_table import Patches, Track, Tracks
from pliant.compiler.kernel import fast_kernel

WINDOW_SIDE = PATCH_SIZE + 2
"""Of the samples of a patch with the margin of its gradients."""
AHEAD = 2
"""Number of tracks by which memory is prefetched."""
MIN_CELL_TRACKS = 3
"""Minimum tracks of a cell with a mean motion."""
AGREEMENT_PX = np.float32(1.0)
"""Pixels by which a cell may differ from its neighbours and still show the same surface."""
MAX_SLOPE = np.float32(0.12)
"""Pixels per pixel and frame: more is a depth discontinuity."""
MIN_TURN = np.float32(0.06)
"""Change of a deformation, per pixel, at which a template is renewed: 0.2 px at its rim."""
MAX_GROWTH, MIN_GROWTH = np.float32(4.0), np.float32(0.4)
"""Share of the area beyond which the template of the birth is of no use."""


def slopes_of_motion(tracks: Tracks, affine: F32, height: int, width: int) -> F32:
    """Slope of the tracks' motion in each cell of the grid of local flow.

    affine: six numbers of [A | b], the dominant flow.  Returns (rows, columns, 4) float32
    [du/dx, du/dy, dv/dx, dv/dy], pixels per pixel, without the dominant flow's own.
    """
    rows, columns = grid_shape(width, height)
    motion = np.zeros((rows, columns, 2), np.float32)
    points = np.zeros((rows, columns, 3), np.float32)
    found = np.zeros((rows, columns), np.bool_)
    slopes = np.zeros((rows, columns, 4), np.float32)
    _mean_motion(tracks, affine, motion, points, found)
    fit_planes(motion, found, points, AGREEMENT_PX, slopes)
    return slopes


@fast_kernel
def _mean_motion(tracks: Tracks, affine: F32, motion: F32, points: F32, found: BoolArray) -> None:
    rows, columns = found.shape
    for i in range(len(tracks)):
        du, dv = tracks[i].motion_u, tracks[i].motion_v
        u, v = tracks[i].u - du, tracks[i].v - dv
        row = min(max(int(v) // CELL_PX, 0), rows - 1)
        column = min(max(int(u) // CELL_PX, 0), columns - 1)
        motion[row, column, 0] += du - (affine[0] * u + affine[1] * v + affine[2] - u)
        motion[row, column, 1] += dv - (affine[3] * u + affine[4] * v + affine[5] - v)
        points[row, column, 0] += u
        points[row, column, 1] += v
        points[row, column, 2] += np.float32(1.0)
    for row in range(rows):
        for column in range(columns):
            n = points[row, column, 2]
            if n >= np.float32(MIN_CELL_TRACKS):
                found[row, column] = True
                motion[row, column, 0] /= n
                motion[row, column, 1] /= n
                points[row, column, 0] /= n
                points[row, column, 1] /= n


@fast_kernel
def turn_templates(
    tracks: Tracks, slopes: F32, affine: F32, patches: Patches, window: Pixels, lagging: I32
) -> None:
    """Update every track's deformation by one frame, and renew outdated templates.

    slopes: from ``slopes_of_motion``.  window, lagging: scratch for WINDOW_SIDE x WINDOW_SIDE
    samples, and for as many rows as there are tracks.
    """
    births, templates = patches.births, patches.templates
    turned = _deform(tracks, slopes, affine, patches.deformations, lagging)
    for rank in range(turned):
        # Birth patches exceed the cache: prefetch them.
        ahead = tracks[lagging[min(rank + AHEAD, turned - 1)]].slot * BIRTH_FLOATS
        for start in range(0, BIRTH_FLOATS, CACHE_LINE_FLOATS):
            prefetch(births, ahead + start)
        track = tracks[lagging[rank]]
        m = patches.deformations[track.slot]
        sample_birth(births, track.slot * BIRTH_FLOATS, track, m, window.values)
        tensor = patch_tensor(window, 1, 1, GAUSSIAN)
        if patch_strength(tensor)[0] <= np.float32(0.0):
            continue
        make_template(window, 1, 1, tensor, GAUSSIAN, templates, track.slot * TEMPLATE_FLOATS)
        track.energy = tensor.energy
        m[4], m[5], m[6], m[7] = m[0], m[1], m[2], m[3]


@fast_kernel
def _deform(tracks: Tracks, slopes: F32, affine: F32, deformations: F32, lagging: I32) -> int:
    """Update the deformations.  Writes the rows with an outdated template; returns their number."""
    rows, columns = slopes.shape[0], slopes.shape[1]
    flat, lags = deformations.reshape(-1), 0
    for i in range(len(tracks)):
        track = tracks[i]
        prefetch(flat, tracks[min(i + 4 * AHEAD, len(tracks) - 1)].slot * 8)
        row = min(max(int(track.v) // CELL_PX, 0), rows - 1)
        column = min(max(int(track.u) // CELL_PX, 0), columns - 1)
        slope = slopes[row, column]
        a = affine[0] + min(max(slope[0], -MAX_SLOPE), MAX_SLOPE)
        b = affine[1] + min(max(slope[1], -MAX_SLOPE), MAX_SLOPE)
        c = affine[3] + min(max(slope[2], -MAX_SLOPE), MAX_SLOPE)
        d = affine[4] + min(max(slope[3], -MAX_SLOPE), MAX_SLOPE)
        m = deformations[track.slot]
        m00, m01 = a * m[0] + b * m[2], a * m[1] + b * m[3]
        m10, m11 = c * m[0] + d * m[2], c * m[1] + d * m[3]
        m[0], m[1], m[2], m[3] = m00, m01, m10, m11
        off = max(max(abs(m00 - m[4]), abs(m01 - m[5])), max(abs(m10 - m[6]), abs(m11 - m[7])))
        area = m00 * m11 - m01 * m10
        if off >= MIN_TURN and area >= MIN_GROWTH and area <= MAX_GROWTH:
            lagging[lags] = i
            lags += 1
    return lags


@fast_kernel
def sample_birth(births: F32, offset: int, track: Track, m: F32, window: F32) -> None:
    """Sample the stored birth patch under the deformation m = [m00 m01 m10 m11].

    window: WINDOW_SIDE^2, the patch with a margin of one pixel.  Beyond the stored area its edge is
    repeated.
    """
    scale = np.float32(1.0) / (m[0] * m[3] - m[1] * m[2])
    i00, i01, i10, i11 = m[3] * scale, -m[1] * scale, -m[2] * scale, m[0] * scale
    first_x, first_y = track.left - np.float32(1.0), track.top - np.float32(1.0)
    margin = np.float32(BIRTH_MARGIN)
    first_u = margin - track.left + i00 * first_x + i01 * first_y
    first_v = margin - track.top + i10 * first_x + i11 * first_y
    reach = np.float32(WINDOW_SIDE - 1)
    zero, limit = np.float32(0.0), np.float32(BIRTH_SIZE) - np.float32(1.01)
    # The extremes of a linear map lie at corners; most windows need no clamping.
    inside = (
        first_u + min(i00 * reach, zero) + min(i01 * reach, zero) >= zero
        and first_v + min(i10 * reach, zero) + min(i11 * reach, zero) >= zero
        and first_u + max(i00 * reach, zero) + max(i01 * reach, zero) <= limit
        and first_v + max(i10 * reach, zero) + max(i11 * reach, zero) <= limit
    )
    start = np.uint64(offset)
    for row in range(WINDOW_SIDE):
        row_u, row_v = first_u + i01 * np.float32(row), first_v + i11 * np.float32(row)
        out = window[row * WINDOW_SIDE : (row + 1) * WINDOW_SIDE]
        if inside:
            for column in range(WINDOW_SIDE):
                u, v = row_u + i00 * np.float32(column), row_v + i10 * np.float32(column)
                out[column] = _blend(births, start, u, v)
        else:
            for column in range(WINDOW_SIDE):
                u, v = row_u + i00 * np.float32(column), row_v + i10 * np.float32(column)
                u, v = min(max(u, zero), limit), min(max(v, zero), limit)
                out[column] = _blend(births, start, u, v)


@fast_kernel
def _blend(births: F32, start: np.uint64, u: np.float32, v: np.float32) -> np.float32:
    at_u, at_v = np.int32(u), np.int32(v)
    fu, fv = u - np.float32(at_u), v - np.float32(at_v)
    at = start + np.uint64(at_v * np.int32(BIRTH_SIZE) + at_u)
    one, stride = np.uint64(1), np.uint64(BIRTH_SIZE)
    above = births[at] + fu * (births[at + one] - births[at])
    at += stride
    below = births[at] + fu * (births[at + one] - births[at])
    return above + fv * (below - above)


@fast_kernel
def keep_birth(image: Pixels, left: int, top: int, births: F32, offset: int) -> None:
    """Store the surroundings of a new patch; beyond the image its edge is repeated."""
    for row in range(BIRTH_SIZE):
        y = min(max(top + row - BIRTH_MARGIN, 0), image.height - 1)
        for column in range(BIRTH_SIZE):
            x = min(max(left + column - BIRTH_MARGIN, 0), image.width - 1)
            births[offset + row * BIRTH_SIZE + column] = image.values[y * image.width + x]
