"""The similarity between two maps, from pairs of points of which most may be wrong."""

import numpy as np
import pytest

from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.slam.places.similarity import (
    Pairs,
    closed_form,
    moved,
    refine_similarity,
    residuals_of,
    similarity_by_ransac,
)

GATE = 0.006


def scene(count: int, wrong: float, *, seed: int = 0, depth_noise: float = 0.0):
    """Pairs, the similarity behind them, and which of them are right."""
    generator = np.random.default_rng(seed)
    S = np.eye(4)
    S[:3, :3] = 1.7 * so3_exp(np.array([0.05, -0.3, 0.1]))
    S[:3, 3] = (0.4, -0.2, 0.3)
    xyz_b = generator.uniform((-1.0, -0.8, 1.5), (1.0, 0.8, 4.0), (count, 3))
    xyz_a = xyz_b @ S[:3, :3].T + S[:3, 3]
    seen = [xyz[:, :2] / xyz[:, 2:] for xyz in (xyz_a, xyz_b)]
    seen = [each + generator.normal(0.0, 0.001, each.shape) for each in seen]
    xyz_a = xyz_a * (1.0 + depth_noise * generator.normal(size=(count, 1)))
    xyz_b = xyz_b * (1.0 + depth_noise * generator.normal(size=(count, 1)))
    right = generator.random(count) >= wrong
    mixed = np.flatnonzero(~right)
    other = np.roll(mixed, 1)
    xyz_b[mixed], seen[1][mixed] = xyz_b[other], seen[1][other]
    return Pairs(xyz_a=xyz_a, xyz_b=xyz_b, seen_a=seen[0], seen_b=seen[1]), S, right


def test_derivatives_are_those_of_differences():
    pairs, S, _ = scene(6, 0.0)
    S = moved(S, np.array([0.1, 0.05, -0.1, 0.1, 0.2, -0.1, 0.15]))
    _, J = residuals_of(S, pairs)
    h = 1e-6
    for k in range(7):
        step = h * np.eye(7)[k]
        forth, back = (residuals_of(moved(S, sign * step), pairs)[0] for sign in (1.0, -1.0))
        np.testing.assert_allclose(J[:, :, k], (forth - back) / (2.0 * h), atol=1e-7)


def umeyama(source, target):
    """(4, 4) by singular values."""
    s, t = source - source.mean(axis=0), target - target.mean(axis=0)
    U, D, Vt = np.linalg.svd(t.T @ s)
    signs = np.array([1.0, 1.0, np.sign(np.linalg.det(U) * np.linalg.det(Vt))])
    S = np.eye(4)
    S[:3, :3] = (D * signs).sum() / (s**2).sum() * (U * signs) @ Vt
    S[:3, 3] = target.mean(axis=0) - S[:3, :3] @ source.mean(axis=0)
    return S


def test_triples_give_the_similarity_of_singular_values():
    generator = np.random.default_rng(4)
    source, target = generator.normal(size=(2, 200, 3, 3))
    expected = [umeyama(*each) for each in zip(source, target, strict=True)]
    np.testing.assert_allclose(closed_form(source, target), expected, atol=1e-9)


def test_triples_without_extent_give_none():
    generator = np.random.default_rng(4)
    source, target = generator.normal(size=(2, 4, 3, 3))
    source[0, 1] = source[0, 0]
    target[1, 2] = target[1, 0]
    source[2, 2] = 3.0 * source[2, 1] - 2.0 * source[2, 0]
    expected = umeyama(source[3], target[3])
    np.testing.assert_allclose(closed_form(source, target), expected[None], atol=1e-9)


@pytest.mark.parametrize("wrong", [0.0, 0.5, 0.75])
def test_the_similarity_is_found_among_wrong_pairs(wrong):
    pairs, S, right = scene(120, wrong)
    found = similarity_by_ransac(pairs, np.random.default_rng(1), gate=GATE, samples=500)
    assert found is not None
    assert np.abs(found[0] - S).max() < 5e-3
    assert np.mean(found[1][right]) > 0.95
    assert np.count_nonzero(found[1][~right]) <= 3


def test_uncertain_depths_cost_less_than_in_closed_form():
    """Directions are known far better than depths."""
    pairs, _, _ = scene(200, 0.0, depth_noise=0.02)
    found = similarity_by_ransac(pairs, np.random.default_rng(1), gate=0.02, samples=200)
    assert found is not None
    assert abs(np.cbrt(np.linalg.det(found[0][:3, :3])) / 1.7 - 1.0) < 5e-3
    again = refine_similarity(found[0], pairs.of(found[1]), scale=0.02)
    np.testing.assert_allclose(again, found[0], atol=2e-3)


def test_with_cameras_at_one_place_depths_determine_the_scale():
    """Images are the same at any scale then."""
    generator = np.random.default_rng(3)
    S = np.diag([1.3, 1.3, 1.3, 1.0])
    xyz_b = generator.uniform((-1.0, -0.8, 1.5), (1.0, 0.8, 4.0), (100, 3))
    xyz_a = 1.3 * xyz_b * np.exp(0.1 * generator.normal(size=(100, 1)))
    seen = [xyz[:, :2] / xyz[:, 2:] for xyz in (xyz_a, xyz_b)]
    seen = [each + generator.normal(0.0, 0.001, each.shape) for each in seen]
    pairs = Pairs(xyz_a=xyz_a, xyz_b=xyz_b, seen_a=seen[0], seen_b=seen[1])
    start = S.copy()
    start[:3, :3] /= 1.3
    found = refine_similarity(start, pairs, scale=GATE)
    assert abs(np.cbrt(np.linalg.det(found[:3, :3])) / 1.3 - 1.0) < 0.03


@pytest.mark.parametrize("count", [0, 3, 60])
def test_pairs_without_information_hardly_change_the_result(count):
    generator = np.random.default_rng(5)
    xyz = generator.uniform((-1.0, -1.0, 1.0), (1.0, 1.0, 4.0), (2, count, 3))
    seen = generator.uniform(-0.5, 0.5, (2, count, 2))
    pairs = Pairs(xyz_a=xyz[0], xyz_b=xyz[1], seen_a=seen[0], seen_b=seen[1])
    found = similarity_by_ransac(pairs, generator, gate=GATE, samples=300)
    assert found is None or found[1].sum() < 8


def test_points_in_one_place_give_nothing():
    xyz = np.broadcast_to(np.array([0.1, 0.2, 2.0]), (10, 3)).copy()
    seen = xyz[:, :2] / xyz[:, 2:]
    pairs = Pairs(xyz_a=xyz, xyz_b=xyz, seen_a=seen, seen_b=seen)
    found = similarity_by_ransac(pairs, np.random.default_rng(0), gate=GATE, samples=50)
    assert found is None
