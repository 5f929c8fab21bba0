"""Patches that turn with the view: the slope of the motion, and templates made anew."""

import numpy as np
import pytest

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.image.patch_alignment import (
    PatchTensor,
    Template,
    align_patch,
    make_template,
    patch_tensor,
)
from pliant.algorithms.image.patch_sums import (
    BIRTH_FLOATS,
    BIRTH_MARGIN,
    BIRTH_SIZE,
    GAUSSIAN,
    TEMPLATE_FLOATS,
)
from pliant.algorithms.image.pixels import pixels_of
from pliant.algorithms.tracking.deformation import (
    WINDOW_SIDE,
    keep_birth,
    sample_birth,
    slopes_of_motion,
    turn_templates,
)
from pliant.algorithms.tracking.track_table import TRACK, Patches, Track

SIZE = 64
IDENTITY = np.array([1, 0, 0, 0, 1, 0], np.float32)
TURN = np.array([[1.05, -0.2], [0.18, 0.95]])


def texture(points_px: F64) -> F32:
    """Grey levels of a smooth texture at (..., 2) positions."""
    u, v = points_px[..., 0], points_px[..., 1]
    waves = 30.0 * np.sin(0.45 * u + 0.2 * v) + 25.0 * np.cos(0.4 * v - 0.25 * u + 1.0)
    return (120.0 + waves).astype(np.float32)


def grid(height: int, width: int) -> F64:
    """(height, width, 2) pixel positions."""
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    return np.stack([u, v], axis=-1)


def born_at(point: F64, image: F32) -> tuple[Track, F32]:
    """The row of a track whose patch is centred within half a pixel of a point, and its birth."""
    left, top = (int(np.floor(x - 3.0)) for x in point)
    tracks = np.zeros(1, TRACK)
    tracks["u"], tracks["v"] = point
    tracks["left"], tracks["top"] = left - point[0], top - point[1]
    births = np.zeros(BIRTH_FLOATS, np.float32)
    keep_birth(pixels_of(image), left, top, births, 0)
    return tracks[0], births


def origin(track: Track) -> F64:
    """First pixel of the template relative to the point."""
    return np.array([track["left"], track["top"]], np.float64)


def test_birth_keeps_the_surroundings_and_continues_beyond_the_image() -> None:
    image = np.random.default_rng(0).random((SIZE, SIZE)).astype(np.float32)
    for left, top in ((20, 30), (1, 1), (SIZE - 9, 25)):
        births = np.zeros(BIRTH_FLOATS, np.float32)
        keep_birth(pixels_of(image), left, top, births, 0)
        span = np.arange(BIRTH_SIZE) - BIRTH_MARGIN
        rows, columns = np.clip(top + span, 0, SIZE - 1), np.clip(left + span, 0, SIZE - 1)
        np.testing.assert_array_equal(births.reshape(BIRTH_SIZE, -1), image[np.ix_(rows, columns)])


@pytest.mark.parametrize("M", [np.eye(2), TURN, np.array([[0.55, 0.1], [0.0, 0.6]])])
def test_sampling_equals_plain_numpy(M: F64) -> None:
    point = np.array([30.3, 28.8])
    track, births = born_at(point, np.random.default_rng(1).random((SIZE, SIZE)).astype(np.float32))
    window = np.zeros(WINDOW_SIDE**2, np.float32)
    sample_birth(births, 0, track, M.astype(np.float32).ravel(), window)
    offset = origin(track)
    seen = (grid(WINDOW_SIDE, WINDOW_SIDE) - 1.0 + offset) @ np.linalg.inv(M).T
    at = np.clip(seen - offset + BIRTH_MARGIN, 0.0, BIRTH_SIZE - 1.01)
    low = np.floor(at).astype(int)
    f = at - low
    kept = births.reshape(BIRTH_SIZE, BIRTH_SIZE)
    rows = [
        (1 - f[..., 0]) * kept[low[..., 1] + down, low[..., 0]]
        + f[..., 0] * kept[low[..., 1] + down, low[..., 0] + 1]
        for down in (0, 1)
    ]
    expected = (1 - f[..., 1]) * rows[0] + f[..., 1] * rows[1]
    np.testing.assert_allclose(window.reshape(expected.shape), expected, atol=2e-4)


def test_slopes_are_those_of_an_affine_motion() -> None:
    rng = np.random.default_rng(2)
    height, width, count = 120, 160, 700
    slope = np.array([[0.01, -0.02], [0.015, 0.03]])
    before = rng.uniform(5.0, [width - 5.0, height - 5.0], (count, 2))
    motion = before @ slope.T + [2.0, -1.0]
    tracks = np.zeros(count, TRACK)
    tracks["u"], tracks["v"] = (before + motion).T
    tracks["motion_u"], tracks["motion_v"] = motion.T
    slopes = slopes_of_motion(tracks, IDENTITY, height, width)
    # Damping and the weights of cells that move otherwise take a little of it away.
    np.testing.assert_allclose(slopes[2:-2, 2:-2], np.tile(slope.ravel(), (2, 4, 1)), atol=4e-3)
    itself = np.array([1.01, -0.02, 2.0, 0.015, 1.03, -1.0], np.float32)
    rest = slopes_of_motion(tracks, itself, height, width)
    np.testing.assert_allclose(rest, 0.0, atol=1e-4)


def test_no_tracks_have_no_slopes() -> None:
    slopes = slopes_of_motion(np.zeros(0, TRACK), IDENTITY, 50, 70)
    assert not slopes.any()


def test_a_template_turns_with_the_view() -> None:
    point = np.array([32.4, 31.7])
    track, births = born_at(point, texture(grid(SIZE, SIZE)))
    templates = np.zeros(TEMPLATE_FLOATS, np.float32)
    tracks = np.array([track])
    deformations = np.eye(2, dtype=np.float32).ravel()[[0, 1, 2, 3] * 2][None].copy()
    affine = np.array([*TURN[0], 0.0, *TURN[1], 0.0], np.float32)
    window = pixels_of(np.zeros((WINDOW_SIDE, WINDOW_SIDE), np.float32))
    patches = Patches(templates, births, deformations)
    slopes = np.zeros((4, 4, 4), np.float32)
    turn_templates(tracks, slopes, affine, patches, window, np.zeros(1, np.int32))
    np.testing.assert_allclose(deformations[0], np.tile(TURN.ravel(), 2), atol=1e-6)
    turned = texture((grid(SIZE, SIZE) - point) @ np.linalg.inv(TURN).T + point)
    start = (point + origin(track) + [0.6, -0.5]).astype(np.float32)

    def aligned(template: F32, energy: float) -> tuple[F64, float]:
        patch = Template(template, 0, np.float32(energy), GAUSSIAN)
        found = align_patch(pixels_of(turned), *start, patch, 10, np.float32(4.0))
        return np.array([found.u, found.v]) - origin(track) - point, found.zncc

    error, zncc = aligned(templates, tracks[0]["energy"])
    assert np.linalg.norm(error) < 0.1
    assert zncc > 0.99
    # The patch of the birth itself fits less well.
    left, top = np.rint(point + origin(track)).astype(int)
    image = pixels_of(texture(grid(SIZE, SIZE)))
    # A kernel called from Python returns Python's floats.
    tensor = PatchTensor(*(np.float32(x) for x in patch_tensor(image, left, top, GAUSSIAN)))
    old = np.zeros(TEMPLATE_FLOATS, np.float32)
    make_template(image, left, top, tensor, GAUSSIAN, old, 0)
    assert aligned(old, tensor.energy)[1] < zncc
