"""One step of every track to the next frame: predict, climb, refine (section 2.3).

A template belongs to an octave: 0 is the full-size image, 1 half the size, where the same patch
has twice the extent.
"""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F32, I32
from pliant.algorithms.image.patch_alignment import (
    Template,
    align_patch,
    make_template,
    patch_strength,
    patch_tensor,
)
from pliant.algorithms.image.patch_sums import (
    GAUSSIAN,
    PATCH_SIZE,
    TEMPLATE_FLOATS,
    prefetch_template,
)
from pliant.algorithms.image.pixels import Pixels
from pliant.algorithms.image.vector_code import prefetch
from pliant.algorithms.tracking.curvature import CURVATURE_BORDER, climb
from pliant.algorithms.tracking.local_flow import Flow, flow_at
from pliant.algorithms.tracking.maxima import subpixel_offset
from pliant.algorithms.tracking.track_table import Track, Tracks
from pliant.algorithms.tracks import COASTING, EXTREMUM
from pliant.compiler.kernel import fast_kernel

AHEAD = 3
"""Number of tracks by which memory is prefetched."""

_COAST_ZNCC = np.float32(0.3)
"""A patch with a small residual but less correlation than this has no contrast left."""

_LEAST_GATE, _WIDEST_GATE = np.float32(0.25), np.float32(1.0)
"""Pixels of the octave: bounds of the gate of the way back."""


class FrameImages(NamedTuple):
    """The images that patches are taken from: smoothed grey levels, also at half size."""

    full: Pixels
    half: Pixels


class StepLimits(NamedTuple):
    """Limits of a step, in pixels of the octave.  Those without a default are parameters.

    interval_s: from the frame before to this one.
    """

    min_curvature: np.float32
    min_zncc: np.float32
    coast_s: np.float32
    interval_s: np.float32
    prediction_weight: np.float32 = np.float32(1.0)
    """lambda of Eq. 5 as a multiple of the track's own last kappa."""
    prediction_sigma: np.float32 = np.float32(3.0)
    """Scale of w in Eq. 5."""
    max_correction: np.float32 = np.float32(5.0)
    """Maximum distance between an extremum and its prediction."""
    min_residual: np.float32 = np.float32(1.5)
    """RMS residual, grey levels, below which min_zncc is not required."""
    extremum_gate: np.float32 = np.float32(1.0)
    """Maximum distance between a patch and its extremum; beyond, it coasts."""
    coast_gate: np.float32 = np.float32(3.0)
    """Maximum distance of a coasting patch from the flow."""
    backward_gate: np.float32 = np.float32(0.7)
    """Maximum distance between the start of a coasting patch with a strength of 1 DN^2 and its
    position tracked backwards; it scales with one over the root of the strength, 0.25 to 1."""
    patch_iterations: int = 4
    """Maximum Gauss-Newton steps of a patch in a frame."""


class _Place(NamedTuple):
    """Position (u, v) of a template, and whether it is reliable."""

    u: np.float32
    v: np.float32
    accepted: bool


@fast_kernel
def advance_tracks(
    before: FrameImages,
    now: FrameImages,
    kappa: Pixels,
    flow: Flow,
    limits: StepLimits,
    order: I32,
    motions: F32,
    tracks: Tracks,
    templates: F32,
    scratch: F32,
) -> None:
    """Move tracks by one frame; ``alive`` marks those that survive.

    kappa: curvature of this frame.  order: the rows, from ``scan_order``.  motions: (len(order), 2)
    and scratch: (TEMPLATE_FLOATS), both overwritten.
    """
    count = len(order)
    for rank in range(count):
        track = tracks[order[rank]]
        motions[rank, 0], motions[rank, 1] = flow_at(flow, track.u, track.v)
    for rank in range(count):
        _prefetch_record(tracks, order[min(rank + 2 * AHEAD, count - 1)])
        ahead = min(rank + AHEAD, count - 1)
        later = tracks[order[ahead]]
        image = now.full if later.octave == 0 else now.half
        _prefetch_track(image, kappa, motions[ahead, 0], motions[ahead, 1], later, templates)
        track = tracks[order[rank]]
        track.age += 1
        du, dv = motions[rank, 0], motions[rank, 1]
        before_u, before_v = track.u, track.v
        pixel = _find_extremum(kappa, du, dv, limits, track)
        fine = track.octave == 0
        alive = _follow_patch(
            before.full if fine else before.half,
            now.full if fine else now.half,
            kappa,
            pixel,
            du,
            dv,
            limits,
            track,
            templates,
            scratch,
        )
        track.motion_u, track.motion_v = track.u - before_u, track.v - before_v
        track.alive = 1 if alive else 0


@fast_kernel
def _prefetch_record(tracks: Tracks, row: int) -> None:
    prefetch(tracks, row)
    prefetch(tracks, row + 1)


@fast_kernel
def _prefetch_track(
    image: Pixels,
    kappa: Pixels,
    du: np.float32,
    dv: np.float32,
    track: Track,
    templates: F32,
) -> None:
    """Prefetch all that a track will read: waiting for it takes longer than the work."""
    prefetch_template(templates, track.slot * TEMPLATE_FLOATS)
    left = int(to_octave(track.u + du, track.octave) + track.left)
    top = int(to_octave(track.v + dv, track.octave) + track.top)
    for row in range(PATCH_SIZE + 1):
        prefetch(image.values, (top + row) * image.width + left)
        prefetch(image.values, (top + row) * image.width + left + PATCH_SIZE)
    to = int(track.v + dv) * kappa.width + int(track.u + du)
    for row in range(-1, 3):
        prefetch(kappa.values, to + row * kappa.width)


@fast_kernel
def scan_order(tracks: Tracks, height: int) -> I32:
    """Rows of tracks by bands of 8 image rows: neighbours share what is in cache."""
    bands = height // 8 + 1
    starts = np.zeros(bands + 1, np.int32)
    order = np.empty(len(tracks), np.int32)
    for i in range(len(tracks)):
        starts[min(max(int(tracks[i].v) >> 3, 0), bands - 1) + 1] += 1
    for band in range(bands):
        starts[band + 1] += starts[band]
    for i in range(len(tracks)):
        band = min(max(int(tracks[i].v) >> 3, 0), bands - 1)
        order[starts[band]] = i
        starts[band] += 1
    return order


@fast_kernel
def to_octave(position: np.float32, octave: int) -> np.float32:
    """A coordinate of the full-size image in the image of an octave."""
    if octave == 0:
        return position
    half = np.float32(0.5)
    return (position + half) * half - half


@fast_kernel
def _from_octave(position: np.float32, octave: int) -> np.float32:
    """A coordinate of the image of an octave in the full-size image."""
    if octave == 0:
        return position
    half = np.float32(0.5)
    return (position + half) * np.float32(2.0) - half


@fast_kernel
def patch_origin(u: np.float32, v: np.float32) -> tuple[int, int]:
    """First pixel of the patch whose centre is within half a pixel of a point."""
    centre = np.float32(0.5 * (PATCH_SIZE - 2))
    return int(np.floor(u - centre)), int(np.floor(v - centre))


@fast_kernel
def patch_inside(image: Pixels, left: int, top: int) -> bool:
    """Whether a patch and the margin of its gradients lie in the image."""
    right, bottom = left + PATCH_SIZE + 1, top + PATCH_SIZE + 1
    return left >= 1 and top >= 1 and right <= image.width and bottom <= image.height


@fast_kernel
def _extremum_position(kappa: Pixels, pixel: int) -> tuple[np.float32, np.float32]:
    """Position of an extremum: of the parabola around it."""
    k, width = kappa.values, kappa.width
    x, y = pixel % width, pixel // width
    u = np.float32(x) + subpixel_offset(k[pixel - 1], k[pixel], k[pixel + 1])
    v = np.float32(y) + subpixel_offset(k[pixel - width], k[pixel], k[pixel + width])
    return u, v


@fast_kernel(inline=True)
def _settle(kappa: Pixels, pixel: int, track: Track) -> None:
    """Put a track on an extremum of this frame."""
    u, v = _extremum_position(kappa, pixel)
    track.extremum_u, track.extremum_v = u, v
    track.kappa = kappa.values[pixel]
    track.pixel = pixel
    track.state = EXTREMUM
    track.coasted = np.float32(0.0)


@fast_kernel(inline=True)
def _find_extremum(
    kappa: Pixels, du: np.float32, dv: np.float32, limits: StepLimits, track: Track
) -> int:
    """Climb from the prediction (Eq. 4-5).  Returns the pixel, or -1."""
    sign = np.float32(1.0) if track.kappa >= np.float32(0.0) else np.float32(-1.0)
    weight = limits.prediction_weight * abs(track.kappa)
    sigma = limits.prediction_sigma
    # An extremum moves with the surface: from its own last position, not from the patch's.
    from_u, from_v = track.u, track.v
    if track.pixel >= 0:
        from_u, from_v = track.extremum_u, track.extremum_v
    u, v = from_u + du, from_v + dv
    pixel = climb(kappa, u, v, sign, weight, sigma)
    if pixel < 0 or sign * kappa.values[pixel] < limits.min_curvature:
        return -1
    off_u, off_v = np.float32(pixel % kappa.width) - u, np.float32(pixel // kappa.width) - v
    if off_u * off_u + off_v * off_v > limits.max_correction * limits.max_correction:
        return -1
    return pixel


@fast_kernel(inline=True)
def _follow_patch(
    image_before: Pixels,
    image: Pixels,
    kappa: Pixels,
    pixel: int,
    du: np.float32,
    dv: np.float32,
    limits: StepLimits,
    track: Track,
    templates: F32,
    scratch: F32,
) -> bool:
    """Refine on the extremum, or coast from the prediction where there is none."""
    u, v = track.u, track.v
    place = _Place(u, v, False)
    on_extremum = False
    if pixel >= 0:
        start_u, start_v = _extremum_position(kappa, pixel)
        if track.pixel >= 0:
            start_u, start_v = u + (start_u - track.extremum_u), v + (start_v - track.extremum_v)
        place = _align_track(
            image, start_u, start_v, limits.max_correction, limits, track, templates
        )
        off_u, off_v = place.u - start_u, place.v - start_v
        gate = limits.extremum_gate
        on_extremum = place.accepted and off_u * off_u + off_v * off_v < gate * gate
    if not on_extremum:
        track.coasted += limits.interval_s
        if track.coasted > limits.coast_s:
            return False
        place = _align_track(image, u + du, v + dv, limits.coast_gate, limits, track, templates)
        if not place.accepted or not _leads_back(
            image_before, image, place.u, place.v, limits, track, scratch
        ):
            return False
    track.u, track.v = place.u, place.v
    if on_extremum:
        _settle(kappa, pixel, track)
    else:
        track.pixel = -1
        track.state = COASTING
    border = np.float32(CURVATURE_BORDER)
    if place.u < border or place.v < border:
        return False
    right, bottom = np.float32(kappa.width) - border, np.float32(kappa.height) - border
    return bool(place.u < right) and bool(place.v < bottom)


@fast_kernel(inline=True)
def _align_track(
    image: Pixels,
    start_u: np.float32,
    start_v: np.float32,
    reach: np.float32,
    limits: StepLimits,
    track: Track,
    templates: F32,
) -> _Place:
    """Align the template of a track from a position in the full-size image, and test it."""
    octave = track.octave
    scale = np.float32(1.0) if octave == 0 else np.float32(0.5)
    found = align_patch(
        image,
        to_octave(start_u, octave) + track.left,
        to_octave(start_v, octave) + track.top,
        Template(templates, track.slot * TEMPLATE_FLOATS, track.energy, GAUSSIAN),
        limits.patch_iterations,
        reach * scale,
    )
    u, v = _from_octave(found.u - track.left, octave), _from_octave(found.v - track.top, octave)
    accepted = found.zncc >= _COAST_ZNCC and found.step <= np.float32(0.5)
    fits = found.zncc > limits.min_zncc or found.residual < limits.min_residual
    return _Place(u, v, bool(accepted and fits))


@fast_kernel(inline=True)
def _leads_back(
    image_before: Pixels,
    image: Pixels,
    u: np.float32,
    v: np.float32,
    limits: StepLimits,
    track: Track,
    scratch: F32,
) -> bool:
    """Whether the patch at (u, v), tracked backwards, returns to the track's position."""
    octave = track.octave
    at_u, at_v = to_octave(u, octave), to_octave(v, octave)
    left, top = patch_origin(at_u, at_v)
    if not patch_inside(image, left, top):
        return False
    tensor = patch_tensor(image, left, top, GAUSSIAN)
    strength, _ = patch_strength(tensor)
    if strength <= np.float32(0.0):
        return False
    make_template(image, left, top, tensor, GAUSSIAN, scratch, 0)
    from_u = to_octave(track.u, octave) + (np.float32(left) - at_u)
    from_v = to_octave(track.v, octave) + (np.float32(top) - at_v)
    # Scales with the noise of a patch: a sharp one must return exactly.
    gate = limits.backward_gate / np.sqrt(strength)
    gate = min(max(gate, _LEAST_GATE), _WIDEST_GATE)
    if octave != 0:
        gate *= np.float32(0.6)
    back = align_patch(
        image_before,
        from_u,
        from_v,
        Template(scratch, 0, tensor.energy, GAUSSIAN),
        limits.patch_iterations,
        np.float32(2.0) * gate,
    )
    off_u, off_v = back.u - from_u, back.v - from_v
    if back.zncc <= np.float32(0.0):
        return False
    return bool(off_u * off_u + off_v * off_v < gate * gate)
