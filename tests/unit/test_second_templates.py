"""The second template of a surfel: what is renewed, what is confirmed, where neighbours lead."""

import cv2
import numpy as np
import pytest
from flat_texture import CAMERA, DEPTH, texture

from pliant.algorithms.arrays import U8
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.patch_sampling import X
from pliant.algorithms.surfels.second_templates import carried_by_neighbours
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker

STEP_S = 1.0 / 30.0


def film(last_share: float, count: int) -> list[U8]:
    """A surface whose texture turns, bit by bit, into another one, and moves by 0.8 px a frame."""
    shares = np.linspace(0.0, last_share, count)
    images: list[U8] = []
    for number, share in enumerate(shares):
        mixed = np.sqrt(1.0 - share**2) * texture(0) + share * texture(1)
        move = np.array([[1.0, 0.0, 0.8 * number], [0.0, 1.0, -0.4 * number]])
        moved = cv2.warpAffine(
            128.0 + 35.0 * mixed, move, (320, 240), borderMode=cv2.BORDER_REFLECT
        )
        images.append(np.clip(moved, 0, 245).astype(np.uint8))
    return images


def tracker(image: U8) -> SurfelTracker:
    made = SurfelTracker(SurfelParameters(max_surfels=60, levels=2))
    made.start(image, DEPTH, CAMERA)
    return made


def test_a_texture_that_changes_slowly_is_followed_and_not_confirmed() -> None:
    images = film(0.75, 16)
    made = tracker(images[0])
    first = made.start(images[0], DEPTH, CAMERA)
    last = [made.track(image, STEP_S) for image in images[1:]][-1]
    inside = (last.points_px[:, 0] < 290) & (last.points_px[:, 1] > 30)
    alive = inside & (last.state == 0)
    assert alive.sum() > 0.8 * inside.sum()
    moved = last.points_px[alive] - first.points_px[alive]
    np.testing.assert_allclose(np.median(moved, axis=0), [12.0, -6.0], atol=0.3)
    renewed = alive & (last.confirmed == 0)
    assert renewed.sum() > 0.5 * alive.sum()
    assert (last.birth_zncc[renewed] < 0.93).all()
    assert np.median(last.birth_zncc[renewed]) < 0.85
    assert (last.zncc[alive] > 0.85).all()
    # The old look comes back: the birth templates are in use again, and their places are exact.
    again = film(0.0, 16)[15]
    last = [made.track(again, STEP_S) for _ in range(8)][-1]
    confirmed = last.confirmed > 0
    assert confirmed.sum() > 0.8 * inside.sum()
    np.testing.assert_array_equal(last.birth_zncc[confirmed], last.zncc[confirmed])
    moved = last.points_px[confirmed] - first.points_px[confirmed]
    assert np.median(np.linalg.norm(moved - [12.0, -6.0], axis=1)) < 0.1


def test_a_template_taken_in_other_light_keeps_gain_and_bias_of_birth() -> None:
    images = film(0.5, 12)
    darker = [np.clip(0.8 * image + 10.0, 0, 255).astype(np.uint8) for image in images]
    made = tracker(images[0])
    last = [made.track(image, STEP_S) for image in darker[1:]][-1]
    renewed = (last.state == 0) & (last.confirmed == 0)
    assert renewed.sum() > 5
    # Eq. 5: gain times frame plus bias is the texture of birth.
    assert np.median(last.gains[renewed]) == pytest.approx(1.25, abs=0.1)
    assert np.median(last.biases[renewed]) == pytest.approx(-12.5, abs=10.0)


def test_a_texture_that_stays_keeps_every_birth_template() -> None:
    images = film(0.0, 6)
    made = tracker(images[0])
    last = [made.track(image, STEP_S) for image in images[1:]][-1]
    alive = last.state == 0
    assert alive.sum() > 40
    assert (last.confirmed[alive] == 1).all()
    np.testing.assert_array_equal(last.birth_zncc, last.zncc)


def test_a_search_that_leads_away_from_all_neighbours_is_refused() -> None:
    """What has grown by 30 % about a surfel looks the same, 23 % nearer."""
    still = film(0.0, 1)[0]
    made = SurfelTracker(SurfelParameters(max_surfels=80, levels=2, patch_px=11))
    first = made.start(still, DEPTH, CAMERA)
    from_middle = np.linalg.norm(first.points_px - [160.0, 120.0], axis=1)
    row = int(from_middle.argmin())
    v, u = np.mgrid[0:240, 0:320].astype(np.float32)
    du, dv = u - first.points_px[row, 0], v - first.points_px[row, 1]
    shrunk = np.where(np.maximum(np.abs(du), np.abs(dv)) < 12, 1.0 / 1.3, 1.0).astype(np.float32)
    grown = cv2.remap(still, u - du + shrunk * du, v - dv + shrunk * dv, cv2.INTER_CUBIC)
    table = made._now.table
    for image, refused in ((still, False), (grown, True)):
        table.state[row], table.renewed[row] = SurfelState.OUTLIER, True
        pyramid = made._frames.pyramid(image, CAMERA)
        for frame in range(5):  # a fifth of the surfels is searched in each
            made._frames.update_templates(made._now, pyramid, frame)
        assert table.renewed[row] == refused
        np.testing.assert_allclose(table.poses[row, X + 2], 1.0, atol=0.01)


def test_neighbours_carry_a_surfel_by_their_affine_motion() -> None:
    generator = np.random.default_rng(0)
    rest = np.column_stack([generator.uniform(-1, 1, (30, 2)), np.full(30, 2.0)])
    stretch = np.array([[1.2, 0.1, 0.0], [-0.05, 0.9, 0.0], [0.3, 0.2, 1.0]])
    points = rest @ stretch.T + [0.1, -0.2, 0.05]
    exact = points[3].copy()
    points[3] = 7.0
    confirmed = np.ones(30, np.bool_)
    confirmed[3] = False
    born = np.zeros(30, np.int32)
    rows, carried, nearest = carried_by_neighbours(~confirmed, confirmed, born, rest, points)
    assert rows.tolist() == [3]
    others = np.linalg.norm(rest - rest[3], axis=1)
    assert nearest.tolist() == [int(np.argsort(others)[1])]
    np.testing.assert_allclose(carried[0], exact, atol=1e-9)
    # Surfels of another batch have another rest, and say nothing.
    born[3] = 5
    assert len(carried_by_neighbours(~confirmed, confirmed, born, rest, points)[0]) == 0
