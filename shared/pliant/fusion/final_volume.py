"""A volume for a final mesh, which says what it would have taken where there is no room for it."""

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.mesh_blocks import BLOCK_BYTES, sorted_keys
from pliant.algorithms.meshing.parameters import TsdfParameters
from pliant.algorithms.meshing.rendering import DepthMap
from pliant.algorithms.meshing.tsdf_integrate import blocks_in_band, pixel_planes
from pliant.algorithms.meshing.tsdf_volume import TsdfVolume, VolumeFullError


class FinalVolume:
    """Once it is full it is empty, and counts what it would take."""

    def __init__(self, voxel_size: float, camera: PinholeCamera, tsdf: TsdfParameters) -> None:
        self.volume = TsdfVolume(voxel_size, tsdf)
        self.is_full = False
        self._camera = camera
        self._tsdf = tsdf
        self._needed = np.zeros((0, 3), np.int32)

    @property
    def needed_bytes(self) -> int:
        """What all that was put in takes, where it is full."""
        return len(self._needed) * BLOCK_BYTES

    def put(self, depth_map: DepthMap, colour: U8, T_world_camera: F64) -> None:
        """Fuse a keyframe, or count its blocks."""
        depths, weights = depth_map.depths, depth_map.weights
        if not self.is_full:
            try:
                self.volume.integrate(depths, weights, colour, self._camera, T_world_camera)
                return
            except VolumeFullError:
                self.is_full, self._needed = True, self.volume.keys
                self.volume = TsdfVolume(self.volume.scale.voxel, self._tsdf)
        pixels = pixel_planes(depths, weights, self._camera)
        band = blocks_in_band(pixels, T_world_camera, self.volume.scale)
        self._needed = sorted_keys(np.concatenate([self._needed, band]))
