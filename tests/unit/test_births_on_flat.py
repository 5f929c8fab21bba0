"""Births where depth is made up: on surface that comes into view, apart from what is tracked."""

import numpy as np
import pytest
from flat_texture import CAMERA, DEPTH, texture

from pliant.algorithms.arrays import U8
from pliant.algorithms.surfels.depth_maps import depth_between
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker

STEP_S = 0.2
BARE = slice(150, 320)
"""Columns without texture in the first frames."""


def view(seed: int, *, bare: bool) -> U8:
    image = np.clip(128.0 + 35.0 * texture(seed), 0, 245).astype(np.uint8)
    if bare:
        image[:, BARE] = 120
    return image


def follow(
    images: list[U8], depth_from: str, count: int = 300
) -> tuple[SurfelTracker, list[SurfelFrame]]:
    parameters = SurfelParameters.model_validate(
        {"max_surfels": count, "levels": 2, "patch_px": 15, "depth_from": depth_from}
    )
    tracker = SurfelTracker(parameters)
    frames = [tracker.start(images[0], DEPTH, CAMERA)]
    return tracker, frames + [tracker.track(image, STEP_S) for image in images[1:]]


def test_surface_that_comes_into_view_gets_surfels() -> None:
    images = [view(0, bare=True)] * 2 + [view(0, bare=False)] * 3
    tracker, frames = follow(images, "flat")
    first, last = frames[0], frames[-1]
    assert first.points_px[:, 0].max() < BARE.start + 10
    new = ~np.isin(last.ids, first.ids)
    assert np.count_nonzero(new) > 10
    assert len(last.ids) <= 300
    assert last.points_px[new, 0].max() > 280
    np.testing.assert_allclose(last.positions[new, 2], 1.0, atol=0.01)
    # They come at once, not on what is tracked, and do not hold it.
    assert len({int(born) for born in last.born[new]}) == 1
    old = last.points_px[~new & (last.state == SurfelState.TRACKED)]
    gaps = np.abs(last.points_px[new][:, None] - old[None]).max(axis=2)
    assert gaps.min() > 14  # px, of a patch of 15
    ends = new[tracker._now.table.edges.ends]
    assert (ends[:, 0] == ends[:, 1]).all()
    assert ends.any()


def test_nothing_is_born_without_depth_of_a_sensor() -> None:
    images = [view(0, bare=True)] * 2 + [view(0, bare=False)] * 3
    _, frames = follow(images, "sensor")
    np.testing.assert_array_equal(frames[-1].ids, frames[0].ids)


def test_another_scene_starts_another_segment() -> None:
    dark = [np.zeros_like(view(0, bare=False))] * 4
    _, frames = follow([view(0, bare=False), *dark, *[view(1, bare=False)] * 4], "flat", 80)
    assert all(frame.lost and frame.segment == 0 for frame in frames[1:5])
    assert not frames[-1].lost
    assert frames[-1].segment == 1


def test_a_single_strange_frame_starts_nothing() -> None:
    """Though it has texture, and the last births were long ago."""
    same = view(0, bare=False)
    strange = np.random.default_rng(0).integers(0, 245, same.shape).astype(np.uint8)
    _, frames = follow([same, same, same, strange, same], "flat", 80)
    assert [frame.lost for frame in frames] == [False, False, False, True, False]
    assert {frame.segment for frame in frames} == {0}
    _, frames = follow([same, same, same, *[strange] * 4], "flat", 80)
    assert [frame.segment for frame in frames] == [0, 0, 0, 0, 0, 1, 1]


@pytest.mark.parametrize("tilt", [0.0, 0.3])
def test_the_depth_between_surfels_is_theirs(tilt: float) -> None:
    points = np.random.default_rng(0).uniform((0, 0), (320, 240), (200, 2))
    inverse_z = 0.5 + tilt * (points[:, 0] - 160.0) / 320.0
    depth = depth_between(points, 1.0 / inverse_z, CAMERA)
    assert depth.shape == (240, 320)
    v, u = np.mgrid[60:180, 80:240]
    np.testing.assert_allclose(1.0 / depth[v, u], 0.5 + tilt * (u - 160.0) / 320.0, atol=0.05)
    # Far from all of them it is their mean, and without any it is 1.
    np.testing.assert_allclose(depth_between(points[:1] * 0.0, np.array([2.0]), CAMERA), 2.0)
    np.testing.assert_allclose(depth_between(points[:0], np.zeros(0), CAMERA), 1.0)
