"""What a viewer draws of the mesh, on a canvas that keeps it."""

from collections.abc import Iterator
from dataclasses import replace
from typing import Any, cast

import numpy as np
import pytest

from pliant.algorithms.arrays import F32
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import (
    LAST_KEY,
    BlockMesh,
    MeshBlocks,
    TriangleMesh,
    no_blocks,
)
from pliant.algorithms.meshing.parameters import TsdfParameters
from pliant.fusion.live_mesh import LiveMesh
from pliant.messages.mesh_pieces import split
from pliant.messages.types import Header, MeshPiece, MeshUpdate
from pliant.viewers.canvas import Canvas, Moment
from pliant.viewers.scene_mesh import SceneMesh

HEADER = Header(frame=0, stamp_ns=0, frame_id="world")
AT = Moment(0, 0)


class Drawn:
    """A canvas that holds what is on it."""

    def __init__(self) -> None:
        self.meshes: dict[tuple[int, str], TriangleMesh] = {}
        self.strokes = 0

    def mesh(self, at: Moment, segment: int, name: str, mesh: TriangleMesh) -> None:
        self.strokes += 1
        self.meshes[segment, name] = mesh
        if not len(mesh.triangles):
            del self.meshes[segment, name]

    def corners(self) -> list[tuple[float, ...]]:
        """Every triangle by its corners and their colours, sorted."""
        return sorted(row for mesh in self.meshes.values() for row in rows(mesh))

    def __getattr__(self, name: str) -> Any:
        raise AssertionError(f"a mesh has no {name}")


def scene_on(canvas: Drawn) -> SceneMesh:
    return SceneMesh(cast(Canvas, canvas))  # it draws meshes alone


def rows(mesh: TriangleMesh) -> Iterator[tuple[float, ...]]:
    parts = (mesh.positions, mesh.normals, mesh.colours.astype(np.float32))
    vertices: F32 = np.concatenate(parts, axis=1)
    yield from map(tuple, vertices[mesh.triangles].reshape(len(mesh.triangles), -1).tolist())


def one_block(x: int, size: int, seed: int) -> MeshBlocks:
    generator = np.random.default_rng(seed)
    return MeshBlocks(
        keys=np.array([[x, -x, x % 3]], np.int32),
        vertex_counts=np.array([3 * size], np.int32),
        triangle_counts=np.array([size], np.int32),
        edges=np.arange(3 * size, dtype=np.int32),
        positions=generator.normal(size=(3 * size, 3)).astype(np.float32),
        normals=generator.normal(size=(3 * size, 3)).astype(np.float32),
        colours=generator.integers(0, 255, (3 * size, 3), np.uint8),
        triangles=np.arange(3 * size, dtype=np.int32).reshape(-1, 3),
    )


def update(blocks: MeshBlocks, segment: int = 0, **span: Any) -> MeshUpdate:
    return MeshUpdate.of(HEADER, blocks, segment=segment, voxel_size=0.1, **{"again": False} | span)


def grown() -> tuple[list[MeshUpdate], BlockMesh]:
    """A mesh that grows, changes, and loses blocks; in the end each block once more."""
    held, told = BlockMesh(), list[MeshUpdate]()
    for step in range(40):
        size = 0 if step % 5 == 4 else 1 + step % 3
        block = one_block(step % 13 - 6, size, step)
        held.apply(block)
        told.append(update(block))
    keys = held.packed_keys()
    middle = len(keys) // 2
    for some, first, last in (
        (keys[:middle], 0, keys[middle - 1]),
        (keys[middle:], keys[middle - 1] + 1, LAST_KEY),
    ):
        told.append(update(held.blocks(some), again=True, first_key=first, last_key=last))
    return told, held


def test_what_is_drawn_is_what_the_service_holds() -> None:
    told, held = grown()
    canvas = Drawn()
    scene = scene_on(canvas)
    for each in told[:-2]:
        scene.take_blocks(AT, each)
    assert canvas.corners() == sorted(rows(held.mesh()))
    assert 1 < len(canvas.meshes) < len(held)  # in groups
    strokes = canvas.strokes
    for each in told[-2:]:
        scene.take_blocks(AT, each)
    assert canvas.strokes == strokes  # what is told again as it was is not drawn again


@pytest.mark.parametrize("missed", [slice(0, 30), slice(12, 40), slice(0, 40), slice(34, 35)])
def test_late_readers_have_all_after_a_turn(missed: slice) -> None:
    told, held = grown()
    canvas = Drawn()
    scene = scene_on(canvas)
    gone = set(range(40)[missed])
    for number, each in enumerate(told):
        if number == 40:
            assert canvas.corners() != sorted(rows(held.mesh()))
        if number not in gone:
            scene.take_blocks(AT, each)
    assert canvas.corners() == sorted(rows(held.mesh()))


def test_a_turn_of_the_service_brings_all_and_takes_away_what_is_gone() -> None:
    camera = PinholeCamera(width=64, height=48, fx=60.0, fy=60.0, cx=31.5, cy=23.5)
    service = LiveMesh(0.1, camera, TsdfParameters(), again=3)
    _, service.held = grown()
    canvas = Drawn()
    scene = scene_on(canvas)
    scene.take_blocks(AT, update(one_block(50, 2, 0)))  # gone since, and the viewer missed it
    turn = -(-len(service.held) // 3)
    for _ in range(turn + 1):  # the last one begins the next turn
        blocks, (first, last) = service.again()
        assert len(blocks.keys) <= 3
        scene.take_blocks(AT, update(blocks, again=True, first_key=first, last_key=last))
    assert canvas.corners() == sorted(rows(service.held.mesh()))


def test_an_old_recording_has_no_note_on_removed_settings() -> None:
    canvas = Drawn()
    scene = scene_on(canvas)
    scene.take_blocks(AT, update(one_block(1, 2, 0)))
    scene.take_blocks(AT, update(no_blocks(), again=True))
    assert len(canvas.corners()) == 2


def pieces(level: str, seed: int, segment: int = 0) -> tuple[list[MeshPiece], TriangleMesh]:
    """A mesh of two pieces."""
    generator = np.random.default_rng(seed)
    V = (1 << 16) + 9
    mesh = TriangleMesh(
        positions=generator.normal(size=(V, 3)).astype(np.float32),
        normals=np.zeros((V, 3), np.float32),
        colours=np.zeros((V, 3), np.uint8),
        triangles=generator.integers(0, V, (50, 3), np.int32),
    )
    made = split(HEADER, mesh, segment=segment, level=level, voxel_size=0.1, keyframes=1)
    return list(made), mesh


@pytest.mark.parametrize(
    ("lost", "shown"), [((), "fine"), ((0,), "coarse"), ((1,), "coarse"), ((0, 3), "live")]
)
def test_the_fine_mesh_takes_the_place_of_the_live_one(lost: tuple[int, ...], shown: str) -> None:
    told, held = grown()
    canvas = Drawn()
    scene = scene_on(canvas)
    for each in told:
        scene.take_blocks(AT, each)
    fine, coarse = pieces("fine", 1), pieces("coarse", 2)
    for number, piece in enumerate([*fine[0], *coarse[0]]):
        if number not in lost:
            scene.take_piece(AT, piece)
    scene.take_blocks(AT, replace(told[0], segment=-1))  # of a world that is over
    meshes = {"live": held.mesh(), "fine": fine[1], "coarse": coarse[1]}
    assert canvas.corners() == sorted(rows(meshes[shown]))
    assert scene.is_final == (shown != "live")


def test_the_mesh_of_a_world_that_is_over_goes() -> None:
    canvas = Drawn()
    scene = scene_on(canvas)
    scene.take_blocks(AT, update(one_block(1, 2, 0)))
    scene.take_blocks(AT, update(one_block(2, 3, 1), segment=1))
    scene.take_blocks(AT, update(one_block(3, 4, 2), segment=0))  # late
    assert {segment for segment, _ in canvas.meshes} == {1}
    assert len(canvas.corners()) == 3


def test_the_mesh_of_a_resumed_world_comes_back() -> None:
    canvas = Drawn()
    scene = scene_on(canvas)
    for segment in (0, 1):
        scene.take_blocks(AT, update(one_block(1, 2, segment), segment=segment))
    scene.begin(AT, 0)
    assert not canvas.meshes
    scene.take_blocks(AT, update(one_block(2, 3, 1), segment=1))  # late
    scene.take_blocks(AT, update(one_block(3, 4, 2), segment=0))
    assert {segment for segment, _ in canvas.meshes} == {0}


def test_some_triangles_bring_their_vertices_along() -> None:
    _, mesh = pieces("fine", 3)
    some = mesh.of_triangles(slice(10, 20))
    assert list(rows(some)) == list(rows(mesh))[10:20]
    assert len(some.positions) <= 30
