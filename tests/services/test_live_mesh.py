"""The mesh of a session that goes on: segments that are joined, and loops that are closed."""

from dataclasses import replace

import numpy as np
import pytest
from meshing_scene import (
    FRAMES,
    POINTS,
    VOXEL,
    Inputs,
    Notes,
    final,
    inputs,
    keyframe,
    live,
    map_update,
    pose,
    run,
    seen,
    world,
)

from pliant.algorithms.geometry import inverse, matrix_to_pose, move_by_similarity, transform
from pliant.bus.replay_bus import ReplayBus
from pliant.config import load_config
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import Header, Keyframe, MapUpdate
from pliant_services.nodes import meshing

MET, JOINED = 2, 4
"""Frames: from MET on the camera is in another segment, until it is known where that lies."""


@pytest.fixture(scope="module")
def outputs() -> dict[Topic, list[Header]]:
    return run(inputs())


def two_segments() -> Inputs:
    """The same keyframes; those of a second segment at twice the size, with points of its own."""
    given = inputs()
    T = looking_aside()
    larger = T @ np.diag([2.0, 2.0, 2.0, 1.0])
    first = map_update(0)
    own = {
        "point_ids": first.point_ids + POINTS, "point_segments": np.ones(POINTS, np.int32),
        "points_world": transform(larger, first.points_world),
        "point_hosts": np.full(POINTS, MET),
    }  # fmt: skip
    for frame in range(MET, FRAMES):
        update = map_update(frame)
        if frame < JOINED:
            there = matrix_to_pose(move_by_similarity(larger, pose(frame))[None])
            one = np.ones(1, np.int32)
            update = replace(update, segment=1, keyframe_segments=one, keyframe_poses=there)
        if frame == MET:
            points = {name: getattr(first, name) for name in vars(first) if "point" in name}
            update = replace(update, **points | own)
        if frame == JOINED:
            back = inverse(T)
            back[:3, 3] *= 0.5
            update = replace(
                update, joined=np.array([[1, 0]], np.int32), moved_keyframes=np.array([MET]),
                moves=np.append(matrix_to_pose(back), 0.5)[None],
            )  # fmt: skip
        given[topics.MAP_UPDATE][frame] = update
    for topic in (topics.KEYFRAME, topics.KEYFRAME_FINAL):
        given[topic] = [seeing_its_own(message) for message in given[topic]]
    return given


def looking_aside() -> np.ndarray:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = [[0, 0, 1], [0, 1, 0], [-1, 0, 0]], (1.0, 2.0, 3.0)
    return T


def seeing_its_own(message: Header, last: int = FRAMES) -> Keyframe:
    """Keyframes of the second segment, and later ones before the last, see the points of that."""
    assert isinstance(message, Keyframe)
    second = (message.keyframe_ids >= MET) & (message.keyframe_ids < last)
    own = np.repeat(second, message.counts)
    return replace(message, point_ids=message.point_ids + POINTS * own)


def test_segments_that_were_joined_are_one_mesh(outputs: dict[Topic, list[Header]]) -> None:
    made = run(two_segments())
    for level in ("fine", "coarse"):
        one, alone = final(made, level), final(outputs, level)
        assert (one.segment, one.keyframes) == (0, FRAMES)
        assert len(one.triangles) == pytest.approx(len(alone.triangles), rel=0.05)
        assert one.positions[:, 2].max() < 4.1
    # Its voxels are those of the first keyframe that was fused, which is another one.
    triangles = len(live(outputs, 0).triangles)
    assert len(live(made, 0).triangles) == pytest.approx(triangles, rel=0.2)


def test_a_resumed_segment_has_its_mesh_again(outputs: dict[Topic, list[Header]]) -> None:
    """The camera is recognised in the first of two segments: the keyframes from before that only
    they saw the left of the wall."""
    given = two_segments()
    update = given[topics.MAP_UPDATE][JOINED]
    assert isinstance(update, MapUpdate)
    nothing = map_update(JOINED)
    given[topics.MAP_UPDATE][JOINED] = nothing
    for topic in (topics.KEYFRAME, topics.KEYFRAME_FINAL):
        given[topic] = [seeing_its_own(message, last=JOINED) for message in inputs()[topic]]
    found, whole = live(run(given), 0).positions, live(outputs, 0).positions
    np.testing.assert_allclose(found.min(axis=0), whole.min(axis=0), atol=0.05)


DRIFT = 0.6
"""Three coarse voxels."""
QUIET = 6
"""Frames at the end that are no keyframes."""


def a_loop() -> Inputs:
    """The wall lies DRIFT farther away from MET on, cameras and all, until a loop is closed."""
    given = inputs()
    first, away = map_update(0), np.array([0.0, 0.0, DRIFT])
    for frame in range(MET, FRAMES):
        update = map_update(frame)
        poses = update.keyframe_poses + np.append(away, np.zeros(4))
        update = replace(update, keyframe_poses=poses)
        if frame == MET:
            points = {name: getattr(first, name) for name in vars(first) if "point" in name}
            points["point_ids"] = first.point_ids + POINTS
            points["points_world"] = first.points_world + away
            points["point_hosts"] = np.full(POINTS, MET)
            update = replace(update, **points)
        given[topics.MAP_UPDATE][frame] = update
    quiet = range(FRAMES, FRAMES + QUIET)
    given[topics.MAP_UPDATE] += [map_update(frame, last=True) for frame in quiet]
    given[topics.KEYFRAME] += [keyframe(frame, -1, []) for frame in quiet]
    closes = given[topics.MAP_UPDATE][FRAMES]
    assert isinstance(closes, MapUpdate)
    back = np.eye(4)
    back[:3, 3] = -away
    given[topics.MAP_UPDATE][FRAMES] = replace(
        closes, moved_keyframes=np.array([MET]), moves=np.append(matrix_to_pose(back), 1.0)[None]
    )
    for topic in (topics.KEYFRAME, topics.KEYFRAME_FINAL):
        given[topic] = [seeing_its_own(message) for message in given[topic]]
    return given


def test_a_live_mesh_follows_a_loop(outputs: dict[Topic, list[Header]]) -> None:
    def followed() -> tuple[dict[Topic, list[Header]], list[float]]:
        bus, monitor = ReplayBus(a_loop()), Notes()
        meshing.run(bus, load_config(None), monitor)
        return bus.outputs, monitor.again

    made, again = followed()
    found, true = live(made, 0), live(outputs, 0)
    assert found.positions[:, 2].max() < 4.1
    for one, other in ((found, true), (true, found)):
        apart = np.linalg.norm(one.positions[:, None] - other.positions[None], axis=2).min(axis=1)
        # At its rims the surface ends a voxel earlier or later.
        assert np.percentile(apart, 95) < 0.05 * VOXEL
        assert apart.max() < 1.1 * VOXEL
    assert len(found.triangles) == pytest.approx(len(true.triangles), rel=0.1)
    # One a frame, those that had left the window among them, and each once.
    assert np.diff(again).max() == 1.0
    assert again[-1] == FRAMES - MET
    again = followed()[0]
    for topic in (topics.MESH_BLOCKS, topics.MESH_FINAL):
        told = [codec.encode(message) for message in made[topic]]
        assert [codec.encode(message) for message in again[topic]] == told


def test_joined_segments_have_their_mesh_without_another_keyframe() -> None:
    """Each has one keyframe, and the camera stands still from when they are joined on."""
    given = two_segments()
    for frame in set(range(FRAMES)) - {0, MET}:
        given[topics.KEYFRAME][frame] = keyframe(frame, -1, [])
    mesh = live(run(given), 0)
    whole = world()[np.concatenate([seen(0)[0], seen(MET)[0]]), 0]
    assert mesh.positions[:, 0].min() == pytest.approx(whole.min(), abs=VOXEL)
    assert mesh.positions[:, 0].max() == pytest.approx(whole.max(), abs=VOXEL)
    assert mesh.positions[:, 2].max() < 4.1
