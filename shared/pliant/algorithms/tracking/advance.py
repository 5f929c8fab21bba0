"""One step of every track to the next frame: predict, climb, check, refine (section 2.3)."""

import numpy as np

from pliant.algorithms.arrays import F32, I32
from pliant.algorithms.image.patch_sums import (
    PATCH_SIZE,
    TEMPLATE_FLOATS,
    prefetch_template,
)
from pliant.algorithms.image.vector_code import prefetch
from pliant.algorithms.kernel import fast_kernel, leaf_kernel
from pliant.algorithms.tracking.climbing import climb
from pliant.algorithms.tracking.curvature import CURVATURE_BORDER
from pliant.algorithms.tracking.local_flow import flow_at
from pliant.algorithms.tracking.maxima import subpixel_offset
from pliant.algorithms.tracking.patch_track import (
    align_track,
    leads_back,
    renew_template,
    to_octave,
)
from pliant.algorithms.tracking.step_limits import (
    COAST_FRAMES,
    COAST_GATE,
    EXTREMUM_GATE,
    MAX_CORRECTION,
    MIN_CURVATURE,
    MUTUAL_CHECK,
    MUTUAL_GATE,
    PATCH_REFINEMENT,
    PREDICTION_SIGMA,
    PREDICTION_WEIGHT,
    REFRESH_ZNCC,
    SUBPIXEL,
)
from pliant.algorithms.tracking.track_table import (
    AGE,
    ALIVE,
    COASTED,
    EXTREMUM_U,
    EXTREMUM_V,
    FLOATS,
    INTS,
    KAPPA,
    LEFT,
    MOTION_U,
    MOTION_V,
    OCTAVE,
    PIXEL,
    SLOT,
    STATE,
    TOP,
    U,
    V,
)
from pliant.algorithms.tracks import COASTING, EXTREMUM

AHEAD = 3
"""Tracks by which memory is asked for before it is read."""


@leaf_kernel
def advance_tracks(
    smooth_before: F32,
    smooth: F32,
    half_before: F32,
    half: F32,
    kappa_before: F32,
    kappa: F32,
    flow: F32,
    affine: F32,
    limits: F32,
    switches: I32,
    order: I32,
    motions: F32,
    floats: F32,
    ints: I32,
    templates: F32,
    scratch: F32,
) -> None:
    """Move rows of a track table on by one frame; ALIVE says which survive.

    smooth_before, smooth, kappa_before, kappa: (H, W) of both frames; half_before, half: the
    images at half size.  flow, affine: as in
    ``flow_at``.  limits, switches: see the columns above.  order: the rows, from ``scan_order``.
    motions: (len(order), 2) and scratch: (TEMPLATE_FLOATS), both overwritten.
    """
    height, width = kappa.shape
    full_before, full = smooth_before.reshape(-1), smooth.reshape(-1)
    coarse_before, coarse = half_before.reshape(-1), half.reshape(-1)
    coarse_height, coarse_width = half.shape
    k_before, k = kappa_before.reshape(-1), kappa.reshape(-1)
    count = len(order)
    for rank in range(count):
        track = floats[order[rank]]
        motions[rank, 0], motions[rank, 1] = flow_at(flow, affine, track[U], track[V])
    for rank in range(count):
        i = order[rank]
        far = order[min(rank + 2 * AHEAD, count - 1)]
        prefetch(floats.reshape(-1), far * FLOATS)
        prefetch(ints.reshape(-1), far * INTS)
        ahead = min(rank + AHEAD, count - 1)
        _prefetch_track(
            full if ints[order[ahead], OCTAVE] == 0 else coarse,
            width if ints[order[ahead], OCTAVE] == 0 else coarse_width,
            k_before,
            k,
            width,
            motions[ahead, 0],
            motions[ahead, 1],
            floats[order[ahead]],
            ints[order[ahead]],
            templates,
        )
        track, state = floats[i], ints[i]
        state[AGE] += 1
        du, dv = motions[rank, 0], motions[rank, 1]
        before_u, before_v = track[U], track[V]
        pixel = _find_extremum(k_before, k, width, height, du, dv, limits, switches, track, state)
        if switches[PATCH_REFINEMENT] != 0:
            fine = state[OCTAVE] == 0
            alive = _follow_patch(
                full_before if fine else coarse_before,
                full if fine else coarse,
                width if fine else coarse_width,
                height if fine else coarse_height,
                k,
                width,
                height,
                pixel,
                du,
                dv,
                limits,
                switches,
                track,
                state,
                templates,
                scratch,
            )
        else:
            alive = pixel >= 0
            if alive:
                _settle(k, width, pixel, switches[SUBPIXEL] != 0, track, state)
                track[U], track[V] = track[EXTREMUM_U], track[EXTREMUM_V]
        track[MOTION_U], track[MOTION_V] = track[U] - before_u, track[V] - before_v
        state[ALIVE] = 1 if alive else 0


@leaf_kernel
def _prefetch_track(
    image: F32,
    image_width: int,
    kappa_before: F32,
    kappa: F32,
    width: int,
    du: np.float32,
    dv: np.float32,
    track: F32,
    state: I32,
    templates: F32,
) -> None:
    """Ask for all that a track is about to read: waiting for it takes longer than the work."""
    prefetch_template(templates, state[SLOT] * TEMPLATE_FLOATS)
    octave = state[OCTAVE]
    left = int(to_octave(track[U] + du, octave) + track[LEFT])
    top = int(to_octave(track[V] + dv, octave) + track[TOP])
    for row in range(PATCH_SIZE + 1):
        prefetch(image, (top + row) * image_width + left)
        prefetch(image, (top + row) * image_width + left + PATCH_SIZE)
    to = int(track[V] + dv) * width + int(track[U] + du)
    at = int(track[EXTREMUM_V]) * width + int(track[EXTREMUM_U])
    for row in range(-1, 3):
        prefetch(kappa, to + row * width)
        prefetch(kappa_before, at + row * width)


@fast_kernel
def scan_order(count: int, floats: F32, height: int) -> I32:
    """Rows of a track table by bands of 8 image rows: neighbours share what is in cache."""
    bands = height // 8 + 1
    starts = np.zeros(bands + 1, np.int32)
    order = np.empty(count, np.int32)
    for i in range(count):
        starts[min(max(int(floats[i, V]) >> 3, 0), bands - 1) + 1] += 1
    for band in range(bands):
        starts[band + 1] += starts[band]
    for i in range(count):
        band = min(max(int(floats[i, V]) >> 3, 0), bands - 1)
        order[starts[band]] = i
        starts[band] += 1
    return order


@leaf_kernel
def extremum_position(
    kappa: F32, width: int, pixel: int, subpixel: bool
) -> tuple[np.float32, np.float32]:
    """Position of an extremum: of its pixel, or of the parabola around it."""
    x, y = pixel % width, pixel // width
    u, v = np.float32(x), np.float32(y)
    if subpixel:
        u += subpixel_offset(kappa[pixel - 1], kappa[pixel], kappa[pixel + 1])
        v += subpixel_offset(kappa[pixel - width], kappa[pixel], kappa[pixel + width])
    return u, v


@leaf_kernel
def _settle(kappa: F32, width: int, pixel: int, subpixel: bool, track: F32, state: I32) -> None:
    """Put a track on an extremum of this frame."""
    u, v = extremum_position(kappa, width, pixel, subpixel)
    track[EXTREMUM_U], track[EXTREMUM_V] = u, v
    track[KAPPA] = kappa[pixel]
    state[PIXEL] = pixel
    state[STATE] = EXTREMUM
    state[COASTED] = 0


@leaf_kernel
def _find_extremum(
    kappa_before: F32,
    kappa: F32,
    width: int,
    height: int,
    du: np.float32,
    dv: np.float32,
    limits: F32,
    switches: I32,
    track: F32,
    state: I32,
) -> int:
    """Climb from the prediction (Eq. 4-5), and back again.  Returns the pixel, or -1."""
    sign = np.float32(1.0) if track[KAPPA] >= np.float32(0.0) else np.float32(-1.0)
    weight = limits[PREDICTION_WEIGHT] * abs(track[KAPPA])
    sigma = limits[PREDICTION_SIGMA]
    # An extremum moves with the surface: from where it was, not from where the patch has put it.
    from_u, from_v = track[U], track[V]
    if state[PIXEL] >= 0:
        from_u, from_v = track[EXTREMUM_U], track[EXTREMUM_V]
    u, v = from_u + du, from_v + dv
    pixel = climb(kappa, width, height, u, v, sign, weight, sigma)
    if pixel < 0 or sign * kappa[pixel] < limits[MIN_CURVATURE]:
        return -1
    off_u, off_v = np.float32(pixel % width) - u, np.float32(pixel // width) - v
    if off_u * off_u + off_v * off_v > limits[MAX_CORRECTION] * limits[MAX_CORRECTION]:
        return -1
    if switches[MUTUAL_CHECK] != 0 and state[PIXEL] >= 0:
        subpixel = switches[SUBPIXEL] != 0
        at_u, at_v = extremum_position(kappa, width, pixel, subpixel)
        back = climb(kappa_before, width, height, at_u - du, at_v - dv, sign, weight, sigma)
        if back < 0:
            return -1
        back_u, back_v = extremum_position(kappa_before, width, back, subpixel)
        off_u, off_v = back_u - from_u, back_v - from_v
        if off_u * off_u + off_v * off_v > limits[MUTUAL_GATE] * limits[MUTUAL_GATE]:
            return -1
    return pixel


@leaf_kernel
def _follow_patch(
    image_before: F32,
    image: F32,
    image_width: int,
    image_height: int,
    kappa: F32,
    width: int,
    height: int,
    pixel: int,
    du: np.float32,
    dv: np.float32,
    limits: F32,
    switches: I32,
    track: F32,
    state: I32,
    templates: F32,
    scratch: F32,
) -> bool:
    """Refine on the extremum, or coast from the prediction where there is none."""
    u, v = track[U], track[V]
    subpixel = switches[SUBPIXEL] != 0
    accepted = False
    on_extremum = False
    to_u, to_v, zncc = u, v, np.float32(-1.0)
    if pixel >= 0:
        start_u, start_v = extremum_position(kappa, width, pixel, subpixel)
        if state[PIXEL] >= 0:
            start_u, start_v = u + (start_u - track[EXTREMUM_U]), v + (start_v - track[EXTREMUM_V])
        to_u, to_v, zncc, accepted = align_track(
            image,
            image_width,
            image_height,
            start_u,
            start_v,
            limits[MAX_CORRECTION],
            limits,
            switches,
            track,
            state,
            templates,
        )
        off_u, off_v = to_u - start_u, to_v - start_v
        gate = limits[EXTREMUM_GATE]
        on_extremum = off_u * off_u + off_v * off_v < gate * gate
        accepted = accepted and on_extremum
    if not accepted:
        on_extremum = False
        if state[COASTED] >= switches[COAST_FRAMES]:
            return False
        to_u, to_v, zncc, accepted = align_track(
            image,
            image_width,
            image_height,
            u + du,
            v + dv,
            limits[COAST_GATE],
            limits,
            switches,
            track,
            state,
            templates,
        )
        accepted = accepted and leads_back(
            image_before,
            image,
            image_width,
            image_height,
            to_u,
            to_v,
            limits,
            switches,
            track,
            state,
            scratch,
        )
    if not accepted:
        return False
    track[U], track[V] = to_u, to_v
    if on_extremum:
        _settle(kappa, width, pixel, subpixel, track, state)
    else:
        state[PIXEL] = -1
        state[STATE] = COASTING
        state[COASTED] += 1
    if zncc < limits[REFRESH_ZNCC] and on_extremum:
        renew_template(image, image_width, image_height, limits, track, state, templates, scratch)
    border = np.float32(CURVATURE_BORDER)
    if to_u < border or to_v < border:
        return False
    return bool(to_u < np.float32(width) - border) and bool(to_v < np.float32(height) - border)
