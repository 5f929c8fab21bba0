"""Matching costs and semi-global matching against plain numpy, and how views are made small."""

import numpy as np
import pytest
from stereo_scene import CAMERA, pose, true_inverse, view

from pliant.algorithms.arrays import F32, F64, U8, U16
from pliant.algorithms.geometry import inverse, transform
from pliant.algorithms.stereo.matching import (
    NOISE_VARIANCE,
    WORST,
    inverse_depths_between,
    matching_costs,
    textured,
)
from pliant.algorithms.stereo.semi_global import Penalties, best_steps, path_sums
from pliant.algorithms.stereo.views import (
    NOT_SHOWN,
    Motion,
    motion,
    parallax_px,
    reduction,
    shrunk,
    shrunk_camera,
)


def plain_costs(
    reference: U8, sources: U8, moved: Motion, base: F32, offsets: F32, radius: int
) -> F64:
    """1 - ZNCC of windows, one at a time in double precision."""
    height, width = reference.shape
    v, u = np.mgrid[0:height, 0:width].astype(np.float64)
    costs = np.full((height, width, len(offsets)), float(WORST))
    around = [np.clip(np.add.outer(np.arange(n), np.arange(-radius, radius + 1)), 0, n - 1)
              for n in (height, width)]  # fmt: skip
    for d, offset in enumerate(offsets):
        found: list[list[list[float]]] = [[[] for _ in range(width)] for _ in range(height)]
        for A, b, image in zip(moved.homographies, moved.translations, sources, strict=True):
            p = np.stack([u, v, np.ones_like(u)], axis=-1) @ A.T
            p = p + b * (base.astype(np.float64) + offset)[..., None]
            x, y = p[..., 0] / p[..., 2], p[..., 1] / p[..., 2]
            inside = (p[..., 2] > 0) & (x >= -0.5) & (x <= width - 0.5)
            inside &= (y >= -0.5) & (y <= height - 0.5)
            x, y = np.clip(x, 0, width - 1), np.clip(y, 0, height - 1)
            i, j = np.minimum(x.astype(int), width - 2), np.minimum(y.astype(int), height - 2)
            four = [image[j + k, i + m].astype(np.float64) for k in (0, 1) for m in (0, 1)]
            inside &= np.min(four, axis=0) > NOT_SHOWN
            x, y = np.where(p[..., 2] > 0, x, 0.0), np.where(p[..., 2] > 0, y, 0.0)
            q, r = x - i, y - j
            warped = (1 - r) * ((1 - q) * four[0] + q * four[1])
            warped += r * ((1 - q) * four[2] + q * four[3])
            warped = np.where(np.min(four, axis=0) > NOT_SHOWN, warped, 0.0)
            for row, column in zip(*np.nonzero(inside), strict=True):
                window = np.ix_(around[0][row], around[1][column])
                one, other = reference[window].astype(np.float64), warped[window]
                joint = np.mean(one * other) - one.mean() * other.mean()
                zncc = joint / np.sqrt((one.var() + 4.0) * (other.var() + 4.0))
                found[row][column].append(float(np.clip(1.0 - zncc, 0.0, 1.0)))
        for row in range(height):
            for column in range(width):
                best = sorted(found[row][column])
                best = best[: (2 * len(best) + 2) // 3]
                if best:
                    costs[row, column, d] = WORST * np.mean(best)
    return costs


@pytest.mark.parametrize("radius", [2, 3])
def test_costs_are_those_of_plain_numpy(radius: int) -> None:
    cut = slice(30, 46), slice(50, 74)
    steps = (1, 2, 4, 6)
    views = [view(step) for step in (3, *steps)]
    images = np.stack([each.grey[cut] for each in views])
    images[1, 3:6, 4:9] = NOT_SHOWN
    camera = CAMERA.__class__(width=24, height=16, fx=105.0, fy=105.0, cx=13.5, cy=17.5)
    moved = motion(camera, pose(3), np.stack([pose(step) for step in steps]))
    base = np.full((16, 24), 0.3, np.float32) + np.linspace(0.0, 0.1, 24, dtype=np.float32)
    offsets = np.array([-0.1, 0.0, 0.15], np.float32)
    found = matching_costs(images[0], images[1:], moved, base, offsets, radius)
    plain = plain_costs(images[0], images[1:], moved, base, offsets, radius)
    assert np.abs(found - plain).max() < 1.6  # pixels of 1/16 grey, and the cost rounded
    assert found.std() > 30.0


def test_the_least_cost_is_at_the_true_depth() -> None:
    moved = motion(CAMERA, pose(3), np.stack([pose(step) for step in (1, 2, 5)]))
    images = np.stack([view(step).grey for step in (1, 2, 5)])
    base = true_inverse(3).astype(np.float32)
    offsets = np.linspace(-0.1, 0.1, 5).astype(np.float32)
    costs = matching_costs(view(3).grey, images, moved, base, offsets, 3)
    assert np.mean(costs.argmin(axis=2) == 2) > 0.9


def test_what_no_image_shows_costs_most() -> None:
    image = view(0).grey
    away = np.eye(4)
    away[0, 3] = 100.0
    moved = motion(CAMERA, np.eye(4), away[None])
    base, one = np.full(image.shape, 0.5, np.float32), np.zeros(3, np.float32)
    assert (matching_costs(image, image[None], moved, base, one, 2) == WORST).all()
    none = Motion(np.zeros((0, 3, 3)), np.zeros((0, 3)))
    assert (matching_costs(image, image[:0, None], none, base, one, 2) == WORST).all()


def plain_sums(costs: U8, grey: U8, penalties: Penalties) -> U16:
    """Equation 13, one path at a time."""
    height, width, depths = costs.shape
    jumps = penalties.of_jumps().astype(np.int64)
    total = np.zeros(costs.shape, np.int64)
    for du, dv in ((1, 0), (-1, 0), (0, 1), (0, -1), (1, 1), (-1, -1), (1, -1), (-1, 1)):
        path = np.zeros(costs.shape, np.int64)
        rows = range(height) if dv >= 0 else range(height - 1, -1, -1)
        columns = range(width) if du >= 0 else range(width - 1, -1, -1)
        for v in rows:
            for u in columns:
                before_u, before_v = u - du, v - dv
                path[v, u] = costs[v, u]
                if not (0 <= before_u < width and 0 <= before_v < height):
                    continue
                last = path[before_v, before_u]
                change = abs(int(grey[v, u]) - int(grey[before_v, before_u]))
                for d in range(depths):
                    options = [last[d], last.min() + jumps[change]]
                    options += [
                        last[k] + penalties.small for k in (d - 1, d + 1) if 0 <= k < depths
                    ]
                    path[v, u, d] += min(options) - last.min()
        total += path
    return total.astype(np.uint16)


def test_path_costs_are_those_of_plain_numpy() -> None:
    generator = np.random.default_rng(0)
    for depths in (3, 9, 20):
        costs = generator.integers(0, 256, (7, 11, depths), dtype=np.uint8)
        grey = generator.integers(0, 256, (7, 11), dtype=np.uint8)
        for penalties in (Penalties(), Penalties(10, 40, 5.0)):
            found = path_sums(costs, grey, penalties)
            np.testing.assert_array_equal(found, plain_sums(costs, grey, penalties))


def test_a_parabola_finds_the_minimum_between_steps() -> None:
    true = np.linspace(3.0, 5.0, 40)
    steps = np.arange(9.0)
    row = np.minimum(60.0 * np.abs(steps - true[:, None]) ** 2, 255.0)
    costs = np.tile(np.rint(row).astype(np.uint8), (20, 1, 1))
    found = best_steps(costs, np.full((20, 40), 100, np.uint8), Penalties(2, 20, 20.0))
    assert np.abs(found.steps - true).max() < 0.1
    assert found.distinctness.min() > 0.5


def test_depths_that_all_match_alike_are_not_distinct() -> None:
    costs = np.full((10, 12, 9), 100, np.uint8)
    found = best_steps(costs, np.full((10, 12), 100, np.uint8), Penalties())
    assert found.distinctness.max() == 0.0


def test_inverse_depths_are_even_and_not_too_many() -> None:
    few = inverse_depths_between(0.1, 0.5, 0.01, 64)
    assert len(few) == 41
    np.testing.assert_allclose(np.diff(few), 0.01)
    many = inverse_depths_between(0.1, 0.5, 0.001, 64)
    assert (len(many), many[0], many[-1]) == (64, 0.1, 0.5)
    assert len(inverse_depths_between(0.3, 0.3, 0.1, 64)) == 3


def test_parallax_is_the_derivative_of_the_projection() -> None:
    others = np.stack([pose(step) for step in (1, 6)])
    moved = motion(CAMERA, pose(3), others)
    generator = np.random.default_rng(0)
    pixels = generator.uniform((0.0, 0.0), (127.0, 95.0), (20, 2))
    w = generator.uniform(0.2, 0.6, 20)

    def seen(w: F64, T: F64) -> F64:
        rays = np.concatenate([CAMERA.normalise(pixels), np.ones((20, 1))], axis=1)
        world = transform(pose(3), rays / w[:, None])
        return CAMERA.project(transform(inverse(T), world))

    for s, T in enumerate(others):
        numeric = (seen(w + 1e-6, T) - seen(w - 1e-6, T)) / 2e-6
        found = parallax_px(moved, pixels, w)[s]
        np.testing.assert_allclose(found, np.linalg.norm(numeric, axis=1), rtol=1e-5)


def test_small_images_are_means_of_what_is_shown() -> None:
    generator = np.random.default_rng(0)
    grey = generator.integers(1, 256, (13, 10), dtype=np.uint8)
    shown = np.ones(grey.shape, np.bool_)
    shown[5, 2] = False
    small = shrunk(grey, shown, 4)
    assert small.shape == (3, 2)
    assert small[1, 0] == NOT_SHOWN
    assert small[2, 1] == np.floor(grey[8:12, 4:8].mean() + 0.5)


@pytest.mark.parametrize(
    ("width", "height", "times"),
    [(640, 480, 2), (480, 640, 2), (1920, 1080, 4), (1241, 376, 2), (320, 240, 1), (128, 96, 1)],
)
def test_images_are_swept_at_about_half_of_640x480(width: int, height: int, times: int) -> None:
    camera = CAMERA.__class__(width=width, height=height, fx=500.0, fy=500.0, cx=0.0, cy=0.0)
    assert reduction(camera) == times
    small = shrunk_camera(camera, times)
    assert (small.width, small.height) == (width // times, height // times)
    assert small.fx == 500.0 / times
    assert (small.cx + 0.5) * times == camera.cx + 0.5


def test_half_a_view_sees_the_same_points() -> None:
    small = view(0).halved()
    point = np.array([[0.3, -0.2, 2.0]])
    np.testing.assert_allclose(small.camera.project(point), (CAMERA.project(point) + 0.5) / 2 - 0.5)


def test_texture_is_more_variance_than_noise_has() -> None:
    """Against plain numpy, at steps of grey about the limit."""
    generator = np.random.default_rng(0)
    grey = (128 + generator.integers(-1, 2, (30, 40)) * np.arange(40) // 8).astype(np.uint8)
    padded = np.pad(grey.astype(np.int64), 3, mode="reflect")
    windows = np.lib.stride_tricks.sliding_window_view(padded, (7, 7)).reshape(30, 40, 49)
    spread = 49 * (windows**2).sum(axis=2) - windows.sum(axis=2) ** 2
    expected = spread > NOISE_VARIANCE * 49**2
    assert 0.2 < expected.mean() < 0.8
    np.testing.assert_array_equal(textured(grey, 3), expected)
