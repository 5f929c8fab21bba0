"""Corners of an image, the index that finds the places that look like it, and what is repeated."""

import cv2
import numpy as np
import pytest
from mapping_scene import CAMERA

from pliant.algorithms.arrays import U8
from pliant.algorithms.slam.places.place_index import (
    Features,
    PlaceIndex,
    describe,
    match,
    repeated_share,
    words_of,
)
from pliant.state import load_state, save_state

_GATE_PX = 4.0


def noise(seed: int, height: int = 240, width: int = 320) -> np.ndarray:
    """A picture that is like no other."""
    grey = np.random.default_rng(seed).uniform(0, 255, (height, width)).astype(np.float32)
    soft = cv2.GaussianBlur(grey, (0, 0), 2.0)
    return (255.0 * (soft - soft.min()) / (soft.max() - soft.min())).astype(np.uint8)


def bits(generator: np.random.Generator, count: int) -> Features:
    """Corners with descriptors of chance."""
    px = generator.uniform(0.0, 300.0, (count, 2)).astype(np.float32)
    descriptors = generator.integers(0, 256, (count, 32), np.uint8)
    return Features(points_px=px, descriptors=descriptors)


def blurred(features: Features, generator: np.random.Generator, share: float) -> Features:
    """The same corners in another order, with a share of the bits of each turned over."""
    order = generator.permutation(len(features.descriptors))
    known = np.unpackbits(features.descriptors[order], axis=1)
    turned = known ^ (generator.random(known.shape) < share)
    return Features(points_px=features.points_px[order], descriptors=np.packbits(turned, axis=1))


def test_corners_are_found_again_where_the_camera_turned_and_came_nearer():
    grey = noise(1)
    centre, turn, scale = (159.5, 119.5), 40.0, 1.7
    M = cv2.getRotationMatrix2D(centre, turn, scale)
    moved = cv2.warpAffine(grey, M, (320, 240), flags=cv2.INTER_AREA, borderMode=cv2.BORDER_REFLECT)
    a, b = describe(grey), describe((0.5 * moved).astype(np.uint8))  # and in half the light
    pairs = match(a, b)
    expected = a.points_px[pairs[:, 0]] @ M[:, :2].T + M[:, 2]
    errors = np.linalg.norm(expected - b.points_px[pairs[:, 1]], axis=1)
    assert np.count_nonzero(errors < 3.0) >= 40
    assert np.mean(errors < 3.0) > 0.7
    assert len(match(a, describe(noise(2)))) < 10


def test_a_large_image_has_its_corners_where_a_small_one_has_them_in_its_own_pixels():
    small, times = noise(1, 480, 640), (2.5, 2.0)
    large = cv2.resize(small, (1600, 960), interpolation=cv2.INTER_CUBIC)
    a, b = describe(small), describe(large)
    pairs = match(a, b)
    expected = (a.points_px[pairs[:, 0]] + 0.5) * times - 0.5
    errors = np.linalg.norm((expected - b.points_px[pairs[:, 1]]) / times, axis=1)
    assert len(pairs) >= 100
    assert np.median(errors) < 1.0
    assert np.abs(np.median(expected - b.points_px[pairs[:, 1]], axis=0)).max() < 0.5


def test_an_image_of_nothing_has_no_corners():
    features = describe(np.full((48, 64), 90, np.uint8))
    assert features.points_px.shape == (0, 2)
    assert features.descriptors.shape == (0, 32)
    assert match(features, describe(noise(1))).shape == (0, 2)
    index = PlaceIndex()
    index.add(3, features)
    assert index.query(describe(noise(1))) == []


def test_matches_are_those_of_plain_numpy():
    generator = np.random.default_rng(0)
    a = bits(generator, 60)
    b = blurred(a, generator, 0.15)
    distance = (
        np.unpackbits(a.descriptors, axis=1)[:, None] != np.unpackbits(b.descriptors, axis=1)
    ).sum(axis=2)
    expected: list[list[int]] = []
    for i, row in enumerate(distance):
        j, following = np.argsort(row, kind="stable")[:2]
        clear = row[j] <= 64 and row[j] <= 0.85 * row[following]
        if clear and np.argmin(distance[:, j]) == i:
            expected.append([i, int(j)])
    assert len(expected) > 40
    assert match(a, b).tolist() == expected


def test_places_are_found_by_half_of_their_corners():
    generator = np.random.default_rng(1)
    index, places = PlaceIndex(), [bits(generator, 200) for _ in range(300)]
    for number, place in enumerate(places):
        index.add(10 * number, place)
    for number in range(0, 300, 7):
        seen = blurred(places[number], generator, 0.12)
        others = bits(generator, 100)
        half = Features(
            points_px=np.concatenate([seen.points_px[:100], others.points_px]),
            descriptors=np.concatenate([seen.descriptors[:100], others.descriptors]),
        )
        assert index.query(half)[0] == 10 * number


def test_places_are_ranked_by_the_words_that_they_share():
    """And by how rare these are, as plain dictionaries tell."""
    generator = np.random.default_rng(6)
    known = [bits(generator, 30) for _ in range(80)]
    for place in known:  # some words are common, too common, or of one place
        place.descriptors[: generator.integers(0, 30), :4] = 7
    index, having = PlaceIndex(), dict[int, list[int]]()
    for number, place in enumerate(known):
        index.add(number, place)
        for word in words_of(place.descriptors).tolist():
            having.setdefault(word, []).append(number)
    for seen in known[::9]:
        scores = np.zeros(len(known))
        for word in words_of(seen.descriptors).tolist():
            places_with = having[word]
            if len(places_with) < 8.0 + 2.0 * np.sqrt(len(known)):
                scores[places_with] += np.log((1.0 + len(known)) / len(places_with)) ** 2
        scores /= np.sqrt([len(words_of(place.descriptors)) for place in known])
        order = np.argsort(-scores, kind="stable")
        assert index.query(seen) == [int(each) for each in order if scores[each] > 0.0]


def test_what_is_forgotten_is_found_no_more_and_leaves_no_trace():
    generator = np.random.default_rng(2)
    index, places = PlaceIndex(), [bits(generator, 50) for _ in range(200)]
    for number, place in enumerate(places):
        index.add(number, place)
    for number in range(150):
        index.forget([number, 1000])
        assert number not in index.query(places[number])
    fresh = PlaceIndex()
    for number in range(150, 200):
        fresh.add(number, places[number])
    assert index.used < 3 * 150 * len(words_of(places[0].descriptors))
    index.forget(range(160))
    for number in range(160, 200):
        assert index.query(places[number])[0] == number
    assert sorted(index.features) == list(range(160, 200))


def test_the_index_is_kept_in_a_checkpoint():
    generator = np.random.default_rng(3)
    index, places = PlaceIndex(), [bits(generator, 40) for _ in range(5)]
    for number, place in enumerate(places):
        index.add(number, place)
    again = load_state(save_state(index))
    again.add(9, places[0])
    index.add(9, places[0])
    assert again.query(places[0]) == index.query(places[0])
    assert again.query(places[0])[:2] == [0, 9]


def test_a_keyframe_takes_less_than_50_kilobytes():
    features = describe(noise(4, 480, 640))
    index = PlaceIndex()
    index.add(0, features)
    used = features.points_px.nbytes + features.descriptors.nbytes
    assert len(features.points_px) > 600
    assert used + index.used * index.entries.itemsize <= 50_000


def tiles(count: int, other: float) -> U8:
    """A wall of so many by so many tiles that look the same.   other: share of them that do not."""
    rng = np.random.default_rng(0)
    side = CAMERA.height // count

    def tile() -> np.ndarray:
        return cv2.GaussianBlur(rng.integers(0, 255, (side, side)).astype(np.float32), (0, 0), 4.0)

    same = tile()
    lines = [
        np.hstack([tile() if rng.random() < other else same for _ in range(CAMERA.width // side)])
        for _ in range(count)
    ]
    grey = cv2.normalize(np.vstack(lines), None, 0, 255, cv2.NORM_MINMAX)  # pyright: ignore
    return (grey + rng.normal(0.0, 2.0, grey.shape)).clip(0, 255).astype(np.uint8)


def share_of(grey: U8) -> float:
    """Of its corners, as of a wall 2 m away."""
    seen = describe(grey)
    rays = np.column_stack([CAMERA.normalise(seen.points_px.astype(np.float64)), np.ones(700)])
    corners = np.arange(0, 700, 3)
    return repeated_share(
        seen, corners, 2.0 * rays[corners], CAMERA, gate_px=_GATE_PX, least_step=0.2
    )


@pytest.mark.parametrize("count", [3, 6])
def test_tiles_show_the_same_again(count: int) -> None:
    assert share_of(tiles(count, 0.0)) > 0.8


def test_tiles_of_which_most_are_others_do_not() -> None:
    assert share_of(tiles(6, 0.8)) < 0.3
    assert share_of(tiles(6, 1.0)) < 0.1


def test_corners_that_lie_at_one_spot_are_no_step() -> None:
    seen = describe(tiles(6, 0.0))
    xyz = np.tile([0.0, 0.0, 2.0], (700, 1))
    assert repeated_share(seen, np.arange(700), xyz, CAMERA, gate_px=4.0, least_step=0.2) == 0.0
