"""The coarse mesh of one map segment while it grows, and its changes."""

import bisect
from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, I32, I64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.meshing.keyframe_surface import SeenPoints
from pliant.algorithms.meshing.mesh_blocks import LAST_KEY, BlockMesh, MeshBlocks, no_blocks
from pliant.algorithms.meshing.parameters import TsdfParameters
from pliant.algorithms.meshing.rendering import DepthMap
from pliant.algorithms.meshing.tsdf_volume import TsdfVolume
from pliant.algorithms.stages import StageTimer
from pliant.map_history import CurrentMap

_SAMPLES = 32
"""Points of a keyframe that tell whether it has moved."""


@dataclass(frozen=True)
class Sight:
    """A keyframe's part of the volume.  colour: (H, W, 3) RGB.    T_world_camera: (4, 4)."""

    depth_map: DepthMap
    colour: U8
    T_world_camera: F64


@dataclass(frozen=True)
class Fused:
    """How a keyframe was put in: with the depth map and the image it can be taken out again.

    correction: what its view left of the calibration's.    point_ids, points_world: (S,), (S, 3)
    some of the points that it saw, where they were.
    """

    serial: int
    T_world_camera: F64
    correction: tuple[float, ...]
    point_ids: I64
    points_world: F64


class LiveMesh:
    """One segment.  Of each keyframe some points are held, and neither depths nor image.

    voxel_size: in units of the segment's world.    fused: keyframes in the volume, by their ids.
    """

    def __init__(
        self, voxel_size: float, camera: PinholeCamera, parameters: TsdfParameters, again: int
    ) -> None:
        self.volume = TsdfVolume(voxel_size, parameters)
        self.held = BlockMesh()
        self.fused: dict[int, Fused] = {}
        self._camera = camera
        self._again = again
        self._touched: list[I32] = []
        self._next_again = 0

    def put(
        self, keyframe: int, sight: Sight, correction: tuple[float, ...], seen: SeenPoints
    ) -> None:
        """Put a keyframe in that is not in the volume.

        Raises VolumeFullError where there is no room; it is not in the volume then.
        """
        put = self.volume.integrate(
            sight.depth_map.depths, sight.depth_map.weights, sight.colour, self._camera,
            sight.T_world_camera,
        )  # fmt: skip
        self._touched.append(put.keys)
        some = slice(None, None, -(-len(seen.ids) // _SAMPLES))
        self.fused[keyframe] = Fused(
            put.serial, sight.T_world_camera, correction,
            seen.ids[some].copy(), seen.points_world[some].copy(),
        )  # fmt: skip

    def take_out(self, keyframe: int, depth_map: DepthMap, colour: U8) -> None:
        """Take a keyframe out, exactly: what it was put in with is given again."""
        old = self.fused.pop(keyframe)
        removed = self.volume.remove(
            old.serial, depth_map.depths, depth_map.weights, colour, self._camera,
            old.T_world_camera,
        )  # fmt: skip
        self._touched.append(removed)

    def moved(self, current: CurrentMap) -> list[int]:
        """Keyframes whose points lie a voxel or more (in the median) off from where they were put
        in, the farthest first.

        A mesh cannot show less than a voxel, and what was put in by less than a truncation aside
        of it is one surface with it.
        """
        off = {keyframe: self._off(fused, current) for keyframe, fused in self.fused.items()}
        moved = [keyframe for keyframe in sorted(off) if off[keyframe] >= self.volume.scale.voxel]
        return sorted(moved, key=lambda keyframe: -off[keyframe])

    def _off(self, fused: Fused, current: CurrentMap) -> float:
        rows, points = current.points_of(fused.point_ids)
        if not len(rows):
            return 0.0
        moved = np.linalg.norm(points.positions - fused.points_world[rows], axis=1)
        return float(np.median(moved))

    def changes(self, timer: StageTimer) -> MeshBlocks | None:
        """The blocks that differ from the published ones; None without keyframes."""
        if not self._touched:
            return None
        with timer("coarse meshing"):
            touched = np.unique(np.concatenate(self._touched), axis=0)
            self._touched = []
            new = self.held.changes(self.volume.extract(self.volume.affected(touched)))
            self.held.apply(new)
            return new

    def again(self) -> tuple[MeshBlocks, tuple[int, int]]:
        """The next blocks in turn, as published, and the span of packed keys that they fill.

        A reader that came late, or missed a change, has all of them after one turn, and removes
        others within the span.  (0, -1): no span, because nothing is repeated.
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
