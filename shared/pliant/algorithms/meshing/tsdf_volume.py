"""A TSDF volume: depth maps in and out again exactly, blocks of mesh out."""

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import partial

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.meshing.marching_cubes import MAX_STEPS, Tsdf, extract_blocks
from pliant.algorithms.meshing.mesh_blocks import (
    BLOCK_BYTES,
    SIDE,
    MeshBlocks,
    TriangleMesh,
    joined_blocks,
    sorted_keys,
    weld,
)
from pliant.algorithms.meshing.mesh_finish import MOST_STEPS, finished
from pliant.algorithms.meshing.parameters import TsdfParameters
from pliant.algorithms.meshing.tsdf_blocks import (
    BlockPool,
    InMemory,
    Scale,
    find_rows,
    with_neighbours,
)
from pliant.algorithms.meshing.tsdf_closing import CARRIED, Evidence, carry_on, evidence_of
from pliant.algorithms.meshing.tsdf_integrate import (
    WEIGHT_UNITS,
    PixelPlanes,
    add_sight,
    blocks_in_band,
    blocks_in_view,
    pixel_planes,
)

_AT_ONCE = 4096
"""Blocks that are meshed while they and their neighbours, some 100 MB, are in memory."""
_VERTICES_AT_ONCE = 2**18
"""Whose evidence is looked up at once: they are in the order of the blocks."""


class VolumeFullError(Exception):
    """A depth map needs more blocks than the memory limit holds.  Nothing has been changed."""

    def __init__(self, needed_bytes: int) -> None:
        super().__init__(f"{needed_bytes} bytes")
        self.needed_bytes = needed_bytes


@dataclass(frozen=True)
class Integration:
    """serial: names the sight when it is taken back.    keys: blocks that it changed, ascending."""

    serial: int
    keys: I32


class TsdfVolume:
    """Depth maps in, blocks of mesh out."""

    def __init__(
        self, voxel_size: float, parameters: TsdfParameters, where: InMemory | None = None
    ) -> None:
        """voxel_size: in scene units.    where: the voxels are; None: in memory up to its limit."""
        if not (math.isfinite(voxel_size) and voxel_size > 0.0):
            raise ValueError(f"voxel_size: expected a positive size, got {voxel_size}")
        self.scale = Scale(voxel_size, parameters.truncation_voxels * voxel_size)
        self._parameters = parameters
        most = max(1, parameters.max_memory_mb * 10**6 // BLOCK_BYTES)
        self._blocks = BlockPool(InMemory(most) if where is None else where)
        self._serial = 0

    @property
    def keys(self) -> I32:
        """(N, 3) blocks with a voxel that was seen, in no order that means anything."""
        return self._blocks.keys

    @property
    def memory_bytes(self) -> int:
        """Memory of the voxels, with the capacity reserved for more."""
        return self._blocks.room * BLOCK_BYTES

    def integrate(
        self, depth: F32, weight: F32, colour: U8, camera: PinholeCamera, T_world_camera: F64
    ) -> Integration:
        """Fuse a depth map.

        depth: (H, W) along z, 0 or not finite where there is none.    weight: (H, W) in [0, 1].
        colour: (H, W, 3) RGB.    T_world_camera: (4, 4).

        Raises VolumeFullError, before anything has changed; ValueError on sizes that differ.
        """
        pixels = _checked(depth, weight, colour, camera)
        band = blocks_in_band(pixels, T_world_camera, self.scale)
        new = band[find_rows(self._blocks.table, band) < 0]
        total = len(self.keys) + len(new)
        if total > self._blocks.where.most:
            raise VolumeFullError(total * BLOCK_BYTES)
        self._serial += 1
        if len(new):
            self._blocks.add(new, self._serial)
        changed = self._add(1, self._serial, pixels, colour, T_world_camera)
        self._release(new)
        self._blocks.where.let_go()
        return Integration(self._serial, changed)

    def remove(
        self, serial: int, depth: F32, weight: F32, colour: U8, camera: PinholeCamera,
        T_world_camera: F64,
    ) -> I32:  # fmt: skip
        """Take back what ``integrate`` did with the same arguments; (K, 3) changed blocks.

        What it left is exactly what it found; blocks that nothing else has seen are given back.
        """
        pixels = _checked(depth, weight, colour, camera)
        changed = self._add(-1, serial, pixels, colour, T_world_camera)
        self._release(changed)
        return changed

    def affected(self, keys: I32) -> I32:
        """The (K, 3) changed blocks and those whose cubes or normals read them, ascending."""
        return with_neighbours(keys)

    def extract(self, keys: I32) -> MeshBlocks:
        """The surface of these blocks, ascending; those that are empty or gone have none."""
        return extract_blocks(sorted_keys(keys), self._tsdf(MAX_STEPS))

    def extract_all(self, max_steps: float = MAX_STEPS) -> TriangleMesh:
        """The whole surface, welded across blocks.    max_steps: as of ``Tsdf``."""
        parts = list[MeshBlocks]()
        for keys in self._parts(sorted_keys(self.keys)):
            parts.append(extract_blocks(keys, self._tsdf(max_steps)))
        return weld(joined_blocks(parts))

    def extract_finished(self) -> TriangleMesh:
        """The whole surface with small holes closed, without crumbs, and with smooth borders.

        Voxels that were not seen are filled: afterwards the volume serves for nothing else.
        """
        tsdf = self._tsdf(MOST_STEPS)
        steps = np.zeros((len(self.keys), SIDE, SIDE, SIDE), np.uint8)
        for step in range(1, CARRIED + 1):
            for keys in self._parts(self.keys):
                carry_on(keys, tsdf, step, steps)
        # No name for the mesh: the first step of finishing is to let go of it.
        evidence = partial(self._evidence, tsdf, steps)
        return finished(self.extract_all(MOST_STEPS), evidence, self.scale.voxel)

    def _evidence(self, tsdf: Tsdf, steps: U8, positions: F32) -> Evidence:
        """As ``evidence_of``, of some vertices after the others."""
        count = len(positions)
        every = Evidence(np.zeros(count, np.float32), np.zeros(count, np.float32))
        for first in range(0, count, _VERTICES_AT_ONCE):
            rows = slice(first, first + _VERTICES_AT_ONCE)
            some = evidence_of(positions[rows], tsdf, steps)
            every.support[rows], every.steps[rows] = some
            self._blocks.where.let_go()
        return every

    def _tsdf(self, max_steps: float) -> Tsdf:
        min_weight = max(1, round(self._parameters.min_weight * WEIGHT_UNITS))
        return Tsdf(self._blocks.table, self._blocks.sums, self.scale, min_weight, max_steps)

    def _parts(self, keys: I32) -> Iterator[I32]:
        """Some of the blocks after the others, so that few of those on disk are in memory."""
        for first in range(0, len(keys), _AT_ONCE):
            yield keys[first : first + _AT_ONCE]
            self._blocks.where.let_go()

    def _add(
        self, sign: int, serial: int, pixels: PixelPlanes, colour: U8, T_world_camera: F64
    ) -> I32:
        """Sum a sight into every block in view that was there when it was first fused."""
        T_camera_world = inverse(T_world_camera)
        blocks = self._blocks
        seen = blocks_in_view(blocks.keys, pixels, T_camera_world, self.scale)
        rows = np.flatnonzero(seen & (blocks.births <= serial))
        keys = blocks.keys[rows]
        changed = add_sight(
            sign, keys, rows, pixels, np.ascontiguousarray(colour), T_camera_world, self.scale,
            self._parameters.free_space, blocks.sums,
        )  # fmt: skip
        return sorted_keys(keys[changed])

    def _release(self, keys: I32) -> None:
        """Give back those of the blocks in which there is no weight."""
        rows = find_rows(self._blocks.table, keys)
        rows = rows[~self._blocks.sums.weights[rows].any(axis=(1, 2, 3))]
        if len(rows):
            self._blocks.remove(rows)


def _checked(depth: F32, weight: F32, colour: U8, camera: PinholeCamera) -> PixelPlanes:
    if colour.shape != (camera.height, camera.width, 3):
        raise ValueError(f"colour: expected {(camera.height, camera.width, 3)}, got {colour.shape}")
    return pixel_planes(depth, weight, camera)
