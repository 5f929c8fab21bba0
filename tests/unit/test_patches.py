"""Patch alignment: its sums, its Jacobian, its convergence and what it is blind to."""

import numba
import numpy as np
import pytest

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.image.patch_alignment import (
    PatchTensor,
    Template,
    align_patch,
    make_template,
    patch_strength,
    patch_tensor,
)
from pliant.algorithms.image.patch_sums import (
    GAUSSIAN,
    PATCH_PIXELS,
    PATCH_SIZE,
    TEMPLATE_FLOATS,
    UNIFORM,
    patch_sums,
)
from pliant.algorithms.image.pixels import pixels_of

SIZE = 48


# Not cached: a cached copy would not notice that the constants of patch_sums have changed.
@numba.njit
def call_sums(
    image: F32, width: int, u: np.float32, v: np.float32, templates: F32, window: F32
) -> F64:
    column, row = int(u), int(v)
    a, b, c, d, e = patch_sums(
        image,
        np.uint64(row * width + column),
        np.uint64(width),
        u - np.float32(column),
        v - np.float32(row),
        templates,
        np.uint64(0),
        window,
    )
    return np.array([a, b, c, d, e], np.float64)


def texture(shift_u: float = 0.0, shift_v: float = 0.0) -> F32:
    """A smooth image whose content moves by (shift_u, shift_v)."""
    v, u = np.mgrid[0:SIZE, 0:SIZE].astype(np.float64)
    u, v = u - shift_u, v - shift_v
    waves = 30.0 * np.sin(0.55 * u + 0.2 * v) + 25.0 * np.cos(0.5 * v - 0.3 * u + 1.0)
    return (120.0 + waves + 15.0 * np.sin(0.31 * (u + v))).astype(np.float32)


def sample(image: F32, u: float, v: float) -> F64:
    """(PATCH_PIXELS) bilinear samples of a patch that begins at (u, v)."""
    x, y = int(u), int(v)
    du, dv = u - x, v - y
    block = image[y : y + PATCH_SIZE + 1, x : x + PATCH_SIZE + 1].astype(np.float64)
    rows = (1.0 - du) * block[:, :-1] + du * block[:, 1:]
    return ((1.0 - dv) * rows[:-1] + dv * rows[1:]).ravel()


def template_of(image: F32, left: int, top: int, window: F32 = GAUSSIAN) -> tuple[Template, float]:
    templates = np.zeros(TEMPLATE_FLOATS, np.float32)
    # A kernel called from Python returns Python's floats.
    seen = patch_tensor(pixels_of(image), left, top, window)
    tensor = PatchTensor(*(np.float32(x) for x in seen))
    strength, _ = patch_strength(tensor)
    if strength > 0.0:
        make_template(pixels_of(image), left, top, tensor, window, templates, 0)
    return Template(templates, 0, tensor.energy, window), strength


@pytest.mark.parametrize("window", [GAUSSIAN, UNIFORM])
def test_sums_equal_plain_numpy(window: F32) -> None:
    image = texture()
    templates = np.random.default_rng(0).normal(size=TEMPLATE_FLOATS).astype(np.float32)
    v = sample(image, 13.3, 20.6)
    w, t = window.astype(np.float64), templates.reshape(3, PATCH_PIXELS).astype(np.float64)
    expected = [(w * v).sum(), (w * v * v).sum(), *(t @ v)]
    found = call_sums(image.ravel(), SIZE, np.float32(13.3), np.float32(20.6), templates, window)
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=0.05)


@pytest.mark.parametrize("window", [GAUSSIAN, UNIFORM])
def test_templates_equal_plain_numpy(window: F32) -> None:
    """Offset and gain projected out of both gradients, then the inverse of the tensor."""
    image = texture()
    template, strength = template_of(image, 20, 18, window)
    block = image[17:27, 19:29].astype(np.float64)
    w = window.astype(np.float64)
    t = block[1:-1, 1:-1].ravel()
    x = 0.5 * (block[1:-1, 2:] - block[1:-1, :-2]).ravel()
    y = 0.5 * (block[2:, 1:-1] - block[:-2, 1:-1]).ravel()
    basis = np.stack([np.ones(PATCH_PIXELS), t - (w @ t) / w.sum()])
    J = np.stack([x, y])
    for b in basis:
        J -= np.outer(J @ (w * b) / ((b * b) @ w), b)
    tensor = (J * w) @ J.T
    eigenvalues = np.linalg.eigvalsh(tensor)
    assert template.energy == pytest.approx(w @ basis[1] ** 2, rel=1e-4)
    assert strength == pytest.approx(eigenvalues[0] / PATCH_PIXELS, rel=1e-3)
    isotropy = patch_strength(patch_tensor(pixels_of(image), 20, 18, window))[1]
    assert isotropy == pytest.approx(eigenvalues[0] / eigenvalues[1], rel=1e-3)
    found = template.values.reshape(3, PATCH_PIXELS)
    np.testing.assert_allclose(found[0], w * basis[1] / template.energy, atol=1e-6)
    expected = -np.linalg.inv(tensor) @ (w * J)
    np.testing.assert_allclose(found[1:], expected, atol=1e-3 * np.abs(expected).max())


def test_steps_are_the_inverse_of_finite_differences() -> None:
    """Moving the image by h must give sums of -h (the step that leads back), to first order."""
    image = texture()
    template, _ = template_of(image, 20, 18)
    t = template.values.reshape(3, PATCH_PIXELS).astype(np.float64)
    h = 1e-2
    for axis in range(2):
        shift = np.eye(2)[axis] * h
        ahead = texture(*shift)[18:26, 20:28].astype(np.float64).ravel()
        behind = texture(*-shift)[18:26, 20:28].astype(np.float64).ravel()
        derivative = t[1:] @ (ahead - behind) / (2.0 * h)
        np.testing.assert_allclose(derivative, np.eye(2)[axis], atol=0.08)


@pytest.mark.parametrize("gain", [0.7, 1.0, 1.4])
@pytest.mark.parametrize("shift", [(0.0, 0.0), (0.6, -0.4), (-1.3, 0.9)])
def test_alignment_finds_the_shift_at_any_exposure(gain: float, shift: tuple[float, float]) -> None:
    template, strength = template_of(texture(), 20, 18)
    assert strength > 1.0
    image = np.float32(gain) * texture(*shift) - np.float32(11.0)
    start = np.float32(20.0), np.float32(18.0)
    found = align_patch(pixels_of(image), *start, template, 15, np.float32(4.0))
    np.testing.assert_allclose([found.u - 20.0, found.v - 18.0], shift, atol=0.03)
    assert found.zncc > 0.99
    assert found.residual < 3.0
    assert found.step < 0.05


def test_flat_and_one_dimensional_patches_have_no_strength() -> None:
    flat = np.full((SIZE, SIZE), 90.0, np.float32)
    assert template_of(flat, 20, 20)[1] == 0.0
    stripes = np.tile(20.0 * np.sin(np.arange(SIZE) * 0.7), (SIZE, 1)).astype(np.float32)
    assert template_of(stripes, 20, 20)[1] == 0.0


@pytest.mark.parametrize("start", [(-3.0, 10.0), (10.0, 46.0), (np.nan, 10.0)])
def test_alignment_outside_of_the_image_fails(start: tuple[float, float]) -> None:
    template, _ = template_of(texture(), 20, 18)
    at = np.float32(start[0]), np.float32(start[1])
    found = align_patch(pixels_of(texture()), *at, template, 5, np.float32(4.0))
    assert found.zncc == -1.0
