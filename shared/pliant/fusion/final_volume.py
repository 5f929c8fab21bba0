"""A volume for a final mesh, which reports the memory that it would need if it is too large."""

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import BLOCK_BYTES, TriangleMesh, sorted_keys
from pliant.algorithms.meshing.parameters import TsdfParameters
from pliant.algorithms.meshing.rendering import DepthMap
from pliant.algorithms.meshing.tsdf_integrate import blocks_in_band, pixel_planes
from pliant.algorithms.meshing.tsdf_volume import TsdfVolume, VolumeFullError
from pliant.fusion.voxel_file import VoxelFile


class FinalVolume:
    """In memory up to its limit, then on disk.  Once that is full it is empty, and counts what it
    would take.  A context manager."""

    def __init__(self, voxel_size: float, camera: PinholeCamera, tsdf: TsdfParameters) -> None:
        self._file = VoxelFile(tsdf.max_memory_mb * 10**6)
        self.volume = TsdfVolume(voxel_size, tsdf, self._file)
        self.is_full = False
        self._camera = camera
        self._tsdf = tsdf
        self._needed = np.zeros((0, 3), np.int32)

    def __enter__(self) -> "FinalVolume":
        return self

    def __exit__(self, *_: object) -> None:
        self._empty()

    def mesh(self, *, finish: bool = False) -> TriangleMesh:
        """The whole surface; the volume is empty then.    finish: as of ``extract_finished``."""
        mesh = self.volume.extract_finished() if finish else self.volume.extract_all()
        self._empty()
        return mesh

    def _empty(self) -> None:
        self.volume = TsdfVolume(self.volume.scale.voxel, self._tsdf)
        self._file.__exit__()

    @property
    def memory_bytes(self) -> int:
        """Memory of the voxels, without those on disk."""
        return self.volume.memory_bytes if self.file_bytes == 0 else 0

    @property
    def file_bytes(self) -> int:
        """Size of the voxels on disk."""
        return self._file.size_bytes

    @property
    def most_bytes(self) -> int:
        """Maximum size on disk."""
        return self._file.most * BLOCK_BYTES

    @property
    def needed_bytes(self) -> int:
        """Size that the volume would need, if it is full."""
        return len(self._needed) * BLOCK_BYTES

    def put(self, depth_map: DepthMap, colour: U8, T_world_camera: F64) -> None:
        """Fuse a keyframe, or count its blocks."""
        depths, weights = depth_map.depths, depth_map.weights
        if not self.is_full:
            try:
                self.volume.integrate(depths, weights, colour, self._camera, T_world_camera)
                return
            except (VolumeFullError, OSError):  # meanwhile others may have filled the disk
                self.is_full, self._needed = True, self.volume.keys
                self._empty()
        pixels = pixel_planes(depths, weights, self._camera)
        band = blocks_in_band(pixels, T_world_camera, self.volume.scale)
        self._needed = sorted_keys(np.concatenate([self._needed, band]))
