"""The coarse mesh of one map segment while it grows, and what of it has changed."""

import bisect
import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, I32, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.meshing.mesh_blocks import LAST_KEY, BlockMesh, MeshBlocks, no_blocks
from pliant.algorithms.meshing.parameters import TsdfParameters
from pliant.algorithms.meshing.rendering import DepthMap
from pliant.algorithms.meshing.tsdf_volume import TsdfVolume
from pliant.algorithms.stages import StageTimer

_SPARSE = 8
"""Every so many pixels give a keyframe's median depth."""


@dataclass(frozen=True)
class _Preview:
    """What was put in for a keyframe that may still move, so that it can be taken out again."""

    serial: int
    depth_map: DepthMap
    colour: U8
    T_world_camera: F64
    median_depth: float


class LiveMesh:
    """One segment.  Keyframes in the window are put in as a preview, and for good as they leave it.

    voxel_size: in units of the segment's world.
    """

    def __init__(
        self, voxel_size: float, camera: PinholeCamera, parameters: TsdfParameters, again: int
    ) -> None:
        self.volume = TsdfVolume(voxel_size, parameters)
        self.held = BlockMesh()
        self._camera = camera
        self._again = again
        self._previews: dict[int, _Preview] = {}
        self._touched: list[I32] = []
        self._next_again = 0

    def put(
        self, keyframe: int, depth_map: DepthMap, colour: U8, T_world_camera: F64, *, settled: bool
    ) -> None:
        """Put a keyframe in, in place of its preview where there is one.

        Raises VolumeFullError where there is no room; the keyframe is not in the volume then.
        """
        self.take_out(keyframe)
        put = self.volume.integrate(
            depth_map.depths, depth_map.weights, colour, self._camera, T_world_camera
        )
        self._touched.append(put.keys)
        if not settled:
            some = depth_map.depths[::_SPARSE, ::_SPARSE]
            depth = float(np.median(some[some > 0.0])) if some.any() else 0.0
            self._previews[keyframe] = _Preview(
                put.serial, depth_map, colour, T_world_camera, depth
            )

    def take_out(self, keyframe: int) -> None:
        """Take the preview of a keyframe out, exactly; nothing where there is none."""
        old = self._previews.pop(keyframe, None)
        if old is not None:
            self._touched.append(
                self.volume.remove(
                    old.serial, old.depth_map.depths, old.depth_map.weights, old.colour,
                    self._camera, old.T_world_camera,
                )
            )  # fmt: skip

    def moved(self, pose_of: Callable[[int], F64]) -> list[int]:
        """Keyframes whose preview lies a voxel or more off where their poses now put it."""
        found: list[int] = []
        for keyframe, preview in self._previews.items():
            T_old_new = inverse(preview.T_world_camera) @ pose_of(keyframe)
            # A turn by an angle moves what lies at that depth by the chord.
            chord = math.sqrt(max(0.0, 3.0 - float(np.trace(T_old_new[:3, :3]))))
            off = float(np.linalg.norm(T_old_new[:3, 3])) + preview.median_depth * chord
            if off >= self.volume.scale.voxel:
                found.append(keyframe)
        return found

    def changes(self, timer: StageTimer) -> MeshBlocks | None:
        """The blocks that differ from what was told; None where nothing was put in."""
        if not self._touched:
            return None
        with timer("coarse meshing"):
            touched = np.unique(np.concatenate(self._touched), axis=0)
            self._touched = []
            new = self.held.changes(self.volume.extract(self.volume.affected(touched)))
            self.held.apply(new)
            return new

    def again(self) -> tuple[MeshBlocks, tuple[int, int]]:
        """The next blocks in turn, as they were told, and the span of packed keys they fill.

        Whoever came late, or missed a change, has all of them after one turn; and what he holds
        within the span beside them is no more.  (0, -1): no span, as nothing is told again.
        """
        if self._again == 0:
            return no_blocks(), (0, -1)
        keys = self.held.packed_keys()
        first = self._next_again
        start = bisect.bisect_left(keys, first)
        chosen = keys[start : start + self._again]
        is_last = start + self._again >= len(keys)
        last = LAST_KEY if is_last else chosen[-1]
        self._next_again = 0 if is_last else last + 1
        return self.held.blocks(chosen), (first, last)
