"""Exposure of views, where the gains of each are known."""

import numpy as np
import pytest

from pliant.algorithms.arrays import F32, F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.view_exposure import ExposureSamples, log_gains

CAMERA = PinholeCamera(width=160, height=120, fx=120.0, fy=120.0, cx=79.5, cy=59.5)
LOGS = np.log([[1.0, 1.0, 1.0], [1.4, 1.3, 1.2], [0.7, 0.75, 0.8], [1.05, 0.9, 1.1]])
TRUE = np.exp(LOGS - LOGS.mean(axis=0))


def wall() -> tuple[F32, F32]:
    """Points of a wall at depth 2, and their normals, towards the cameras."""
    x, y = np.meshgrid(np.linspace(-1.5, 1.5, 40), np.linspace(-1.0, 1.0, 30))
    points = np.stack([x, y, np.full_like(x, 2.0)], axis=-1).reshape(-1, 3).astype(np.float32)
    return points, np.tile(np.array([0.0, 0.0, -1.0], np.float32), (len(points), 1))


def pose(x: float) -> F64:
    T = np.eye(4)
    T[0, 3] = x
    return T


def image(T: F64, gain: F64, painted: int = 0) -> U8:
    """What a camera that looks along z sees of a wall of smooth colours; painted: columns that are
    another thing."""
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    x = (u - CAMERA.cx) / CAMERA.fx * 2.0 + T[0, 3]
    y = (v - CAMERA.cy) / CAMERA.fy * 2.0
    waves = np.stack([np.sin(3.0 * x), np.cos(2.0 * y), np.sin(2.0 * x + y)], axis=-1)
    colours = (110.0 + 30.0 * waves) * gain
    colours[:, :painted] = 200.0
    return np.clip(np.rint(colours), 0, 255).astype(np.uint8)


def gains(painted: int = 0, shifts: tuple[float, ...] = (-0.3, -0.1, 0.1, 0.3)) -> F64:
    samples = ExposureSamples(*wall())
    depths = np.full((CAMERA.height, CAMERA.width), 2.0, np.float32)
    for number, shift in enumerate(shifts):
        shown = image(pose(shift), TRUE[number], painted if number == 0 else 0)
        samples.add(shown, depths, CAMERA, pose(shift))
    return samples.gains()


def test_gains_are_those_with_which_the_images_were_made() -> None:
    found = gains()
    np.testing.assert_allclose(found, TRUE, rtol=0.01)
    np.testing.assert_allclose(np.exp(np.log(found).mean(axis=0)), 1.0, rtol=1e-12)


def test_something_else_before_the_wall_does_not_count() -> None:
    np.testing.assert_allclose(gains(painted=40), TRUE, rtol=0.02)


def test_a_view_that_shares_nothing_keeps_its_exposure() -> None:
    found = gains(shifts=(-0.1, 0.0, 0.1, 50.0))
    np.testing.assert_allclose(found[:3] / found[0], TRUE[:3] / TRUE[0], rtol=0.01)
    # It is the mean of the others, as far as anybody knows.
    np.testing.assert_allclose(np.log(found[3]), np.log(found[:3]).mean(axis=0), atol=0.01)


@pytest.mark.parametrize("what", ["hidden", "nothing", "dark", "saturated"])
def test_without_any_colours_all_gains_are_one(what: str) -> None:
    samples = ExposureSamples(*wall())
    depth = {"hidden": 1.0, "nothing": 0.0}.get(what, 2.0)
    grey = {"dark": 3, "saturated": 255}.get(what, 100)
    depths = np.full((CAMERA.height, CAMERA.width), depth, np.float32)
    for shift in (-0.1, 0.1):
        pixels = np.full((CAMERA.height, CAMERA.width, 3), grey, np.uint8)
        samples.add(pixels, depths, CAMERA, pose(shift))
    np.testing.assert_array_equal(samples.gains(), np.ones((2, 3)))
    assert ExposureSamples(*wall()).gains().shape == (0, 3)


def test_gains_solve_the_problem_that_is_stated() -> None:
    """Against a dense least-squares solution of one round, with all weights 1."""
    rng = np.random.default_rng(0)
    pairs = np.sort(rng.choice(1500 * 7, 4000, replace=False))  # no point twice in a view
    points, views = np.divmod(pairs, 7)
    logs = rng.normal(size=(4000, 3))
    weights = rng.uniform(0.1, 1.0, 4000)
    rows = np.zeros((4000, 7 + 1500))
    rows[np.arange(4000), views] = rows[np.arange(4000), 7 + points] = 1.0
    root = np.sqrt(weights)[:, None]
    prior = np.eye(7, 7 + 1500)
    A, b = np.concatenate([root * rows, prior]), np.concatenate([root * logs, np.zeros((7, 3))])
    expected = np.linalg.lstsq(A, b)[0][:7]
    np.testing.assert_allclose(log_gains(points, views, logs, weights, 7), expected, atol=1e-8)
