"""Depth of the small image in the holes of a keyframe's depth map."""

import numpy as np
import pytest
from fusion_scene import CAMERA, pose, true_depth

from pliant.algorithms.arrays import F32
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.algorithms.meshing.parameters import TsdfParameters
from pliant.algorithms.meshing.rendering import DepthMap
from pliant.algorithms.meshing.tsdf_volume import TsdfVolume
from pliant.algorithms.stereo.filling import filled
from pliant.algorithms.stereo.views import shrunk_camera

GREY = np.full((CAMERA.height, CAMERA.width, 3), 128, np.uint8)


def known(times: int) -> F32:
    return (1.0 / true_depth(pose(0), shrunk_camera(CAMERA, times))).astype(np.float32)


def with_hole(depth: F32, weight: float = 0.5) -> DepthMap:
    """A hole in the middle, across the ball's outline."""
    depths, weights = depth.copy(), np.full(depth.shape, weight, np.float32)
    depths[20:70, 30:90], weights[20:70, 30:90] = 0.0, 0.0
    return DepthMap(depths=depths, weights=weights)


@pytest.mark.parametrize("times", [1, 2, 4])
def test_holes_are_filled_faintly_and_the_surface_stays(times: int) -> None:
    true = true_depth(pose(0))
    before = with_hole(true)
    after = filled(before, known(times), times)
    hole = before.depths == 0.0
    np.testing.assert_array_equal(after.depths[~hole], before.depths[~hole])
    np.testing.assert_array_equal(after.weights[~hole], before.weights[~hole])
    error = np.abs(after.depths[hole] / true[hole] - 1.0)
    # Between pixels too, but for outlines, which lie where the small image has them.
    assert np.mean(error < 0.002) > 0.8
    assert 0.0 < after.weights[hole].max() < 0.05
    assert not before.depths[hole].any()


def test_the_rest_of_a_size_that_does_not_divide_stays_bare() -> None:
    nothing = np.zeros((7, 9), np.float32)
    after = filled(DepthMap(nothing, nothing), np.full((3, 4), 0.5, np.float32), 2)
    assert (after.depths[:6, :8] == 2.0).all()
    assert not after.depths[6:].any()
    assert not after.depths[:, 8:].any()


def fused(*maps: DepthMap) -> TriangleMesh:
    parameters = TsdfParameters()
    parameters = parameters.model_copy(update={"min_weight": parameters.dense_min_weight})
    volume = TsdfVolume(0.05, parameters)
    for one in maps:
        volume.integrate(one.depths, one.weights, GREY, CAMERA, pose(0))
    return volume.extract_all()


def test_one_keyframe_with_a_surface_outweighs_many_that_fill() -> None:
    true = true_depth(pose(0), ball=False)
    wrong = (1.0 / (1.03 * true)).astype(np.float32)
    bare = DepthMap(np.zeros_like(true), np.zeros_like(true))
    guess = filled(bare, wrong, 1)
    surface = DepthMap(true, np.ones_like(true))
    alone, both = fused(*[guess] * 5), fused(*[guess] * 5, surface)
    assert len(alone.triangles) > 1000
    assert _error(alone) > 0.025
    assert _error(both) < 0.005


def _error(mesh: TriangleMesh) -> float:
    """Median share of the depth by which vertices in view are off."""
    points = mesh.positions.astype(np.float64)
    pixels = np.rint(CAMERA.project(points)).astype(int)
    inside = (pixels >= 0).all(axis=1) & (pixels < (CAMERA.width, CAMERA.height)).all(axis=1)
    u, v = pixels[inside].T
    true = true_depth(pose(0), ball=False)[v, u]
    return float(np.median(np.abs(points[inside, 2] / true - 1.0)))
