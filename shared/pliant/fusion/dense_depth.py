"""Dense depth of the keyframes of a segment, as further points of their surfaces.

Two passes over keyframes whose poses are final.  The first sweeps each with the images around it;
what it finds waits on disk.  The second asks the neighbours of a keyframe whether they see the same
surface.  The pixels that are sure join the map's points; the others fill what is then left bare.
"""

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from pliant.algorithms.arrays import F64, I64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import move_by_similarity, transform
from pliant.algorithms.image.sharpness import sharpness
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.meshing.keyframe_surface import SeenPoints
from pliant.algorithms.meshing.rendering import DepthMap
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.algorithms.stereo.consensus import consensus
from pliant.algorithms.stereo.dense_points import matching_sigmas, sure_pixels
from pliant.algorithms.stereo.extension import extended, reduced
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
from pliant.fusion.parallel import in_order, processors

_SOURCES, _NEIGHBOURS = 4, 12
"""Keyframes with whose images one is swept, and whose depths are asked."""
_RECENT = 64
"""Keyframes swept last, of which the live mesh takes its sources: constant time per keyframe."""
_FIRST_ID = 2**30
"""First id of pixels that are used as points: beyond all points of the map."""


@dataclass(frozen=True)
class Detail:
    """How finely keyframes are swept.

    halvings: of images, beyond ``reduction``.    stride, min_support: as of ``sure_pixels``.
    """

    halvings: int
    stride: int
    min_support: float


FINAL = Detail(halvings=0, stride=2, min_support=4.0)
LIVE = Detail(halvings=1, stride=1, min_support=3.0)
"""Neighbours are only those before a keyframe: fewer agree.  The stride is the same angle."""


@dataclass(frozen=True)
class _Taken:
    """scale: by how much the map has grown at this keyframe since it was swept."""

    T_world_camera: F64
    some_points: F64
    sharpness: float
    scale: float = 1.0


@dataclass(frozen=True)
class _Swept:
    """around: the keyframes beside it, the most informative first."""

    keyframe: int
    around: list[int]
    depth: DenseDepth


class DenseDepths:
    """The keyframes of one segment.  Images and depths wait in the spool.

    noise_px: of the map's observations, in whose unit sigmas are.    workers: threads of a pass;
    with any number of them the bytes are the same.
    """

    def __init__(
        self, camera: PinholeCamera, noise_px: float, spool: KeyframeSpool,
        workers: int | None = None, detail: Detail = FINAL,
    ) -> None:  # fmt: skip
        self._detail = detail
        self._times = reduction(camera) * 2**detail.halvings
        self._camera = shrunk_camera(camera, self._times)
        self._noise_px = noise_px
        self._spool = spool
        self._taken: dict[int, _Taken] = {}
        self._around: dict[int, list[int]] = {}
        self._turn = 0
        self._workers = processors() if workers is None else workers

    def take(self, keyframe: int, T_world_camera: F64, points_world: F64, grey: U8,
             shown: BoolArray) -> None:  # fmt: skip
        """Take in a keyframe: its image grey (H, W), where that shows something, and its points."""
        usable = points_world[np.isfinite(points_world).all(axis=1)]
        if not (np.isfinite(T_world_camera).all() and len(usable)):
            return
        self._spool.put_grey(keyframe, shrunk(grey, shown, self._times))
        some = usable[:: -(-len(usable) // SAMPLES)]
        self._taken[keyframe] = _Taken(T_world_camera, some, sharpness(grey))

    def sweep(self, seen: Iterable[tuple[int, SeenPoints]], timer: StageTimer = no_stages) -> None:
        """The first pass, over all keyframes and the points that each observes."""
        known = ((keyframe, points) for keyframe, points in seen if keyframe in self._taken)
        results = in_order(self._swept, known, self._workers)
        while True:
            with timer("dense sweep"):
                swept = next(results, None)
            if swept is None:
                return
            self._around[swept.keyframe] = swept.around
            self._spool.put_depth(swept.keyframe, swept.depth)

    def add(
        self, keyframe: int, seen: SeenPoints, usable: Callable[[int], bool],
        timer: StageTimer = no_stages,
    ) -> None:  # fmt: skip
        """Sweep one more keyframe beside the usable ones of those that were swept last.

        Nothing where it was not taken.
        """
        if keyframe not in self._taken:
            return
        with timer("dense sweep"):
            recent = [k for k in list(self._around)[-_RECENT:] if k != keyframe and usable(k)]
            around = self._neighbours(keyframe, [*recent, keyframe])
            depth = self._depth_from(keyframe, seen, around)
            self._around.pop(keyframe, None)  # the last from now on
            self._around[keyframe] = around
            self._spool.put_depth(keyframe, depth)

    def is_swept(self, keyframe: int) -> bool:
        """Whether the depth of a keyframe is there."""
        return keyframe in self._around

    def move(self, moves: MapMoves) -> None:
        """The whole map moves, and with it the keyframes that were taken.

        Depths stay in their cameras; they grow with the map.
        """
        ids = np.array(list(self._taken), np.int64)
        for keyframe, matrix in zip(ids.tolist(), moves.matrices(ids), strict=True):
            taken = self._taken[keyframe]
            self._taken[keyframe] = replace(
                taken,
                T_world_camera=move_by_similarity(matrix, taken.T_world_camera),
                scale=taken.scale * float(np.cbrt(np.linalg.det(matrix[:3, :3]))),
            )

    def agreed(
        self, keyframes: Sequence[int], timer: StageTimer = no_stages
    ) -> Iterator[DenseDepth | None]:
        """The second pass, of each keyframe in turn, when the first one is done: what it and its
        neighbours agree on; None: nothing."""
        results = in_order(self.agreed_on, keyframes, self._workers)
        for _ in keyframes:
            with timer("dense consensus"):
                agreed = next(results)
            yield agreed

    def filled(self, keyframe: int, depth_map: DepthMap, agreed: DenseDepth | None) -> DepthMap:
        """The depth map of a keyframe; where that shows nothing, the surfaces around are extended,
        or what was agreed on counts."""
        if agreed is None:
            return depth_map
        sources = [self._view(other) for other in self._around[keyframe][:_SOURCES]]
        surface = reduced(depth_map.depths, self._times)
        more = extended(surface, agreed, self._view(keyframe), sources)
        return filled(depth_map, more, self._times)

    def with_sure_pixels(
        self, keyframe: int, seen: SeenPoints, agreed: DenseDepth | None
    ) -> SeenPoints:
        """The points that a keyframe observes, and its certain pixels."""
        if agreed is None:
            return seen
        view = self._view(keyframe)
        sources = [self._view(other) for other in self._around[keyframe][:_SOURCES]]
        sure = sure_pixels(
            agreed, self._small(seen.points_px.astype(np.float64)),
            stride=self._detail.stride, min_support=self._detail.min_support,
        )  # fmt: skip
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

    def _swept(self, told: tuple[int, SeenPoints]) -> _Swept:
        keyframe, seen = told
        around = self._neighbours(keyframe, list(self._taken))
        return _Swept(keyframe, around, self._depth_from(keyframe, seen, around))

    def _depth_from(self, keyframe: int, seen: SeenPoints, around: list[int]) -> DenseDepth:
        sources = [self._view(other) for other in around[:_SOURCES]]
        return swept_depth(self._view(keyframe), sources, self._anchors(keyframe, seen))

    def agreed_on(self, keyframe: int) -> DenseDepth | None:
        """The depth on which a keyframe and its neighbours agree, or None."""
        around = self._around.get(keyframe, [])
        if not around:
            return None
        views = [self._view(other) for other in around]
        depths = [self._depth(other) for other in around]
        return consensus(self._view(keyframe), self._depth(keyframe), views, depths)

    def _depth(self, keyframe: int) -> DenseDepth:
        """As it was swept, in the unit of the map as it is now."""
        depth = self._spool.depth(keyframe)
        share = np.float32(1.0 / self._taken[keyframe].scale)
        return DenseDepth(share * depth.inverse_depths, depth.confidences)

    def _neighbours(self, keyframe: int, known: list[int]) -> list[int]:
        taken = [self._taken[other] for other in known]
        views = Viewpoints(
            self._camera,
            np.stack([other.T_world_camera for other in taken]),
            np.array([other.sharpness for other in taken]),
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
