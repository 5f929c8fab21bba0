"""What a mask covers leaves no trace: in the image that is worked on, and in the tracks."""

from collections.abc import Callable

import cv2
import numpy as np
import pytest
from moving_texture import HEIGHT, WIDTH, follow, render, stamp_ns
from moving_texture import motion as motion_of_texture
from surfel_scene import STEP_S, board_renderer, film, motion

from pliant.algorithms.arrays import U8, BoolArray
from pliant.algorithms.image.masks import (
    EDGE_PX,
    clearance_in,
    clearance_of,
    filled,
    glaring,
    packed,
    scaled,
    unpacked,
)
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker
from pliant.algorithms.tracking.maxima import curvature_and_maxima, maxima_of
from pliant.algorithms.tracking.parameters import TrackingParameters
from pliant.algorithms.tracking.tracker import ExtremaTracker
from pliant.algorithms.tracks import FrameExtrema

PARAMETERS = TrackingParameters(max_tracks=2000)


def noise(seed: int, blur_px: float = 1.5) -> U8:
    """A foreign pattern, full of extrema."""
    values = np.random.default_rng(seed).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
    blurred = cv2.GaussianBlur(values, (0, 0), blur_px)
    return cv2.normalize(blurred, None, 0, 255, cv2.NORM_MINMAX).astype(np.uint8)


def bonnet(frame: int = 0) -> BoolArray:
    """All but the lower third."""
    used = np.ones((HEIGHT, WIDTH), np.bool_)
    used[2 * HEIGHT // 3 :] = False
    return used


def passer_by(frame: int) -> BoolArray:
    """All but an ellipse that crosses the image."""
    v, u = np.mgrid[:HEIGHT, :WIDTH]
    return ((u - 40.0 - 20.0 * frame) / 50.0) ** 2 + ((v - 120.0) / 100.0) ** 2 > 1.0


def test_a_mask_is_the_same_after_its_way() -> None:
    used = passer_by(3)
    data = packed(used)
    np.testing.assert_array_equal(unpacked(data), used)
    assert len(data) < 800
    assert clearance_in(b"") is None
    assert clearance_in(data) is clearance_in(bytes(data))
    for wrong in (b"", b"?", packed(used)[:60]):
        with pytest.raises(ValueError, match="no image that can be read"):
            unpacked(wrong)


def test_the_clearance_is_the_larger_of_two_distances() -> None:
    used = np.ones((9, 12), np.bool_)
    used[4, 3] = False
    v, u = np.mgrid[:9, :12]
    np.testing.assert_array_equal(clearance_of(used), np.maximum(abs(v - 4), abs(u - 3)))
    assert clearance_of(np.ones((9, 12), np.bool_)).min() > 1e6


def test_a_mask_of_another_size_is_scaled_and_one_of_another_aspect_is_not() -> None:
    used = np.ones((60, 80), np.bool_)
    used[40:] = False
    for size in ((320, 240), (40, 30), (80, 60), (81, 60)):
        got = scaled(used, size)
        assert got.shape == size[::-1]
        assert got[: round(0.63 * size[1])].all()
        assert not got[2 * size[1] // 3 :].any()
    with pytest.raises(ValueError, match="80x60 px, another aspect than the image's 100x60 px"):
        scaled(used, (100, 60))


@pytest.mark.parametrize("mask", [bonnet, passer_by])
def test_nothing_is_found_where_an_image_is_filled(mask: Callable[[int], BoolArray]) -> None:
    clearance = clearance_of(mask(2))
    image = render(0)
    outcome = [
        filled(np.where(mask(2), image, foreign), clearance) for foreign in (noise(1), noise(2))
    ]
    np.testing.assert_array_equal(outcome[0], outcome[1])
    kept = clearance > EDGE_PX
    np.testing.assert_array_equal(outcome[0][kept], image[kept])
    found = []
    for each in (outcome[0], np.where(mask(2), image, noise(1))):
        maxima = curvature_and_maxima(each, 1.2, 8.0)[3]
        u, v = np.rint(maxima[:, :2]).astype(np.int64).T
        found.append(np.count_nonzero(clearance_of(~kept)[v, u] > 8))
    assert found[0] == 0
    assert found[1] > 100
    assert filled(image, None) is image
    blank = filled(image, np.zeros_like(clearance))
    assert np.ptp(blank) == 0


@pytest.mark.parametrize("octaves", [True, False])
@pytest.mark.parametrize("mask", [bonnet, passer_by])
def test_no_track_and_no_maximum_touches_what_is_covered(
    mask: Callable[[int], BoolArray], octaves: bool
) -> None:
    parameters = PARAMETERS if octaves else TrackingParameters(max_tracks=2000, fine_strength=0.0)
    outcome: list[list[FrameExtrema]] = []
    for seed in (1, 2):
        tracker = ExtremaTracker(WIDTH, HEIGHT, parameters)
        made: list[FrameExtrema] = []
        for frame in range(8):
            used = mask(frame)
            image = np.where(used, render(frame), noise(seed))
            made.append(tracker.track(image, stamp_ns(frame), clearance=clearance_of(used)))
        outcome.append(made)
    for frame, (tracks, other) in enumerate(zip(*outcome, strict=True)):
        clearance = clearance_of(mask(frame))
        for points in (tracks.points_px, tracks.maxima):
            u, v = np.rint(points[:, :2]).astype(np.int64).T
            assert clearance[v, u].min() > 4
        # Bundle adjustment finds them by itself.
        image = filled(np.where(mask(frame), render(frame), noise(3)), clearance)
        assert maxima_of(image, parameters, clearance).tobytes() == tracks.maxima.tobytes()
        # Whatever it is that is covered.
        for name, value in vars(tracks).items():
            np.testing.assert_array_equal(value, getattr(other, name))
    last = outcome[0][-1]
    assert len(last.ids) > 800
    assert np.count_nonzero(last.ages == 7) > 250


def test_without_a_mask_a_pattern_that_stays_misleads_the_flow_and_with_it_does_not() -> None:
    used = bonnet()
    used[: HEIGHT // 4] = False
    images = [np.where(used, render(frame), noise(1)) for frame in range(4)]
    flows = [follow(images, PARAMETERS)[-1].dominant_flow]
    tracker = ExtremaTracker(WIDTH, HEIGHT, PARAMETERS)
    flows += [
        tracker.track(image, stamp_ns(frame), clearance=clearance_of(used)).dominant_flow
        for frame, image in enumerate(images)
    ]
    before, after = motion_of_texture(2), motion_of_texture(3)
    middle = np.array([WIDTH / 2.0, HEIGHT / 2.0])
    to = after[:, :2] @ np.linalg.solve(before[:, :2], middle - before[:, 2]) + after[:, 2]
    off = [np.linalg.norm(flow[:, :2] @ middle + flow[:, 2] - to) for flow in (flows[0], flows[-1])]
    assert off[0] > 1.0
    assert off[1] < 0.5


def test_no_surfel_is_created_or_tracked_under_a_mask() -> None:
    still = motion((0.0, 0.0, 0.0), (0.0, 0.0, 0.0))
    renderer, camera = board_renderer([still, still])
    first, second = film(renderer, 2)
    used = np.ones(first.image.shape, np.bool_)
    used[:, : used.shape[1] // 2] = False
    parameters = SurfelParameters(max_surfels=60, levels=2)

    def right(points_px: np.ndarray) -> BoolArray:
        return np.asarray(points_px[:, 0] >= used.shape[1] // 2)

    tracker = SurfelTracker(parameters)
    born = tracker.start(glaring(first.image, clearance_of(used)), first.depth_m, camera)
    assert right(born.points_px).all()
    assert len(born.ids) > 20
    tracker = SurfelTracker(parameters)
    born = tracker.start(first.image, first.depth_m, camera)
    covered = tracker.track(glaring(second.image, clearance_of(used)), STEP_S)
    here = right(born.points_px)
    assert (covered.state[~here] != SurfelState.TRACKED).all()
    assert np.count_nonzero(~here) > 10
    assert (covered.state[here] == SurfelState.TRACKED).mean() > 0.8
    assert glaring(first.image, None) is first.image
