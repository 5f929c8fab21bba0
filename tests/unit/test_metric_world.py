"""Messages in metres and with z up: the same map as before, moved by one similarity."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import (
    matrix_to_pose,
    pose_to_matrix,
    similarity_to_matrix,
    so3_exp,
)
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.algorithms.map_delta import TRACKING
from pliant.errors import ResultError
from pliant.map_history import MapHistory
from pliant.messages.metric import MetricWorld, in_metres
from pliant.messages.types import MapUpdate, MeshPiece
from pliant.results.inertial import by_samples, upright
from pliant.results.known_scale import Level, Scale, level_of, read_scale

R = so3_exp(np.array([0.4, -1.1, 0.7]))
WORLD = MetricWorld(metres_per_unit=2.5, R=R, z_is_up=True)
A = similarity_to_matrix(np.array([0.0, 0.0, 0.0, *matrix_to_pose(np.eye(4))[3:], 2.5]))
A[:3, :3] = 2.5 * R


def poses(rng: np.random.Generator, count: int) -> F64:
    quat = rng.normal(size=(count, 4))
    return np.column_stack(
        [rng.normal(size=(count, 3)), quat / np.linalg.norm(quat, axis=1)[:, None]]
    )


def updates() -> list[MapUpdate]:
    """Two keyframes with points and frames, which then move, each by its own similarity."""
    rng, ids = np.random.default_rng(0), np.arange(2)
    first = MapUpdate(
        frame=1, stamp_ns=10, frame_id="world", state=TRACKING, reason="", segment=0, inliers=99,
        pose_frames=ids, pose_segments=np.zeros(2, np.int32), pose_keyframes=ids,
        poses_keyframe_camera=poses(rng, 2), pose_inliers=np.full(2, 99, np.int32),
        keyframe_ids=ids, keyframe_frames=ids, keyframe_segments=np.zeros(2, np.int32),
        keyframe_poses=poses(rng, 2), point_ids=ids, point_segments=np.zeros(2, np.int32),
        points_world=rng.normal(size=(2, 3)), point_colours=np.zeros((2, 3), np.uint8),
        point_keyframes=np.ones(2, np.int32), point_parallax_rad=np.ones(2, np.float32),
        point_sigmas=np.ones(2, np.float32), removed_point_ids=np.zeros(0, np.int64),
        point_hosts=ids,
    )  # fmt: skip
    none = {name: value[:0] for name, value in vars(first).items() if isinstance(value, np.ndarray)}
    moves = np.column_stack([poses(rng, 2), [1.1, 0.9]])
    return [first, replace(first, **none | {"frame": 2, "moved_keyframes": ids, "moves": moves})]


def test_a_map_that_moves_is_the_same_map_in_the_metric_world() -> None:
    before, after = MapHistory(), MapHistory()
    for update in updates():
        changed = in_metres(update, WORLD)
        assert isinstance(changed, MapUpdate)
        for history, message in ((before, update), (after, changed)):
            history.apply(message, frame=message.frame, stamp_ns=message.stamp_ns)
    points, moved = before.points().positions, after.points().positions
    np.testing.assert_allclose(moved, points @ A[:3, :3].T, atol=1e-12)
    for (_, pose), (_, turned) in zip(before.final().values(), after.final().values(), strict=True):
        T, T_metric = pose_to_matrix(pose), pose_to_matrix(turned)
        np.testing.assert_allclose(T_metric[:3, :3], R @ T[:3, :3], atol=1e-12)
        np.testing.assert_allclose(T_metric[:3, 3], 2.5 * R @ T[:3, 3], atol=1e-12)


def test_moves_are_conjugated() -> None:
    moves = updates()[1].moves
    found = similarity_to_matrix(WORLD.moves(moves))
    np.testing.assert_allclose(found, A @ similarity_to_matrix(moves) @ np.linalg.inv(A))


def test_a_scale_alone_changes_no_rotation() -> None:
    update = updates()[0]
    changed = in_metres(update, MetricWorld(metres_per_unit=2.0))
    assert isinstance(changed, MapUpdate)
    assert changed.keyframe_poses[:, 3:].tobytes() == update.keyframe_poses[:, 3:].tobytes()
    np.testing.assert_array_equal(changed.points_world, 2.0 * update.points_world)


def test_a_mesh_turns_with_its_normals() -> None:
    xyz = np.float32([[1.0, 2.0, 3.0], [0.0, 1.0, 0.0], [4.0, 0.0, 1.0]])
    normals = np.float32([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
    piece = MeshPiece(
        frame=0, stamp_ns=0, frame_id="world", segment=0, level="fine", voxel_size=0.1, keyframes=2,
        piece=0, pieces=1, positions=xyz, normals=normals, colours=np.zeros((3, 3), np.uint8),
        triangles=np.int32([[0, 1, 2]]),
    )  # fmt: skip
    found = in_metres(piece, WORLD)
    assert isinstance(found, MeshPiece)
    assert found.positions.dtype == found.normals.dtype == np.float32
    np.testing.assert_allclose(found.positions, xyz @ A[:3, :3].T, rtol=1e-5)
    np.testing.assert_allclose(found.normals, normals @ R.T, atol=1e-6)
    assert found.voxel_size == pytest.approx(0.25)


def test_a_scale_is_read_as_it_was_written(tmp_path: Path) -> None:
    found = Scale(metres_per_unit=1.7, sigma=0.01, source="samples", level=level_of(R, 0.2))
    (tmp_path / "scale.yaml").write_text(found.yaml())
    assert read_scale(tmp_path) == found
    np.testing.assert_allclose(found.world.R, R)
    # As it was before there was a level.
    (tmp_path / "scale.yaml").write_text("metres_per_unit: 2.0\nsigma: 0.0\nsource: points\n")
    old = read_scale(tmp_path)
    assert old == Scale(metres_per_unit=2.0, sigma=0.0, source="points")
    assert not old.world.z_is_up
    for level in ("[1]", "{rotation_xyzw: [1, 1, 1, 1], sigma_deg: 1}", "{sigma_deg: 1}"):
        (tmp_path / "scale.yaml").write_text(f"{old.yaml()}level: {level}\n")
        with pytest.raises(ResultError, match="no valid scale"):
            read_scale(tmp_path)


def test_what_is_found_later_adds_up() -> None:
    first = Scale(metres_per_unit=2.0, sigma=0.01, source="samples", level=level_of(R, 0.2))
    length = Scale(metres_per_unit=1.01, sigma=0.0, source="two points")
    both = first.times(length)
    assert both == replace(first, metres_per_unit=2.02, sigma=0.0, source="two points")
    again = both.times(replace(length, level=level_of(R.T, 0.1)))
    assert again.level is not None
    np.testing.assert_allclose(again.level.R, np.eye(3), atol=1e-12)
    assert isinstance(length.times(first).level, Level)


def test_upright_is_the_smallest_rotation() -> None:
    rng = np.random.default_rng(2)
    for up in (*rng.normal(size=(20, 3)), np.array([0.0, 0.0, 1.0]), np.array([0.0, 0.0, -1.0])):
        up = up / np.linalg.norm(up)
        found = upright(up)
        np.testing.assert_allclose(found @ up, [0.0, 0.0, 1.0], atol=1e-12)
        np.testing.assert_allclose(found @ found.T, np.eye(3), atol=1e-12)
        assert np.trace(found) == pytest.approx(1.0 + 2.0 * up[2], abs=1e-9)
    # A camera that begins upright looks along y, with x to the right.
    ahead = upright(np.array([0.0, -1.0, 0.0])) @ [0.0, 0.0, 1.0]
    np.testing.assert_allclose(ahead, [0.0, 1.0, 0.0], atol=1e-12)


def test_without_a_map_nothing_is_said() -> None:
    assert by_samples(MapHistory(), ImuSamples.empty()) == "there is no map"
