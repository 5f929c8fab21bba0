"""What views agree on: votes against plain numpy, a view that errs, occlusion, and sure pixels."""

from dataclasses import replace

import numpy as np
import pytest
from stereo_scene import CAMERA, true_inverse, view

from pliant.algorithms.arrays import F32, F64, BoolArray
from pliant.algorithms.stereo.consensus import consensus
from pliant.algorithms.stereo.dense_points import SurePixels, matching_sigmas, sure_pixels
from pliant.algorithms.stereo.sweep import poses_of
from pliant.algorithms.stereo.views import DenseDepth, StereoView, motion, parallax_px

AROUND = (0, 1, 2, 4, 5, 6)


def exact(step: int, confidence: float = 0.8) -> DenseDepth:
    w = true_inverse(step).astype(np.float32)
    return DenseDepth(w, np.full(w.shape, confidence, np.float32))


def agreed(depths: dict[int, DenseDepth], own: DenseDepth | None = None) -> DenseDepth:
    views = [view(step) for step in depths]
    return consensus(view(3), own or exact(3), views, list(depths.values()))


def interior() -> BoolArray:
    inside = np.zeros((CAMERA.height, CAMERA.width), np.bool_)
    inside[8:-8, 24:-24] = True
    return inside


def test_views_that_agree_support_each_other() -> None:
    found = agreed({step: exact(step) for step in AROUND})
    error = np.abs(found.inverse_depths / true_inverse(3) - 1.0)[interior()]
    assert np.median(error) < 0.003
    assert np.mean(error < 0.02) > 0.97
    most = 0.8 * (len(AROUND) + 1.5)
    assert found.confidences.max() <= most + 1e-4
    assert np.median(found.confidences[interior()]) > 0.8 * most


def test_one_view_that_disagrees_is_outvoted_whichever_it_is() -> None:
    wrong = exact(4, 1.0)
    wrong = replace(wrong, inverse_depths=np.float32(1.3) * wrong.inverse_depths)
    depths = {step: exact(step) for step in AROUND} | {4: wrong}
    error = np.abs(agreed(depths).inverse_depths / true_inverse(3) - 1.0)[interior()]
    assert np.mean(error < 0.02) > 0.95
    own = exact(3, 1.0)
    own = replace(own, inverse_depths=np.float32(0.7) * own.inverse_depths)
    found = agreed({step: exact(step) for step in AROUND}, own)
    error = np.abs(found.inverse_depths / true_inverse(3) - 1.0)[interior()]
    assert np.mean(error < 0.02) > 0.95


def test_alone_a_depth_is_contradicted_by_those_who_see_through_it() -> None:
    own = exact(3, 0.5)
    own = replace(own, inverse_depths=np.float32(1.5) * own.inverse_depths)
    found = agreed({step: exact(step, 0.9) for step in AROUND}, own)
    near = np.abs(found.inverse_depths / own.inverse_depths - 1.0) < 0.03
    assert np.mean(near[interior()]) < 0.02


def test_there_is_no_depth_without_texture() -> None:
    """A bare sky over a roof, up to three pixels from it, where windows see the roof."""
    depths = {step: exact(step) for step in AROUND}
    bare = replace(view(3), grey=view(3).grey.copy())
    bare.grey[:20] = 225 + np.arange(CAMERA.width) % 2
    found = consensus(bare, exact(3), [view(step) for step in depths], list(depths.values()))
    assert not found.confidences[:17].any()
    assert not found.inverse_depths[:17].any()
    whole = agreed(depths)
    np.testing.assert_array_equal(found.inverse_depths[23:], whole.inverse_depths[23:])


def test_depth_is_unknown_without_confident_views() -> None:
    found = agreed({step: exact(step, 0.0) for step in AROUND}, exact(3, 0.0))
    assert not found.inverse_depths.any()
    assert not found.confidences.any()
    alone = consensus(view(3), exact(3), [view(1)], [exact(1, 0.0)])
    np.testing.assert_allclose(alone.confidences, 1.2, rtol=1e-6)


def plain_votes(
    own: DenseDepth, views: list[StereoView], depths: list[DenseDepth], u: int, v: int
) -> tuple[float, float]:
    """The consensus at one pixel, before the median: value and support."""
    values, weights = [own.inverse_depths[v, u]], [1.5 * own.confidences[v, u]]
    back = [motion(CAMERA, other.T_world_camera, view(3).T_world_camera[None]) for other in views]
    rows, columns = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width].astype(np.float64)
    pixels = np.stack([columns, rows, np.ones_like(rows)], axis=-1)
    for moved, depth in zip(back, depths, strict=True):
        w = depth.inverse_depths.astype(np.float64)
        p = pixels @ moved.homographies[0].T + moved.translations[0] * w[..., None]
        at = np.floor(p[..., :2] / p[..., 2:] + 0.5)
        here = (at == (u, v)).all(axis=-1) & (depth.confidences > 0) & (p[..., 2] > 0)
        if here.any():
            there = np.where(here, w / p[..., 2], -1.0)
            nearest = np.unravel_index(there.argmax(), there.shape)
            values.append(np.float32(there[nearest]))
            weights.append(depth.confidences[nearest])
    known = [(float(w), float(c)) for w, c in zip(values, weights, strict=True) if c > 0]
    there = motion(CAMERA, view(3).T_world_camera, poses_of(views))
    best, chosen = 0.0, (0.0, 0.0)
    for candidate, _ in known:
        score, total, support = 0.0, 0.0, 0.0
        for w, c in known:
            off = (w - candidate) / (0.03 * candidate)
            share = c * (1 - off**2) if abs(off) < 1 else 0.0
            total, support = total + share * w, support + share
            score += share if abs(off) < 1 else (-0.3 * c if off > 0 else 0.0)
        for A, b, depth in zip(there.homographies, there.translations, depths, strict=True):
            p = A @ (u, v, 1.0) + b * candidate
            i, j = np.floor(p[:2] / p[2] + 0.5).astype(int)
            if p[2] > 0 and 0 <= i < CAMERA.width and 0 <= j < CAMERA.height:
                seen = float(depth.inverse_depths[j, i])
                score -= 0.5 * depth.confidences[j, i] * (seen < 0.97 * candidate / p[2])
        if score > best:
            best, chosen = score, (total / support, support)
    return chosen


def test_votes_are_those_of_plain_numpy() -> None:
    generator = np.random.default_rng(0)

    def noisy(step: int) -> DenseDepth:
        w = true_inverse(step) * (1.0 + 0.02 * generator.standard_normal(true_inverse(step).shape))
        wrong = generator.random(w.shape) < 0.3
        w[wrong] *= generator.uniform(0.6, 1.5, int(wrong.sum()))
        c = generator.uniform(0.0, 1.0, w.shape)
        return DenseDepth(w.astype(np.float32), np.where(c > 0.2, c, 0.0).astype(np.float32))

    own, depths = noisy(3), [noisy(step) for step in AROUND]
    views = [view(step) for step in AROUND]
    found = consensus(view(3), own, views, depths)
    wrong = 0
    for u, v in generator.integers((0, 0), (CAMERA.width, CAMERA.height), (60, 2)).tolist():
        _, support = plain_votes(own, views, depths, u, v)
        # In single precision a splat may fall to the pixel beside.
        wrong += abs(found.confidences[v, u] - support) > 1e-3
    assert wrong <= 2


@pytest.mark.parametrize("stride", [1, 2])
def test_sure_pixels_keep_clear_of_the_points_of_the_map(stride: int) -> None:
    w: F32 = np.full((20, 30), 0.5, np.float32)
    support = np.full((20, 30), 9.0, np.float32)
    support[:, 20:] = 1.0
    points: F64 = np.array([[8.2, 10.4], [40.0, 3.0], [np.nan, 1.0]])
    found = sure_pixels(DenseDepth(w, support), points, stride=stride, min_support=4.0)
    u, v = np.meshgrid(np.arange(0, 20, stride), np.arange(0, 20, stride))
    away = np.maximum(np.abs(u - 8), np.abs(v - 10)) > 2 * stride
    np.testing.assert_array_equal(found.points_px, np.stack([u[away], v[away]], axis=1))
    np.testing.assert_array_equal(found.inverse_depths, 0.5)


def test_a_wide_baseline_makes_depth_sure() -> None:
    pixels = SurePixels(np.array([[60.0, 40.0], [70.0, 50.0]]), np.array([0.3, 0.4]))
    near = matching_sigmas(pixels, view(3), [view(2)])
    far = matching_sigmas(pixels, view(3), [view(0)])
    assert (far < 0.6 * near).all()
    moved = motion(CAMERA, view(3).T_world_camera, view(2).T_world_camera[None])
    slopes = parallax_px(moved, pixels.points_px, pixels.inverse_depths)[0]
    ratio = near * slopes * pixels.inverse_depths
    np.testing.assert_allclose(ratio, ratio[0])
