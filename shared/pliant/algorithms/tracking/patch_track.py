"""What a track does with its patch: align it, check the way back, and take it anew.

A template belongs to an octave: 0 is the full-size image, 1 half the size, where the same patch
sees twice as far.
"""

import numpy as np

from pliant.algorithms.arrays import F32, I32
from pliant.algorithms.image.patch_alignment import (
    align_patch,
    make_template,
    patch_strength,
    patch_tensor,
)
from pliant.algorithms.image.patch_sums import PATCH_SIZE, TEMPLATE_FLOATS
from pliant.algorithms.kernel import leaf_kernel
from pliant.algorithms.tracking.step_limits import (
    BACKWARD_GATE,
    MIN_RESIDUAL,
    MIN_STRENGTH,
    MIN_ZNCC,
    PATCH_ITERATIONS,
)
from pliant.algorithms.tracking.track_table import ENERGY, LEFT, OCTAVE, SLOT, TOP, U, V

COAST_ZNCC = np.float32(0.3)
"""A patch with a small residual but less correlation than this has no contrast left."""

_LEAST_GATE, _WIDEST_GATE = np.float32(0.25), np.float32(1.0)
"""Pixels of the octave: bounds of the gate of the way back."""


@leaf_kernel
def to_octave(position: np.float32, octave: int) -> np.float32:
    """A coordinate of the full-size image in the image of an octave."""
    if octave == 0:
        return position
    half = np.float32(0.5)
    return (position + half) * half - half


@leaf_kernel
def from_octave(position: np.float32, octave: int) -> np.float32:
    """A coordinate of the image of an octave in the full-size image."""
    if octave == 0:
        return position
    half = np.float32(0.5)
    return (position + half) * np.float32(2.0) - half


@leaf_kernel
def align_track(
    image: F32,
    image_width: int,
    image_height: int,
    start_u: np.float32,
    start_v: np.float32,
    reach: np.float32,
    limits: F32,
    switches: I32,
    track: F32,
    state: I32,
    templates: F32,
) -> tuple[np.float32, np.float32, np.float32, bool]:
    """Align a template.  Returns the point (u, v), the correlation, and whether it holds."""
    octave = state[OCTAVE]
    scale = np.float32(1.0) if octave == 0 else np.float32(0.5)
    left, top, zncc, residual, step = align_patch(
        image,
        image_width,
        image_height,
        to_octave(start_u, octave) + track[LEFT],
        to_octave(start_v, octave) + track[TOP],
        templates,
        state[SLOT] * TEMPLATE_FLOATS,
        track[ENERGY],
        switches[PATCH_ITERATIONS],
        reach * scale,
    )
    u, v = from_octave(left - track[LEFT], octave), from_octave(top - track[TOP], octave)
    return u, v, zncc, _correlates(zncc, residual, step, limits)


@leaf_kernel
def _correlates(zncc: np.float32, residual: np.float32, step: np.float32, limits: F32) -> bool:
    """Whether an aligned patch shows the point still."""
    if zncc < COAST_ZNCC or step > np.float32(0.5):
        return False
    return bool(zncc > limits[MIN_ZNCC]) or bool(residual < limits[MIN_RESIDUAL])


@leaf_kernel
def patch_origin(u: np.float32, v: np.float32) -> tuple[int, int]:
    """First pixel of the patch whose centre is within half a pixel of a point."""
    centre = np.float32(0.5 * (PATCH_SIZE - 2))
    return int(np.floor(u - centre)), int(np.floor(v - centre))


@leaf_kernel
def patch_inside(left: int, top: int, width: int, height: int) -> bool:
    """Whether a patch and the margin of its gradients lie in the image."""
    return (
        left >= 1 and top >= 1 and left + PATCH_SIZE + 1 <= width and top + PATCH_SIZE + 1 <= height
    )


@leaf_kernel
def leads_back(
    image_before: F32,
    image: F32,
    image_width: int,
    image_height: int,
    u: np.float32,
    v: np.float32,
    limits: F32,
    switches: I32,
    track: F32,
    state: I32,
    scratch: F32,
) -> bool:
    """Whether the patch seen now at (u, v) is found again where the track was."""
    octave = state[OCTAVE]
    at_u, at_v = to_octave(u, octave), to_octave(v, octave)
    left, top = patch_origin(at_u, at_v)
    if not patch_inside(left, top, image_width, image_height):
        return False
    tensor = patch_tensor(image, image_width, left, top)
    strength, _ = patch_strength(tensor)
    if strength <= np.float32(0.0):
        return False
    make_template(image, image_width, left, top, tensor, scratch, 0)
    from_u = to_octave(track[U], octave) + (np.float32(left) - at_u)
    from_v = to_octave(track[V], octave) + (np.float32(top) - at_v)
    # As the noise of a patch: what is sharp has to come back exactly.
    gate = limits[BACKWARD_GATE] / np.sqrt(strength)
    gate = min(max(gate, _LEAST_GATE), _WIDEST_GATE)
    if octave != 0:
        gate *= np.float32(0.6)
    back_u, back_v, zncc, _, _ = align_patch(
        image_before,
        image_width,
        image_height,
        from_u,
        from_v,
        scratch,
        0,
        tensor[4],
        switches[PATCH_ITERATIONS],
        np.float32(2.0) * gate,
    )
    back_u -= from_u
    back_v -= from_v
    if zncc <= np.float32(0.0):
        return False
    return bool(back_u * back_u + back_v * back_v < gate * gate)


@leaf_kernel
def renew_template(
    image: F32,
    image_width: int,
    image_height: int,
    limits: F32,
    track: F32,
    state: I32,
    templates: F32,
    scratch: F32,
) -> None:
    """Take the patch anew where the track is now, unless there is too little to see."""
    octave = state[OCTAVE]
    at_u, at_v = to_octave(track[U], octave), to_octave(track[V], octave)
    left, top = patch_origin(at_u, at_v)
    if not patch_inside(left, top, image_width, image_height):
        return
    tensor = patch_tensor(image, image_width, left, top)
    if patch_strength(tensor)[0] < max(limits[MIN_STRENGTH], np.float32(1e-3)):
        return
    make_template(image, image_width, left, top, tensor, templates, state[SLOT] * TEMPLATE_FLOATS)
    track[ENERGY] = tensor[4]
    track[LEFT] = np.float32(left) - at_u
    track[TOP] = np.float32(top) - at_v
