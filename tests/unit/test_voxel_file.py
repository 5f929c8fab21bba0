"""Volumes of which only a part is in memory."""

import mmap
import resource
from pathlib import Path

import numpy as np
import pytest
from fusion_scene import CAMERA, make_view

from pliant.algorithms.meshing.mesh_blocks import BLOCK_BYTES, TriangleMesh
from pliant.algorithms.meshing.parameters import TsdfParameters
from pliant.algorithms.meshing.rendering import DepthMap
from pliant.fusion import voxel_file
from pliant.fusion.final_volume import FinalVolume
from pliant.fusion.voxel_file import VoxelFile

VOXEL = 0.02


def put_all(volume: FinalVolume) -> FinalVolume:
    for step in range(0, 12, 3):
        view = make_view(step)
        volume.put(DepthMap(view.depth, view.weight), view.colour, view.T_world_camera)
    return volume


def bytes_of(mesh: TriangleMesh) -> tuple[bytes, ...]:
    return tuple(a.tobytes() for a in (mesh.positions, mesh.normals, mesh.colours, mesh.triangles))


@pytest.fixture
def in_memory() -> TriangleMesh:
    with put_all(FinalVolume(VOXEL, CAMERA, TsdfParameters())) as volume:
        assert volume.file_bytes == 0
        assert volume.memory_bytes > 1e7
        return volume.mesh()


def test_a_volume_on_disk_gives_the_same_bytes(in_memory: TriangleMesh) -> None:
    small = TsdfParameters(max_memory_mb=8)
    with put_all(FinalVolume(VOXEL, CAMERA, small)) as volume:
        assert volume.file_bytes > 1.5 * 8e6
        assert volume.memory_bytes == 0
        assert not volume.is_full
        assert bytes_of(volume.mesh()) == bytes_of(in_memory)


def resident_bytes() -> int:
    return int(Path("/proc/self/statm").read_text().split()[1]) * resource.getpagesize()


def test_what_is_in_the_file_need_not_be_in_memory() -> None:
    rows = 20000
    arrays = [np.zeros((1, 8, 8, 8, *last), np.int32) for last in ((), (), (4,))]
    before = resident_bytes()
    with VoxelFile(10**6) as room:
        room.grow(arrays, 1, rows)
        for first in range(0, rows, 1000):
            for array in arrays:
                array[first : first + 1000] = first
            room.let_go()
        assert resident_bytes() - before < 0.2 * rows * BLOCK_BYTES
        for array in arrays:
            assert (array[5000:6000] == 5000).all()


def test_what_was_in_memory_is_not_there_twice(monkeypatch: pytest.MonkeyPatch) -> None:
    most = 0

    class Watched(mmap.mmap):
        def madvise(self, option: int, start: int = 0, length: int = 0) -> None:
            nonlocal most
            most = max(most, resident_bytes())
            super().madvise(option, start, length or len(self))

    monkeypatch.setattr(mmap, "mmap", Watched)
    rows = 30000
    arrays = [np.full((rows, 8, 8, 8, *last), 3, np.int32) for last in ((), (), (4,))]
    before = resident_bytes()
    with VoxelFile(1) as room:
        room.grow(arrays, rows, rows + 1)
        assert 0 < most - before < 0.25 * rows * BLOCK_BYTES
        assert all((array[:rows:999] == 3).all() for array in arrays)


def test_rows_stay_as_the_file_grows() -> None:
    arrays = [np.full((4, 8, 8, 8, *last), 7, np.int32) for last in ((), (), (4,))]
    with VoxelFile(1) as room:
        for least in (5, 50, 500):
            used = len(arrays[0]) if least > 5 else 4
            room.grow(arrays, used, used + least)
            assert all(len(array) >= used + least for array in arrays)
            assert all((array[:4] == 7).all() for array in arrays)
        assert room.size_bytes == sum(array.nbytes for array in arrays)


def test_a_disk_without_room_is_said_with_what_all_needs(
    in_memory: TriangleMesh, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(voxel_file, "_SHARE_OF_FREE", 0.0)
    with put_all(FinalVolume(VOXEL, CAMERA, TsdfParameters(max_memory_mb=8))) as volume:
        assert volume.is_full
        assert volume.needed_bytes > volume.most_bytes
        assert 7.9e6 < volume.most_bytes <= 8e6
    assert len(in_memory.triangles) > 0


def test_a_disk_that_others_fill_meanwhile_is_a_full_one(monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(voxel_file.os, "posix_fallocate", full)
    with put_all(FinalVolume(VOXEL, CAMERA, TsdfParameters(max_memory_mb=8))) as volume:
        assert volume.is_full
        assert volume.needed_bytes > 8e6
