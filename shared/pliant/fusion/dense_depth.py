"""Dense depth of the keyframes of a segment, as further points of their surfaces.

Two passes over keyframes whose poses are final.  The first sweeps each with the images around it;
what it finds waits on disk.  The second asks the neighbours of a keyframe whether they see the same
surface.  The pixels that are sure join the map's points; the others fill what is then left bare.
"""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, I64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import transform
from pliant.algorithms.image.sharpness import sharpness
from pliant.algorithms.meshing.keyframe_surface import SeenPoints
from pliant.algorithms.meshing.rendering import DepthMap
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.algorithms.stereo.consensus import consensus
from pliant.algorithms.stereo.dense_points import matching_sigmas, sure_pixels
from pliant.algorithms.stereo.filling import filled
from pliant.algorithms.stereo.sources import SAMPLES, Viewpoints, choose_sources
from pliant.algorithms.stereo.sweep import Anchors, swept_depth
from pliant.algorithms.stereo.views import (
    DenseDepth,
    StereoView,
    reduction,
    shrunk,
    shrunk_camera,
)
from pliant.fusion.keyframe_spool import KeyframeSpool

_SOURCES, _NEIGHBOURS = 4, 12
"""Keyframes with whose images one is swept, and whose depths are asked."""
_FIRST_ID = 2**30
"""Of pixels as points: beyond all points of the map."""


@dataclass(frozen=True)
class _Taken:
    T_world_camera: F64
    some_points: F64
    sharpness: float


class DenseDepths:
    """The keyframes of one segment.  Images and depths wait in the spool.

    noise_px: of the map's observations, in whose unit sigmas are.
    """

    def __init__(self, camera: PinholeCamera, noise_px: float, spool: KeyframeSpool) -> None:
        self._whole = camera
        self._times = reduction(camera)
        self._camera = shrunk_camera(camera, self._times)
        self._noise_px = noise_px
        self._spool = spool
        self._taken: dict[int, _Taken] = {}
        self._around: dict[int, list[int]] = {}
        self._turn = 0

    def take(self, keyframe: int, T_world_camera: F64, points_world: F64, grey: U8,
             shown: BoolArray) -> None:  # fmt: skip
        """Take in a keyframe: its image grey (H, W), where that shows something, and its points."""
        usable = points_world[np.isfinite(points_world).all(axis=1)]
        if not (np.isfinite(T_world_camera).all() and len(usable)):
            return
        self._spool.put_grey(keyframe, shrunk(grey, shown, self._times))
        some = usable[:: -(-len(usable) // SAMPLES)]
        self._taken[keyframe] = _Taken(T_world_camera, some, sharpness(grey))

    def sweep(self, keyframe: int, seen: SeenPoints, timer: StageTimer = no_stages) -> None:
        """The first pass, of one keyframe, when all are taken."""
        if keyframe not in self._taken:
            return
        with timer("dense sources"):
            around = self._neighbours(keyframe)
            self._around[keyframe] = around
            sources = [self._view(other) for other in around[:_SOURCES]]
        with timer("dense sweep"):
            depth = swept_depth(self._view(keyframe), sources, self._anchors(keyframe, seen))
        self._spool.put_depth(keyframe, depth)

    def agreed(self, keyframe: int, timer: StageTimer = no_stages) -> DenseDepth | None:
        """The second pass, of one keyframe: what its neighbours say of its depth; None: nothing."""
        around = self._around.get(keyframe, [])
        if not around:
            return None
        with timer("dense consensus"):
            views = [self._view(other) for other in around]
            depths = [self._spool.depth(other) for other in around]
            return consensus(self._view(keyframe), self._spool.depth(keyframe), views, depths)

    def filled(self, depth_map: DepthMap, agreed: DenseDepth | None) -> DepthMap:
        """The depth map of a keyframe, and what was agreed on where that shows nothing."""
        return depth_map if agreed is None else filled(depth_map, agreed, self._times)

    def with_sure_pixels(
        self, keyframe: int, seen: SeenPoints, agreed: DenseDepth | None
    ) -> SeenPoints:
        """What a keyframe sees, and the pixels that are sure."""
        if agreed is None:
            return seen
        view = self._view(keyframe)
        sources = [self._view(other) for other in self._around[keyframe][:_SOURCES]]
        sure = sure_pixels(agreed, self._small(seen.points_px.astype(np.float64)))
        count = len(sure.inverse_depths)
        rays = np.ones((count, 3))
        rays[:, :2] = view.camera.normalise(sure.points_px)
        world = transform(view.T_world_camera, rays / sure.inverse_depths[:, None])
        sigmas = matching_sigmas(sure, view, sources) / self._noise_px
        # No pixel is another one in the next keyframe.
        self._turn = 1 - self._turn
        ids = np.arange(count, dtype=np.int64) + _FIRST_ID + self._turn * _FIRST_ID // 2
        pixels = (sure.points_px + 0.5) * self._times - 0.5
        keyframes = np.full(count, len(sources) + 1, np.int32)
        return SeenPoints(
            ids=np.concatenate([seen.ids, ids]),
            points_px=np.concatenate([seen.points_px, pixels.astype(np.float32)]),
            points_world=np.concatenate([seen.points_world, world]),
            sigmas=np.concatenate([seen.sigmas, sigmas.astype(np.float32)]),
            keyframes=np.concatenate([seen.keyframes, keyframes]),
        )

    def _neighbours(self, keyframe: int) -> list[int]:
        known = list(self._taken)
        views = Viewpoints(
            self._camera,
            np.stack([taken.T_world_camera for taken in self._taken.values()]),
            np.array([taken.sharpness for taken in self._taken.values()]),
        )
        some = self._taken[keyframe].some_points
        rows: I64 = choose_sources(views, known.index(keyframe), some, _NEIGHBOURS)
        return [known[row] for row in rows.tolist()]

    def _anchors(self, keyframe: int, seen: SeenPoints) -> Anchors:
        T = self._taken[keyframe].T_world_camera
        with np.errstate(all="ignore"):
            inverse_depths = 1.0 / ((seen.points_world - T[:3, 3]) @ T[:3, 2])
            sigmas = seen.sigmas * self._noise_px * inverse_depths
        good = (inverse_depths > 0.0) & np.isfinite(inverse_depths) & (sigmas > 0.0)
        good &= np.isfinite(sigmas)
        pixels = self._small(seen.points_px[good].astype(np.float64))
        return Anchors(pixels, inverse_depths[good], sigmas[good])

    def _small(self, points_px: F64) -> F64:
        return (points_px + 0.5) / self._times - 0.5

    def _view(self, keyframe: int) -> StereoView:
        shape = self._camera.height, self._camera.width
        grey = self._spool.grey(keyframe).reshape(shape)
        return StereoView(grey, self._camera, self._taken[keyframe].T_world_camera)
