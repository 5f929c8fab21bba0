"""Strain of a surface whose deformation is known."""

import numpy as np
import pytest

from pliant.algorithms.surfels.surface_over_time import SurfaceOverTime
from pliant.algorithms.surfels.surface_strain import at_vertices, principal_strains, strains
from pliant.pictures.strain_colours import strain_colours, strain_scale


def turned(points: np.ndarray, seed: int = 0) -> np.ndarray:
    """Points in another frame."""
    R, _ = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))
    return points @ R.T


@pytest.mark.parametrize(
    ("stretches", "expected"), [((1.2, 0.95), 0.2), ((1.05, 0.8), -0.2), ((1.0, 1.0), 0.0)]
)
def test_principal_strain_is_that_of_the_singular_values(
    stretches: tuple[float, float], expected: float
) -> None:
    rng = np.random.default_rng(1)
    sides = rng.standard_normal((50, 2, 2))
    angle = rng.uniform(0.0, np.pi)
    V = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    deformed = sides @ (V @ np.diag(stretches) @ V.T)
    rest, now = (np.concatenate([s, np.zeros((50, 2, 1))], axis=2) for s in (sides, deformed))
    found = principal_strains(turned(rest, 2), turned(now, 3))
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_a_line_has_no_strain() -> None:
    line = np.array([[[1.0, 0.0, 0.0], [2.0, 0.0, 0.0]]])
    assert np.isnan(principal_strains(line, line)).all()


def test_each_triangle_begins_with_the_frame_that_shows_it_first() -> None:
    flat = np.array([(0.0, 0.0, 1.0), (1.0, 0.0, 1.0), (0.0, 1.0, 1.0), (1.0, 1.0, 1.0)])
    positions = np.stack([flat * (s, 1.0, 1.0) for s in (1.0, 1.1, 1.21)])
    positions[0, 3] = np.nan  # born later
    surface = SurfaceOverTime(
        ids=np.arange(4),
        positions=positions,
        triangles=np.array([(0, 1, 2), (1, 3, 2)], np.int32),
        shown=np.array([(True, False), (True, True), (True, True)]),
    )
    expected = [(0.0, np.nan), (0.1, 0.0), (0.21, 0.1)]
    np.testing.assert_allclose(strains(surface), expected, atol=1e-9)
    at_last = at_vertices(surface.triangles, strains(surface)[2], 5)
    np.testing.assert_allclose(at_last, [0.21, 0.155, 0.155, 0.1, 0.0], atol=1e-9)


def test_colours_part_what_is_stretched_from_what_is_compressed() -> None:
    full = strain_scale(np.array([-0.2, 0.1, np.nan, 0.0]))
    assert 0.1 < full <= 0.2
    blue, grey, red = strain_colours(np.array([-full, np.nan, 2.0 * full]), full).astype(int)
    assert blue[2] > 150 > blue[0]
    assert red[0] > 150 > red[2]
    assert np.ptp(grey) < 10
