"""The volume: surfaces known exactly, removal, memory, and messages that rebuild the mesh."""

import dataclasses
from typing import Any

import numpy as np
import pytest
from fusion_scene import BALL, CAMERA, RADIUS, edge_uses, make_view, surface_errors

from pliant.algorithms.meshing.mesh_blocks import BlockMesh, TriangleMesh
from pliant.algorithms.meshing.parameters import TsdfParameters
from pliant.algorithms.meshing.tsdf_blocks import BlockPool, InMemory, find_rows
from pliant.algorithms.meshing.tsdf_integrate import blocks_in_band, pixel_planes
from pliant.algorithms.meshing.tsdf_volume import TsdfVolume, VolumeFullError
from pliant.fusion.memory import (
    BLOCK_BYTES,
    SCENE_VIEWS,
    VoxelSizeError,
    check_voxel_sizes,
    too_fine,
    view_bytes,
)

VOXEL = 0.05
PARAMETERS = TsdfParameters()


def fused(steps: range, parameters: TsdfParameters = PARAMETERS) -> TsdfVolume:
    volume = TsdfVolume(VOXEL, parameters)
    for step in steps:
        volume.integrate(*make_view(step).arguments())
    return volume


def assert_same(first: Any, second: Any) -> None:
    for field in dataclasses.fields(first):
        np.testing.assert_array_equal(
            getattr(first, field.name), getattr(second, field.name), err_msg=field.name
        )


def test_a_pool_keeps_what_is_in_its_blocks_as_others_come_and_go() -> None:
    generator = np.random.default_rng(0)
    pool = BlockPool(InMemory(most=2000))
    held: dict[tuple[int, ...], int] = {}

    def check() -> None:
        assert len(pool.keys) == len(pool.births) == len(held)
        keys = np.array(sorted(held), np.int32).reshape(-1, 3)
        rows = find_rows(pool.table, keys)
        assert sorted(rows.tolist()) == list(range(len(held)))
        for sums in pool.sums:
            found = sums[rows].reshape(len(rows), sums[0].size)
            assert np.array_equal(found.min(axis=1), [held[key] for key in sorted(held)])
            assert np.array_equal(found.max(axis=1), [held[key] for key in sorted(held)])

    for step in range(1, 15):
        keys = np.array([(step, k, 0) for k in range(180)], np.int32)
        used = len(held)
        if used + len(keys) > pool.where.most:
            with pytest.raises(ValueError, match="there is room for 2000"):
                pool.add(keys, step)
            check()
            continue
        pool.add(keys, step)
        assert all(not sums[used : used + len(keys)].any() for sums in pool.sums)
        for sums in pool.sums:
            sums[used : used + len(keys)] = step
        held.update(dict.fromkeys(map(tuple, keys.tolist()), step))
        check()
        gone = generator.permutation(len(held))[: 40 * (step % 3)].astype(np.int32)
        for key in pool.keys[gone].tolist():
            del held[tuple(key)]
        pool.remove(gone)
        check()
        assert np.array_equal(pool.births, pool.keys[:, 0])
    assert pool.room <= pool.where.most
    pool.remove(np.arange(len(pool.keys), dtype=np.int32))
    assert len(pool.keys) == 0


def test_surfaces_lie_where_they_are_with_their_normals() -> None:
    mesh = fused(range(5)).extract_all()
    distance, angle = surface_errors(mesh)
    assert len(mesh.positions) > 5000
    # The depth at a silhouette is that of one pixel: only there it is off.
    assert np.median(distance) < 0.02 * VOXEL
    assert np.percentile(distance, 97) < 0.2 * VOXEL
    assert np.median(angle) < 0.5
    assert np.percentile(angle, 90) < 5.0


def test_the_mesh_is_a_manifold_that_turns_outwards_with_short_triangles() -> None:
    volume = fused(range(4))
    mesh = volume.extract_all()
    assert edge_uses(mesh.triangles).max() == 2
    corners = mesh.positions[mesh.triangles].astype(np.float64)
    sides = corners - np.roll(corners, 1, axis=1)
    assert np.linalg.norm(sides, axis=2).max() < volume.scale.truncation
    turned = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    assert np.linalg.norm(turned, axis=1).min() > 0.0
    agreement = np.sum(turned * mesh.normals[mesh.triangles[:, 0]], axis=1)
    assert np.mean(agreement > 0.0) > 0.99


def test_what_is_taken_back_leaves_no_trace() -> None:
    volume = fused(range(3))
    before, blocks = volume.extract_all(), len(volume.keys)
    view = make_view(12)
    one = volume.integrate(*view.arguments())
    between = make_view(14)
    two = volume.integrate(*between.arguments())
    assert len(volume.keys) > blocks
    volume.remove(one.serial, *view.arguments())
    volume.remove(two.serial, *between.arguments())
    assert len(volume.keys) == blocks
    assert_same(volume.extract_all(), before)


def test_everything_taken_back_leaves_nothing() -> None:
    volume = TsdfVolume(VOXEL, PARAMETERS)
    serials = [volume.integrate(*make_view(step).arguments()).serial for step in range(4)]
    for step in (2, 0, 3, 1):
        volume.remove(serials[step], *make_view(step).arguments())
    assert len(volume.keys) == 0
    assert len(volume.extract_all().triangles) == 0


def test_messages_rebuild_the_mesh_that_is_held() -> None:
    volume, service, viewer = TsdfVolume(VOXEL, PARAMETERS), BlockMesh(), BlockMesh()
    late = BlockMesh()
    sent: list[int] = []
    views = [make_view(step) for step in range(6)]
    serials: list[int] = []
    for step, view in enumerate(views):
        done = volume.integrate(*view.arguments())
        serials.append(done.serial)
        keys = done.keys
        if step == 4:  # a keyframe that has moved
            keys = np.concatenate([keys, volume.remove(serials[1], *views[1].arguments())])
        message = service.changes(volume.extract(volume.affected(keys)))
        service.apply(message)
        viewer.apply(message)
        sent.append(len(message.triangles))
        if step == 3:
            late.apply(service.snapshot())
        elif step > 3:
            late.apply(message)
        for held in (service, viewer, late) if step >= 3 else (service, viewer):
            assert_same(held.mesh(), volume.extract_all())
    assert min(sent) > 0


def test_neither_the_place_nor_the_order_of_blocks_changes_the_mesh() -> None:
    volume = fused(range(4))
    again = TsdfVolume(VOXEL, PARAMETERS.model_copy(update={"free_space": False}))
    other = TsdfVolume(VOXEL, PARAMETERS.model_copy(update={"free_space": False}))
    for step in range(4):
        again.integrate(*make_view(step).arguments())
    # Blocks are made in another order, and slots are used that were given back.
    away = make_view(25)
    gone = other.integrate(*away.arguments())
    for step in (0, 1, 2, 3):
        other.integrate(*make_view(step).arguments())
    other.remove(gone.serial, *away.arguments())
    assert_same(again.extract_all(), other.extract_all())
    assert_same(volume.extract_all(), fused(range(4)).extract_all())


def test_free_space_is_cleared() -> None:
    def ghosts(parameters: TsdfParameters) -> int:
        volume = TsdfVolume(VOXEL, parameters)
        volume.integrate(*make_view(0, ball=True).arguments())
        for step in range(1, 5):
            volume.integrate(*make_view(step, ball=False).arguments())
        distance = np.linalg.norm(volume.extract_all().positions - BALL, axis=1) - RADIUS
        return int(np.sum(np.abs(distance) < VOXEL))

    assert ghosts(PARAMETERS) == 0
    assert ghosts(PARAMETERS.model_copy(update={"free_space": False})) > 50


def test_a_voxel_that_needs_too_much_memory_is_refused_with_one_that_fits() -> None:
    view = make_view(0)
    small = PARAMETERS.model_copy(update={"max_memory_mb": 1, "fine_voxel": VOXEL})
    volume = TsdfVolume(VOXEL, small)
    with pytest.raises(VolumeFullError) as caught:
        volume.integrate(*view.arguments())
    assert len(volume.keys) == 0
    assert volume.memory_bytes <= 1e6
    said = too_fine("fine", small, caught.value.needed_bytes, "this view")
    needed = caught.value.needed_bytes / 1e6
    assert said.startswith(f"meshing.tsdf.fine_voxel=0.05 needs {needed:.0f} MB for this view, ")
    assert "the limit is 1 MB (meshing.tsdf.max_memory_mb): about " in said
    fits = float(said.split("about ")[1].split()[0])
    assert fits > VOXEL
    coarser = TsdfVolume(fits, small)
    coarser.integrate(*view.arguments())
    assert coarser.memory_bytes <= 1e6


def test_memory_of_a_view_is_computed_before() -> None:
    depth = np.ones((CAMERA.height, CAMERA.width), np.float32)
    for voxel in (1 / 40, 1 / 120, 1 / 400):
        scale = TsdfVolume(voxel, PARAMETERS).scale
        # Wherever the wall stands in the grid, on average.
        counts = [
            len(blocks_in_band(pixel_planes(at, np.ones_like(at), CAMERA), np.eye(4), scale))
            for at in (depth + np.float32(0.21 * k * voxel) for k in range(8))
        ]
        known = view_bytes(voxel, CAMERA, PARAMETERS) / BLOCK_BYTES
        assert 0.6 < known / np.mean(counts) < 1.1


def test_a_voxel_that_one_view_cannot_have_is_refused_before_the_work() -> None:
    small = TsdfParameters(max_memory_mb=20)
    check_voxel_sizes(CAMERA, small)
    with pytest.raises(VoxelSizeError, match=r"fine_voxel=0\.001 needs .* MB ") as refused:
        check_voxel_sizes(CAMERA, small.model_copy(update={"fine_voxel": 0.001}))
    fitting = float(str(refused.value).split("): ")[1].split()[0])
    taken = SCENE_VIEWS * view_bytes(fitting, CAMERA, small)
    assert 0.8 * 20e6 < taken <= 20e6
    with pytest.raises(VoxelSizeError, match=r"coarse_voxel=0\.0001 "):
        check_voxel_sizes(CAMERA, small.model_copy(update={"coarse_voxel": 0.0001}))


def test_memory_grows_with_the_surface_and_not_with_the_time() -> None:
    volume = TsdfVolume(VOXEL, PARAMETERS)
    volume.integrate(*make_view(0).arguments())
    blocks, memory = len(volume.keys), volume.memory_bytes
    for _ in range(10):
        volume.integrate(*make_view(0).arguments())
    assert (len(volume.keys), volume.memory_bytes) == (blocks, memory)
    volume.integrate(*make_view(20).arguments())
    assert len(volume.keys) > blocks


def test_depth_that_is_no_depth_is_no_surface() -> None:
    view = make_view(0)
    volume = TsdfVolume(VOXEL, PARAMETERS)
    for value in (0.0, -1.0, np.nan, np.inf):
        done = volume.integrate(np.full_like(view.depth, value), *view.arguments()[1:])
        assert len(done.keys) == 0
    nothing: TriangleMesh = volume.extract_all()
    assert len(nothing.positions) == len(nothing.triangles) == len(volume.keys) == 0


def test_sizes_that_differ_are_refused() -> None:
    view = make_view(0)
    volume = TsdfVolume(VOXEL, PARAMETERS)
    with pytest.raises(ValueError, match="colour"):
        volume.integrate(
            view.depth, view.weight, view.colour[:-1], view.camera, view.T_world_camera
        )
    with pytest.raises(ValueError, match="depth"):
        volume.integrate(
            view.depth[:-1], view.weight, view.colour, view.camera, view.T_world_camera
        )
