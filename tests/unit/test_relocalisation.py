"""A camera that was carried off goes on in its map where it sees it again."""

from dataclasses import replace

import numpy as np
import pytest
from mapped_scene import trajectory_error
from mapping_scene import CAMERA, Scene, looking, sideways
from pictured_scene import dark, film, run, textures

from pliant.algorithms.map_delta import LOST, TRACKING, MapMoves
from pliant.algorithms.slam.adjust.global_adjustment import held
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters, WholeMapParameters
from pliant.algorithms.slam.places.place_match import PlaceMatch, match_places
from pliant.algorithms.slam.places.relocalisation import Place
from pliant.algorithms.tracks import FrameExtrema
from pliant.state import load_state, save_state

_DARK = 40
"""Frames in the dark: the map is given up before it is light again."""


@pytest.fixture(scope="module")
def known() -> tuple[Scene, list[np.ndarray]]:
    """A place."""
    scene = Scene.box(500, noise_px=0.1)
    return scene, textures(len(scene.points))


def test_a_relocated_camera_continues_in_its_map(known):
    scene, squares = known
    there = sideways(36, step=0.04)
    # Back in a place between, from elsewhere, turned, and on another way.
    back = [
        T @ looking((0.05, 0.15 - 0.01 * k, 0.1), (0.02, -0.05, 0.12))
        for k, T in enumerate(there[6:26])
    ]
    shots = film(scene, squares, there) + [dark(FrameExtrema.empty())] * _DARK
    published, mapper = run(shots + film(scene, squares, back, cut=1))
    published.apply(mapper.finish())
    assert {segment for _, _, segment in published.poses.values()} == {0}
    first = len(shots)
    assert published.states[first : first + len(back)] == [TRACKING] * len(back)
    assert published.states[len(there)] == LOST
    every = [*there, *[np.eye(4)] * _DARK, *back]
    error, _ = trajectory_error(published, every)
    assert error < 3e-3


def test_a_young_map_ends_where_the_older_one_is_recognised(known):
    scene, squares = known
    elsewhere = Scene.box(500, seed=9, noise_px=0.1)
    there = sideways(36, step=0.04)
    night = [dark(FrameExtrema.empty())] * _DARK
    shots = film(scene, squares, there) + night
    shots += film(elsewhere, squares[::-1], there[:20], cut=1)
    again = film(scene, squares, there[5:25], cut=2)
    published, mapper = run(shots + again)
    published.apply(mapper.finish())
    segments = [segment for _, (_, _, segment) in sorted(published.poses.items())]
    assert segments == [0] * 36 + [1] * 20 + [0] * 20
    every = [*there, *[np.eye(4)] * (_DARK + 20), *there[5:25]]
    published.poses = {k: p for k, p in published.poses.items() if p[2] == 0}
    error, _ = trajectory_error(published, every)
    assert error < 3e-3


def test_the_same_frames_give_the_same_bytes_from_a_checkpoint(known):
    scene, squares = known
    there = sideways(30, step=0.04)
    shots = film(scene, squares, there) + [dark(FrameExtrema.empty())] * _DARK
    shots += film(scene, squares, there[5:15], cut=1)
    whole, _ = run(shots)
    cut = 30 + _DARK - 3
    first, mapper = run(shots[:cut])
    kept = load_state(save_state(mapper))
    rest, _ = run(shots[cut:], kept, cut)
    poses = first.poses | rest.poses
    assert sorted(poses) == sorted(whole.poses)
    assert poses[len(shots) - 1][0] == whole.poses[len(shots) - 1][0]
    np.testing.assert_array_equal(poses[len(shots) - 1][1], whole.poses[len(shots) - 1][1])


def test_what_is_mapped_elsewhere_stays_where_one_segment_moves():
    """A segment that goes on after another one has keyframes on both sides of its."""
    still = np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, 1.0])
    rows = np.array([[float(k), *still[1:]] for k in (1, 2, 3)])
    moves = MapMoves(keyframe_ids=np.array([0, 4, 22], np.int64), moves=rows)
    told = held(moves, [(0, 0), (10, 1), (20, 0)], 0)
    x = told.matrices(np.array([0, 3, 4, 9, 10, 19, 20, 21, 22, 30]))[:, 0, 3]
    assert x.tolist() == [1, 1, 2, 2, 0, 0, 3, 3, 3, 3]
    first = MapMoves(keyframe_ids=moves.keyframe_ids[:1], moves=rows[:1])
    told = held(first, [(0, 0), (10, 1), (20, 0), (30, 1), (40, 0)], 0)
    assert told.matrices(np.array([0, 10, 20, 30, 40]))[:, 0, 3].tolist() == [1, 0, 1, 0, 1]
    alone = held(moves, [(0, 0)], 0)
    assert alone.keyframe_ids.tolist() == [0, 4, 22]


def place_of(mapper: Mapper, number: int) -> Place:
    active = mapper.atlas.active
    assert active is not None
    known = mapper.atlas.places.index.features
    keyframe = next(k for k in active.keyframes[number:] if k.id in known)
    return Place(keyframe=keyframe, corners=known[keyframe.id], segment=active.keyframes)


@pytest.mark.parametrize("alike", [True, False])
def test_two_maps_of_one_place_have_their_relative_pose(known, alike):
    """But not where what lies at the same places looks otherwise."""
    scene, squares = known
    parameters = MappingParameters(whole_map=WholeMapParameters(growth=0.0))
    mapper = Mapper(CAMERA, parameters, 0)
    there = sideways(36, step=0.04)
    run(film(scene, squares, there), mapper)
    old = place_of(mapper, 5)
    assert mapper.atlas.active is not None
    # The same map again, as a world of its own.
    other = load_state(save_state(mapper))
    S = np.eye(4)
    S[:3, :3], S[:3, 3] = 0.6 * looking((0, 0, 0), (0.3, 0.2, -0.1))[:3, :3], (1.0, -2.0, 0.5)
    new = place_of(other, 6)
    points = mapper.atlas.points
    shifted = points.allocate(len(new.keyframe.rows))
    for name in ("state", "kappas", "ids", "patches"):
        getattr(points, name)[shifted] = getattr(points, name)[new.keyframe.rows]
    points.xyz[shifted] = points.xyz[new.keyframe.rows] @ S[:3, :3].T + S[:3, 3]
    if not alike:
        points.patches[shifted] = points.patches[np.roll(shifted, 1)]
    moved = S @ new.keyframe.T_world_camera
    moved[:3, :3] /= 0.6
    keyframe = replace(new.keyframe, rows=shifted, T_world_camera=moved)
    new = replace(new, keyframe=keyframe, segment=[keyframe])
    found = match_places(old, new, points, CAMERA, parameters, np.random.default_rng(0))
    if not alike:
        assert found == "few_points"
        return
    assert isinstance(found, PlaceMatch), found
    np.testing.assert_allclose(found.S_old_new @ S, np.eye(4), atol=5e-3)
    same = dict(zip(shifted.tolist(), place_of(other, 6).keyframe.rows.tolist(), strict=True))
    agree = [same[b] == a for a, b in found.rows.tolist()]
    assert len(agree) >= 30
    assert np.mean(agree) > 0.97
    assert len(set(found.rows[:, 0].tolist())) == len(set(found.rows[:, 1].tolist())) == len(agree)


def test_two_places_are_not_one(known):
    scene, squares = known
    elsewhere = Scene.box(500, seed=9, noise_px=0.1)
    parameters = MappingParameters()
    there = sideways(20, step=0.04)
    a, b = Mapper(CAMERA, parameters, 0), Mapper(CAMERA, parameters, 0)
    run(film(scene, squares, there), a)
    run(film(elsewhere, squares[::-1], there), b)
    why = match_places(
        place_of(a, 3), place_of(b, 3), a.atlas.points, CAMERA, parameters, np.random.default_rng(0)
    )
    assert why in ("few_corners", "few_points")
