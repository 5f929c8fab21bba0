"""A TSDF volume on Open3D's VoxelBlockGrid (CPU), filled and meshed by our own kernels.

Open3D gives the hash map of blocks and the memory of their voxels; its own ``integrate`` has
neither weights for pixels nor removal, and it meshes the whole grid only.  Rows of blocks are in
the order in which they were made, which follows from the input; where Open3D puts them follows
from hashing, and nothing depends on it.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.meshing.mesh_blocks import MeshBlocks, TriangleMesh, weld
from pliant.algorithms.meshing.tsdf_blocks import (
    SIDE,
    blocks_in_band,
    find_rows,
    make_table,
    sorted_keys,
    with_neighbours,
)
from pliant.algorithms.meshing.tsdf_extract import TsdfArrays, extract_blocks
from pliant.algorithms.meshing.tsdf_integrate import add_sight, blocks_in_view
from pliant.algorithms.meshing.tsdf_parameters import TsdfParameters
from pliant.algorithms.meshing.tsdf_pixels import (
    WEIGHT_UNITS,
    PixelPlanes,
    intrinsics_of,
    pixel_planes,
)
from pliant.fusion.memory import BLOCK_BYTES
from pliant.fusion.open3d_import import FusionError, require_open3d

_FIRST_BLOCKS = 512
_GROWTH = 0.6
"""Of surface, blocks grow with one over the voxel squared; at its borders more slowly."""


class VolumeMemoryError(FusionError):
    """The blocks needed exceed the memory limit.  Nothing has been changed."""

    def __init__(self, voxel_size: float, needed_bytes: int, limit_bytes: int) -> None:
        self.voxel_size_that_fits = voxel_size * (needed_bytes / limit_bytes) ** _GROWTH
        factor = self.voxel_size_that_fits / voxel_size
        super().__init__(
            f"voxels of {voxel_size:.4g} (scene units) need {needed_bytes / 1e6:.0f} MB, the limit "
            f"is {limit_bytes / 1e6:.0f} MB: voxels of {self.voxel_size_that_fits:.4g}, "
            f"{factor:.2f} times as large, would fit"
        )


@dataclass(frozen=True)
class Integration:
    """serial: names the sight when it is taken back.    keys: blocks that it changed, ascending."""

    serial: int
    keys: I32


class TsdfVolume:
    """Depth maps in, blocks of mesh out.

    Raises FusionError where open3d cannot be imported.
    """

    def __init__(self, voxel_size: float, parameters: TsdfParameters) -> None:
        """voxel_size: in scene units."""
        if not (math.isfinite(voxel_size) and voxel_size > 0.0):
            raise ValueError(f"voxel_size: expected a positive size, got {voxel_size}")
        self.voxel_size = voxel_size
        self.truncation = parameters.truncation_voxels * voxel_size
        self._parameters = parameters
        self._core: Any = require_open3d().core
        self._limit_blocks = max(1, parameters.max_memory_mb * 10**6 // BLOCK_BYTES)
        self._grid: Any = self._make_grid(min(_FIRST_BLOCKS, self._limit_blocks))
        self._map: Any = self._grid.hashmap()
        self._keys, self._slots = np.zeros((0, 3), np.int32), np.zeros(0, np.int32)
        self._births = np.zeros(0, np.int64)
        self._table = make_table(self._keys)
        self._serial = 0

    @property
    def block_count(self) -> int:
        """Blocks with a voxel that was seen."""
        return len(self._keys)

    @property
    def memory_bytes(self) -> int:
        """What the voxels take, with the room kept for more."""
        return int(self._map.capacity()) * BLOCK_BYTES

    def blocks_needed(self, depth: F32, camera: PinholeCamera, T_world_camera: F64) -> I32:
        """(K, 3) keys of the blocks that a depth map would make or use; nothing is changed."""
        pixels = pixel_planes(depth, np.ones_like(depth), camera)
        return self._band(pixels, camera, T_world_camera)

    def check_memory(self, needed: I32) -> None:
        """Raise VolumeMemoryError where (K, 3) distinct blocks are more than the limit holds."""
        if len(needed) > self._limit_blocks:
            raise VolumeMemoryError(
                self.voxel_size, len(needed) * BLOCK_BYTES, self._limit_blocks * BLOCK_BYTES
            )

    def integrate(
        self, depth: F32, weight: F32, colour: U8, camera: PinholeCamera, T_world_camera: F64
    ) -> Integration:
        """Fuse a depth map.

        depth: (H, W) along z, 0 or not finite where there is none.    weight: (H, W) in [0, 1].
        colour: (H, W, 3) RGB.    T_world_camera: (4, 4).

        Raises VolumeMemoryError, before anything has changed; ValueError on sizes that differ.
        """
        pixels = _checked(depth, weight, colour, camera)
        band = self._band(pixels, camera, T_world_camera)
        new = band[find_rows(self._table, band) < 0]
        total = len(self._keys) + len(new)
        if total > self._limit_blocks:
            raise VolumeMemoryError(
                self.voxel_size, total * BLOCK_BYTES, self._limit_blocks * BLOCK_BYTES
            )
        self._serial += 1
        self._allocate(new)
        changed = self._add(1, self._serial, pixels, colour, camera, T_world_camera)
        self._release(new)
        return Integration(self._serial, changed)

    def remove(
        self, serial: int, depth: F32, weight: F32, colour: U8, camera: PinholeCamera,
        T_world_camera: F64,
    ) -> I32:  # fmt: skip
        """Take back what ``integrate`` did with the same arguments; (K, 3) changed blocks.

        What it left is exactly what it found; blocks that nothing else has seen are given back.
        """
        pixels = _checked(depth, weight, colour, camera)
        changed = self._add(-1, serial, pixels, colour, camera, T_world_camera)
        self._release(changed)
        return changed

    def affected(self, keys: I32) -> I32:
        """The (K, 3) changed blocks and those whose cubes or normals read them, ascending."""
        return with_neighbours(keys)

    def extract(self, keys: I32) -> MeshBlocks:
        """The surface of these blocks, ascending; those that are empty or gone have none."""
        return extract_blocks(sorted_keys(keys), self._arrays())

    def extract_all(self) -> TriangleMesh:
        """The whole surface, welded across blocks."""
        return weld(self.extract(self._keys))

    def _band(self, pixels: PixelPlanes, camera: PinholeCamera, T_world_camera: F64) -> I32:
        return blocks_in_band(
            pixels.planes, pixels.depths, intrinsics_of(camera), T_world_camera,
            self.voxel_size, self.truncation,
        )  # fmt: skip

    def _add(
        self, sign: int, serial: int, pixels: PixelPlanes, colour: U8, camera: PinholeCamera,
        T_world_camera: F64,
    ) -> I32:  # fmt: skip
        """Sum a sight into every block in view that was there when it was first fused."""
        T_camera_world = inverse(T_world_camera)
        seen = blocks_in_view(
            self._keys, T_camera_world, intrinsics_of(camera), pixels.furthest, camera.width,
            camera.height, self.voxel_size, self.truncation,
        )  # fmt: skip
        rows = np.flatnonzero(seen & (self._births <= serial))
        keys = self._keys[rows]
        distances, weights, colours = self._sums()
        changed = add_sight(
            keys, self._slots[rows], T_camera_world, intrinsics_of(camera), pixels.planes,
            pixels.weights, np.ascontiguousarray(colour), self.voxel_size, self.truncation,
            self._parameters.free_space, sign, distances, weights, colours,
        )  # fmt: skip
        return sorted_keys(keys[changed])

    def _allocate(self, new: I32) -> None:
        if len(new) == 0:
            return
        total = len(self._keys) + len(new)
        if total > self._map.capacity():
            self._map.reserve(min(2 * total, self._limit_blocks))
            self._slots = self._find_slots(self._keys)
        made, _ = self._map.activate(self._core.Tensor.from_numpy(np.ascontiguousarray(new)))
        slots = np.array(made.numpy(), np.int32)
        # A slot that was given back still has what it had.
        for sums in self._sums():
            sums[slots] = 0
        self._keys = np.concatenate([self._keys, new])
        self._slots = np.concatenate([self._slots, slots])
        self._births = np.concatenate([self._births, np.full(len(new), self._serial, np.int64)])
        self._table = make_table(self._keys)

    def _release(self, keys: I32) -> None:
        """Give back those of the blocks in which there is no weight."""
        rows = find_rows(self._table, keys)
        weights = self._sums()[1]
        rows = rows[~weights[self._slots[rows]].any(axis=(1, 2, 3))]
        if len(rows) == 0:
            return
        self._map.erase(self._core.Tensor.from_numpy(np.ascontiguousarray(self._keys[rows])))
        kept = np.ones(len(self._keys), np.bool_)
        kept[rows] = False
        self._keys, self._slots = self._keys[kept], self._slots[kept]
        self._births = self._births[kept]
        self._table = make_table(self._keys)

    def _find_slots(self, keys: I32) -> I32:
        if len(keys) == 0:
            return np.zeros(0, np.int32)
        found, _ = self._map.find(self._core.Tensor.from_numpy(np.ascontiguousarray(keys)))
        return np.array(found.numpy(), np.int32)

    def _sums(self) -> tuple[I32, I32, I32]:
        """Views of the block tensors; the memory moves when the map grows."""
        distances, weights, colours = (
            self._grid.attribute(name).numpy() for name in ("tsdf", "weight", "color")
        )
        return distances[..., 0], weights[..., 0], colours

    def _arrays(self) -> TsdfArrays:
        distances, weights, colours = self._sums()
        return TsdfArrays(
            table=self._table,
            slots=self._slots,
            distance_sums=distances,
            weight_sums=weights,
            colour_sums=colours,
            voxel=self.voxel_size,
            truncation=self.truncation,
            min_weight=max(1, round(self._parameters.min_weight * WEIGHT_UNITS)),
        )

    def _make_grid(self, blocks: int) -> Any:
        whole = self._core.int32
        return require_open3d().t.geometry.VoxelBlockGrid(
            attr_names=("tsdf", "weight", "color"),
            attr_dtypes=(whole, whole, whole),
            attr_channels=((1), (1), (4)),
            voxel_size=self.voxel_size,
            block_resolution=SIDE,
            block_count=blocks,
            device=self._core.Device("CPU:0"),
        )


def _checked(depth: F32, weight: F32, colour: U8, camera: PinholeCamera) -> PixelPlanes:
    if colour.shape != (camera.height, camera.width, 3):
        raise ValueError(f"colour: expected {(camera.height, camera.width, 3)}, got {colour.shape}")
    return pixel_planes(depth, weight, camera)
