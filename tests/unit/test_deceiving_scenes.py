"""Scenes that look the same in more than one place: none of these may be taken for another."""

import numpy as np
import pytest
from mapped_scene import Published, trajectory_error
from mapping_scene import CAMERA, INTERVAL_NS, Scene
from pictured_scene import MERGING, Film, along, dark, film, textures

from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.tracks import FrameExtrema

_END = 16.0
_NIGHT = [dark(FrameExtrema.empty())] * 40


def wall(seed: int, count: int) -> np.ndarray:
    return np.random.default_rng(seed).uniform((-4.0, -3.0, 3.0), (_END, 3.0, 7.0), (count, 3))


def scene_of(points: np.ndarray, looks: np.ndarray) -> tuple[Scene, list[np.ndarray]]:
    """Points of which those with the same number look the same."""
    squares = textures(int(looks.max()) + 1)
    kappas = np.random.default_rng(5).uniform(5.0, 500.0, len(squares)).astype(np.float32)
    return Scene(points, kappas[looks]), [squares[k] for k in looks.tolist()]


def doors(share: float) -> tuple[Scene, list[np.ndarray]]:
    """A wall on which the same door stands every 2.5 m.   share: of the points that are doors'."""
    starts = np.arange(-4.0, _END, 2.5)
    own = np.random.default_rng(2).uniform((0, -3, 3), (2.5, 3, 7), (round(share * 145), 3))
    rest = wall(1, round((1.0 - share) * 1150))
    points = np.concatenate([*[np.add(own, (start, 0.0, 0.0)) for start in starts], rest])
    looks = [np.arange(len(own))] * len(starts) + [len(own) + np.arange(len(rest))]
    return scene_of(points, np.concatenate(looks))


def rooms(share: float) -> tuple[Scene, list[np.ndarray]]:
    """Two stretches of a wall that are alike but for a share of their points, 12 m apart."""
    first = np.random.default_rng(3).uniform((-4, -3, 3), (4, 3, 7), (460, 3))
    changed = np.random.default_rng(4).random(len(first)) < share
    between = np.random.default_rng(5).uniform((4, -3, 3), (8, 3, 7), (230, 3))
    second = np.add(first, (12.0, 0.0, 0.0))
    second[changed, 1] *= -1.0
    points = np.concatenate([first, second, between])
    other = np.where(changed, 460 + np.arange(460), np.arange(460))
    return scene_of(points, np.concatenate([np.arange(460), other, 920 + np.arange(230)]))


def run(shots: Film) -> tuple[Published, int, Mapper]:
    """What a run publishes, how many segments have been joined, and the mapper."""
    mapper, published, joined = Mapper(CAMERA, MERGING, 0), Published(), 0
    for k, (tracks, grey) in enumerate(shots):
        delta = mapper.process(Frame(k, k * INTERVAL_NS, tracks, grey))
        mapper.publish_keyframes()
        published.apply(delta)
        joined += len(delta.joined)
    published.apply(mapper.finish())
    return published, joined, mapper


@pytest.mark.parametrize("share", [0.4, 0.8])
def test_the_same_door_again_and_again_closes_no_loop(share: float) -> None:
    poses = along(-2, 8, 0.2)
    published, joined, mapper = run(film(*doors(share), poses, 0))
    assert joined == 0
    assert mapper.counters["places_closed"] == 0
    assert mapper.counters["places_refused"] == mapper.counters["places_confirmed"]
    assert (mapper.counters["places_confirmed"] > 0) == (share > 0.5)
    assert len(published.poses) == len(poses)
    assert trajectory_error(published, poses)[0] < 1e-3


@pytest.mark.parametrize("share", [0.1, 0.0])
def test_of_two_rooms_that_are_alike_neither_is_taken_for_the_other(share: float) -> None:
    """Also where nothing in the images tells them apart, and the camera comes back to one."""
    through, back = along(-2, 12.5, 0.2), along(12.5, 11, 0.2)
    scene = rooms(share)
    shots = film(*scene, through, 0) + _NIGHT + film(*scene, back, 1)
    published, joined, _ = run(shots)
    assert joined == 0
    seen = {k: pose for k, pose in published.poses.items() if pose[2] == 0}
    assert set(range(len(through))) <= seen.keys()
    # Of those after the dark it says the right place, or that it is a world of its own.
    published.poses = seen
    poses = [*through, *[np.eye(4)] * len(_NIGHT), *back]
    assert trajectory_error(published, poses)[0] < 1e-3
