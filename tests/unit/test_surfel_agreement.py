"""A depth map of another scale beside surfels that agree with it, or do not."""

from dataclasses import replace

import numpy as np
import pytest

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import transform
from pliant.algorithms.surfels.camera_alignment import se3_exp
from pliant.algorithms.surfels.depth_maps import agree, contradicted_by_depth, contradiction
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState

CAMERA = PinholeCamera(width=160, height=120, fx=200.0, fy=200.0, cx=79.5, cy=59.5)
PATCH_PX = 23


def surface() -> F64:
    """(H, W) depth of a slanted plane about 1 away."""
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    return 1.0 + 0.002 * (u - CAMERA.cx) - 0.001 * (v - CAMERA.cy)


def surfels(depth: F64) -> SurfelFrame:
    """Tracked surfels on a depth map, every 10 px, of a camera somewhere in the world."""
    v, u = np.mgrid[10 : CAMERA.height : 10, 10 : CAMERA.width : 10]
    pixels = np.stack([u.ravel(), v.ravel()], axis=1)
    n, z = len(pixels), depth[v.ravel(), u.ravel()]
    rays = np.concatenate([CAMERA.normalise(pixels.astype(float)), np.ones((n, 1))], axis=1)
    T, zeros = se3_exp(np.array([0.2, -0.1, 0.3, 0.4, 0.2, -0.3])), np.zeros(n, np.float32)
    return replace(
        SurfelFrame.empty(), lost=False, T_world_camera=T, ids=np.arange(n),
        positions=transform(T, rays * z[:, None]), tangents=np.zeros((n, 3, 2)),
        deformations=np.zeros((n, 3)), points_px=pixels.astype(np.float32), zncc=zeros,
        visible=zeros, sigma=zeros, gains=zeros, biases=zeros, state=np.zeros(n, np.uint8),
        age=np.ones(n, np.int32), born=np.zeros(n, np.int32),
    )  # fmt: skip


def test_the_map_is_brought_to_the_scale_of_the_surfels() -> None:
    depth = surface()
    depth[:, :16] = 0.0
    found = agree(0.4 * depth, surfels(surface()), PATCH_PX)
    assert found.depth is not None
    assert found.ratio == pytest.approx(2.5)
    np.testing.assert_allclose(found.depth, depth)


def test_a_measured_depth_contradicts_surfels_that_have_another() -> None:
    depth, frame = surface(), surfels(surface())
    assert not contradiction(depth, frame)
    assert not contradiction(1.01 * depth, frame)
    found = contradiction(1.05 * depth, frame)
    assert found == f"{len(frame.ids)} of the {len(frame.ids)} surfels on it have another depth"
    half = np.where(np.arange(CAMERA.width) < 70, depth, 1.05 * depth)
    assert contradiction(half, frame).startswith("99 of the 165")
    half[:, 70:] = 0.0
    assert not contradiction(half, frame)
    half[:, :50] = 0.0  # too few are left
    assert not contradiction(1.05 * half, frame)
    points, z = np.array([[50.0, 50.0], [-9.0, 50.0]]), np.repeat(depth[50, 50], 2)
    off, known = contradicted_by_depth(1.05 * depth, points, z)
    assert off.tolist() == known.tolist() == [True, False]
    off, known = contradicted_by_depth(1.05 * depth, points, 1.05 * z)
    assert (off.tolist(), known.tolist()) == ([False, False], [True, False])


def test_nothing_is_taken_where_surfels_disagree() -> None:
    """The right quarter has come nearer by 10 % since the map was made."""
    moved = surface()
    moved[:, 120:] *= 0.9
    found = agree(2.0 * surface(), surfels(moved), PATCH_PX)
    assert found.depth is not None
    assert found.ratio == pytest.approx(0.5)
    assert not found.depth[:, 144:].any()
    np.testing.assert_allclose(found.depth[:, :96], surface()[:, :96])
    # Where there is no surfel nobody disagrees.
    some = surfels(moved)
    unseen = np.where(some.points_px[:, 0] > 100, SurfelState.LOST, some.state).astype(np.uint8)
    found = agree(2.0 * surface(), replace(some, state=unseen), PATCH_PX)
    assert found.depth is not None
    np.testing.assert_allclose(found.depth, surface())


def test_a_map_is_refused_that_most_surfels_do_not_agree_with() -> None:
    bent = surface() * np.linspace(0.8, 1.3, CAMERA.width)
    found = agree(bent, surfels(surface()), PATCH_PX)
    assert found.depth is None
    assert "agree with it" in found.problem


def test_too_few_surfels_are_not_judged() -> None:
    depth = np.zeros_like(surface())
    depth[:30, :30] = 1.0
    found = agree(depth, surfels(surface()), PATCH_PX)
    assert found.depth is None
    assert found.problem == "4 surfels lie on it, 30 needed"
    outside = replace(surfels(surface()), points_px=surfels(surface()).points_px + 500)
    assert agree(surface(), outside, PATCH_PX).problem.startswith("0 surfels")
