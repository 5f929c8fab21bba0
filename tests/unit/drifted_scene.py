"""A map that has drifted on its way there and back, and where the camera recognises it."""

from copy import deepcopy

import numpy as np
import pytest
from mapped_scene import Published, similarity
from mapping_scene import CAMERA, INTERVAL_NS, Scene, looking

from pliant.algorithms.geometry import align_umeyama, inverse, transform
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.adjust.loops import Loop
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.map.landmarks import MAPPED
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import (
    MappingParameters,
    ReacquisitionParameters,
    WholeMapParameters,
    WindowParameters,
)
from pliant.state import load_state, save_state

AWAY = 80


PARAMETERS = MappingParameters(
    window=WindowParameters(keyframes=5, keyframe_iterations=2),
    reacquisition=ReacquisitionParameters(radius_px=0.01),
    whole_map=WholeMapParameters(growth=0.0, distance_frames=3),
)


def there_and_back():
    """A camera that goes along a wall, and comes back."""
    return [
        looking((0.08 * k, 0.03 * np.sin(0.3 * k), 0.0)) for k in [*range(AWAY), *range(AWAY)[::-1]]
    ]


@pytest.fixture(scope="module")
def world():
    generator = np.random.default_rng(0)
    points = generator.uniform((-4.0, -3.0, 3.0), (11.0, 3.0, 9.0), (1500, 3))
    kappas = generator.uniform(5.0, 500.0, len(points)).astype(np.float32)
    scene = Scene(points, kappas, death=0.01)
    return scene, list(scene.frames([*there_and_back(), *there_and_back()[:10]]))


@pytest.fixture(scope="module")
def drifted_once(world):
    """A map whose points were mapped again on the way back, and whose scale drifts on the way."""
    scene, frames = world
    mapper, published = Mapper(CAMERA, PARAMETERS, 0), Published()
    for k, tracks in enumerate(frames[: 2 * AWAY]):
        published.apply(mapper.process(Frame(k, k * INTERVAL_NS, tracks)))
    active = mapper.atlas.active
    ids = np.array([keyframe.id for keyframe in active.keyframes])
    drift = np.array([similarity(1.005**k, (0, 1e-3 * k, 0), (0, 0, 0)) for k in range(len(ids))])
    moved = mapper.atlas.move(MapMoves(keyframe_ids=ids, moves=drift))
    mapper.follow([moved])
    assert moved.S[0, 0] > 1.1
    return scene, frames, mapper, published


@pytest.fixture
def drifted(drifted_once):
    """A copy of it that a test may change: to map the way takes longer than what is tested."""
    scene, frames, mapper, published = drifted_once
    return scene, frames, load_state(save_state(mapper)), deepcopy(published)


def recognised(scene, mapper, *, wrong=False):
    """The loop between the first keyframe and the last, by what they see of the scene."""
    active, points = mapper.atlas.active, mapper.atlas.points
    old, new = active.keyframes[0], active.keyframes[-1]
    seen = []
    for keyframe in (old, new):
        px = CAMERA.project(transform(inverse(there_and_back()[keyframe.frame]), scene.points))
        rows = keyframe.rows[points.state[keyframe.rows] == MAPPED]
        at = keyframe.points_px[points.state[keyframe.rows] == MAPPED]
        apart = np.linalg.norm(at[:, None] - px[None], axis=2)
        which = apart.argmin(axis=1)
        good = apart.min(axis=1) < 1.0
        seen.append(dict(zip(which[good].tolist(), rows[good].tolist(), strict=True)))
    both = sorted(set(seen[0]) & set(seen[1]))
    rows = np.array([(seen[0][k], seen[1][k]) for k in both], np.int32)
    rows = rows[rows[:, 0] != rows[:, 1]]
    S = np.eye(4)
    scale, R, t = align_umeyama(points.xyz[rows[:, 1]], points.xyz[rows[:, 0]], with_scale=True)
    S[:3, :3], S[:3, 3] = scale * R, t
    if wrong:
        S[:3, 3] += (3.0, 0.0, 2.0)
    return Loop(old=old.id, new=new.id, S_old_new=S, rows=rows, ids=points.ids[rows])
