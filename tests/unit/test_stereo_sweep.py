"""Dense depth of rendered views against the truth, its confidence, and which sources are chosen."""

import numpy as np
import pytest
from stereo_scene import CAMERA, anchors, pose, true_depth_points, true_inverse, view

from pliant.algorithms.arrays import F64
from pliant.algorithms.stereo.sources import Viewpoints, choose_sources
from pliant.algorithms.stereo.sweep import (
    Anchors,
    cosines_of,
    pull_to_anchors,
    swept_depth,
    upsampled,
)
from pliant.algorithms.stereo.views import NOT_SHOWN, DenseDepth, StereoView

AROUND = (-3, -1, 1, 5, 7, 9)


@pytest.fixture(scope="module")
def found() -> DenseDepth:
    return swept_depth(view(3), [view(step) for step in AROUND], anchors(3))


def errors(depth: DenseDepth) -> F64:
    return np.abs(depth.inverse_depths / true_inverse(3) - 1.0)


def test_most_pixels_have_the_true_depth(found: DenseDepth) -> None:
    inside = np.zeros(found.confidences.shape, np.bool_)
    inside[8:-8, 24:-24] = True
    error = errors(found)[inside]
    assert np.median(error) < 0.015  # a tenth of a pixel in the median source
    assert np.mean(error < 0.05) > 0.9


def test_confident_pixels_err_less(found: DenseDepth) -> None:
    sure = found.confidences > 0.9
    assert sure.mean() > 0.3
    assert np.mean(errors(found)[sure] < 0.05) > 0.98
    unsure = (found.confidences < 0.3) & (found.inverse_depths > 0.0)
    assert np.median(errors(found)[unsure]) > 2.0 * np.median(errors(found)[sure])


def test_the_same_bytes_again(found: DenseDepth) -> None:
    again = swept_depth(view(3), [view(step) for step in AROUND], anchors(3))
    assert again.inverse_depths.tobytes() == found.inverse_depths.tobytes()
    assert again.confidences.tobytes() == found.confidences.tobytes()


def test_what_a_mask_covers_has_no_depth_and_is_nobodys_match() -> None:
    masked = view(3)
    masked.grey[20:60, 40:90] = NOT_SHOWN
    depth = swept_depth(masked, [view(step) for step in AROUND], anchors(3))
    assert not depth.confidences[20:60, 40:90].any()
    blind = [StereoView(np.zeros_like(view(s).grey), CAMERA, pose(s)) for s in AROUND]
    assert not swept_depth(view(3), blind, anchors(3)).confidences.any()


@pytest.mark.parametrize("sources", [[], [3], [1]])
def test_without_parallax_or_points_there_is_no_estimate(sources: list[int]) -> None:
    few = anchors(3, count=3) if sources == [1] else anchors(3)
    depth = swept_depth(view(3), [view(step) for step in sources], few)
    assert not depth.inverse_depths.any()
    assert not depth.confidences.any()


def test_an_anchor_decides_at_its_pixel_as_far_as_it_is_sure() -> None:
    costs = np.full((4, 5, 11), 100, np.uint8)
    planes = np.linspace(0.1, 1.1, 11)
    sure, vague = np.array([[1.2, 2.4]]), np.array([[3.0, 0.0]])
    pull_to_anchors(
        costs, planes,
        Anchors(np.concatenate([sure, vague]), np.array([0.5, 0.5]), np.array([0.01, 1.0])),
    )  # fmt: skip
    assert costs[2, 1].argmin() == 4
    assert costs[2, 1, 4] == 10
    assert costs[2, 1, 10] == round(0.1 * 100 + 0.9 * 255)
    assert abs(costs[0, 3].astype(int) - 100).max() < 12
    assert np.count_nonzero(costs != 100) <= 22


def test_upsampling_is_bilinear_but_for_jumps() -> None:
    v, u = np.mgrid[0:6, 0:8].astype(np.float32)
    slope = upsampled(0.1 * u + 0.2 * v, (12, 16), 1.0)
    rows, columns = np.mgrid[0:12, 0:16]
    x, y = np.clip((columns + 0.5) / 2 - 0.5, 0, 7), np.clip((rows + 0.5) / 2 - 0.5, 0, 5)
    np.testing.assert_allclose(slope, 0.1 * x + 0.2 * y, atol=1e-5)
    step = np.where(u < 4, 1.0, 5.0).astype(np.float32)
    assert set(np.unique(upsampled(step, (12, 16), 0.5))) == {1.0, 5.0}
    assert upsampled(step, (13, 17), 0.5).shape == (13, 17)


def test_cosines_are_those_of_planes() -> None:
    normal = np.array([0.3, -0.2, -0.9])
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width].astype(np.float64)
    rays = np.concatenate(
        [CAMERA.normalise(np.stack([u, v], axis=-1).reshape(-1, 2)), np.ones((u.size, 1))], axis=1
    )
    w = (rays @ -normal / 2.0).reshape(u.shape)
    expected = -(rays @ normal) / np.linalg.norm(rays, axis=1) / np.linalg.norm(normal)
    found = cosines_of(w.astype(np.float32), CAMERA)
    np.testing.assert_allclose(found.ravel(), expected, atol=2e-4)
    assert not cosines_of(np.zeros((4, 5), np.float32), CAMERA).any()


def viewpoints(steps: list[float], sharpness: list[float] | None = None) -> Viewpoints:
    poses = np.tile(np.eye(4), (len(steps), 1, 1))
    poses[:, 0, 3] = steps
    sharp = np.array(sharpness or [1.0] * len(steps))
    return Viewpoints(CAMERA, poses, sharp)


def test_sources_have_parallax_on_both_sides_and_no_twins() -> None:
    points = true_depth_points(0)
    depth = float(np.median(points[:, 2]))
    steps = [0.0, 0.001, 0.1, 0.1001, -0.1, 0.5, 3.0]
    views = viewpoints([depth * step for step in steps])
    chosen = choose_sources(views, 0, points, 3).tolist()
    assert chosen[0] in (2, 3, 4)
    assert {4} < set(chosen[:2])
    assert not {0, 1, 5, 6} & set(choose_sources(views, 0, points, 7).tolist())


def test_blurred_keyframes_and_such_as_look_away_are_no_sources() -> None:
    points = true_depth_points(0)
    step = 0.1 * float(np.median(points[:, 2]))
    views = viewpoints([0.0, step, step], [1.0, 0.2, 1.0])
    assert choose_sources(views, 0, points, 1).tolist() == [2]
    views.T_world_camera[2, :3, :3] = np.diag([-1.0, 1.0, -1.0])
    assert choose_sources(views, 0, points, 2).tolist() == [1]
    behind = points * (1.0, 1.0, -1.0)
    assert choose_sources(views, 0, behind, 2).tolist() == []


def test_of_many_keyframes_in_one_place_those_that_see_the_same_are_taken() -> None:
    points = true_depth_points(0)
    step = float(np.median(points[:, 2]))
    views = viewpoints([0.0, *np.linspace(-0.9, 0.9, 300) * step])
    views.T_world_camera[1:100, :3, :3] = np.diag([-1.0, 1.0, -1.0])  # they look away
    chosen = choose_sources(views, 0, points, 6)
    assert len(chosen) == 6
    assert chosen.min() >= 100
    angles = np.abs(views.T_world_camera[chosen, 0, 3]) / step
    assert np.median(angles) < 0.2
