"""A place that looks like a frame counts only if no other place does, and others are asked."""

from types import SimpleNamespace

import numpy as np
import pytest
from mapping_scene import CAMERA, looking

from pliant.algorithms.arrays import F64
from pliant.algorithms.slam.adjust.segment import Segment
from pliant.algorithms.slam.atlas import known_places
from pliant.algorithms.slam.atlas.known_places import KnownPlaces
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.locate.landmark_search import LandmarkSearch
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.map.landmarks import Landmarks
from pliant.algorithms.slam.parameters import MappingParameters
from pliant.algorithms.slam.places import relocalisation
from pliant.algorithms.slam.places.place_index import Features
from pliant.algorithms.slam.places.relocalisation import Place, Recognised, relocalise

PARAMETERS = MappingParameters()
NOTHING = Features(points_px=np.zeros((0, 2), np.float32), descriptors=np.zeros((0, 32), "u1"))
NO_MAXIMA, DARK = np.zeros((0, 3), np.float32), np.zeros((CAMERA.height, CAMERA.width), np.uint8)
EACH = 50


def search_in(points: Landmarks) -> LandmarkSearch:
    """In a dark image."""
    generator = np.random.default_rng(0)
    return LandmarkSearch(points, NO_MAXIMA, DARK, CAMERA, PARAMETERS, generator)


def keyframes(points: Landmarks, count: int) -> list[Keyframe]:
    """Every second one sees what the one before saw; their points lie 4 units ahead."""
    made: list[Keyframe] = []
    for number in range(count):
        rows = made[-1].rows if number % 2 else points.allocate(EACH)
        if number % 2 == 0:
            points.promote(rows)
            points.xyz[rows] = (float(number), 0.0, 4.0)
        px = np.zeros((EACH, 2), np.float32)
        pose = looking((float(number), 0.0, 0.0))
        made.append(
            Keyframe(
                id=number, frame=number, segment=0, T_world_camera=pose, rows=rows, points_px=px,
                rolled_px=px,
            )
        )  # fmt: skip
    return made


def ask(
    monkeypatch: pytest.MonkeyPatch,
    said: dict[int, tuple[int, int]],
    first: int = 1,
    repeated: float = 0.0,
    places_with_corners: int | None = None,
) -> Recognised | None:
    """What is recognised where keyframes have so many corners and points for them, each at a pose
    of its own.   first: places that look most like the frame; the others are elsewhere.
    repeated: share of the corners that the image shows again.   places_with_corners: of those said,
    all if None; the others are poses that points alone may tell."""
    points = Landmarks()
    places = [
        Place(keyframe=k, corners=NOTHING, segment=[k])
        for k in keyframes(points, 1 + max(said))
        if k.id in list(said)[:places_with_corners]
    ]

    def propose(_: Features, place: Place, *__: object) -> list[SimpleNamespace]:
        corners = np.random.default_rng(0).uniform(0, 600, (said[place.keyframe.id][0], 2))
        proposed = SimpleNamespace(
            T_world_camera=looking((3.0 * place.keyframe.id, 0.0, 0.0)),
            place=place,
            corners=np.arange(len(corners)),
            corners_px=corners.astype(np.float32),
            xyz=np.zeros((len(corners), 3)),
            share=0.9,
        )
        return [proposed]

    def verify(_: LandmarkSearch, T_world_camera: F64, *__: object) -> SimpleNamespace:
        count = said[round(T_world_camera[0, 3] / 3.0)][1]
        return SimpleNamespace(T_world_camera=T_world_camera, rows=np.arange(count, dtype=np.int32))

    def share(*_: object, **__: object) -> float:
        return repeated

    monkeypatch.setattr(relocalisation, "_propose", propose)
    monkeypatch.setattr(LandmarkSearch, "verify", verify)
    monkeypatch.setattr(relocalisation, "repeated_share", share)
    return relocalise(NOTHING, places[:first], places[first:], search_in(points))


def test_a_place_that_is_mapped_more_densely_is_not_more_right(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Two rooms: one was mapped from nearby, and has far more points; corners tell of both."""
    assert ask(monkeypatch, {0: (170, 2400), 2: (420, 690)}) is None
    found = ask(monkeypatch, {0: (170, 2400), 2: (60, 690)})
    assert found is not None
    assert found.keyframe.id == 0


def test_poses_by_keyframes_that_see_the_same_points_are_of_one_place(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    found = ask(monkeypatch, {0: (170, 2400), 1: (420, 690)})
    assert found is not None
    assert found.keyframe.id == 0


def test_what_the_image_shows_again_a_step_aside_proves_no_pose(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert ask(monkeypatch, {0: (170, 2400)}, repeated=0.4) is not None
    assert ask(monkeypatch, {0: (170, 2400)}, repeated=0.6) is None


def test_fewer_points_and_corners_than_a_start_needs_verify_no_place_but_rival_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert ask(monkeypatch, {0: (99, 99)}) is None
    assert ask(monkeypatch, {0: (99, 100)}) is not None
    assert ask(monkeypatch, {0: (100, 99)}) is not None
    assert ask(monkeypatch, {0: (60, 120), 2: (60, 70)}) is None


@pytest.mark.parametrize(("points", "place"), [(3000, 4), (2300, 4), (1000, 0)])
def test_points_that_support_another_pose_decide(
    monkeypatch: pytest.MonkeyPatch, points: int, place: int
) -> None:
    """More of them place the camera; half as many leave it open."""

    def near(*_: object) -> SimpleNamespace:
        rows = np.arange(points, dtype=np.int32)
        return SimpleNamespace(T_world_camera=looking((3.0 * 4, 0.0, 0.0)), rows=rows)

    monkeypatch.setattr(LandmarkSearch, "near", near)
    found = ask(monkeypatch, {0: (170, 2400), 4: (0, points)}, places_with_corners=1)
    if points == 2300:
        assert found is None
        return
    assert found is not None
    assert found.T_world_camera[0, 3] == 3.0 * place
    assert found.inliers == max(points, 2400)


def test_rival_places_are_compared_where_one_is_verified(monkeypatch: pytest.MonkeyPatch) -> None:
    own, points, asked = KnownPlaces(), Landmarks(), list[int]()
    known = keyframes(points, 12)

    def query(*_: object) -> list[int]:
        return [k.id for k in known]

    monkeypatch.setattr(type(own.index), "query", query)
    own.index.features = {k.id: NOTHING for k in known}

    def relocalised(_: Features, places: list[Place], elsewhere: list[Place], *__: object) -> None:
        asked.extend(place.keyframe.id for place in places)
        asked.append(-1)
        asked.extend(place.keyframe.id for place in elsewhere)

    monkeypatch.setattr(known_places, "relocalise", relocalised)
    calibration = SelfCalibration.of(CAMERA, PARAMETERS.calibration)
    segment = Segment(id=0, points=points, keyframes=known)
    own.recognise(search_in(points), [segment], calibration.view)
    # 5 sees what 4 saw, which has been asked, 7 what 6 saw.
    assert asked == [0, 1, 2, 3, 4, -1, 6, 8]
