"""From keyframes to meshes: a live one that follows the map, and a final one at the end.

VITAMIN-E section 4, but at keyframes instead of every frame.  While the map grows, a keyframe is a
preview until it leaves the window of bundle adjustment; then its last pose, points and observations
take the preview's place.  Where the map moves it later, as a loop is closed, it is fused anew, one
keyframe at a time.  The final mesh is made anew from the final poses of all keyframes.  Images,
observations and surfaces of all keyframes wait on disk.
"""

from collections.abc import Iterator, Mapping
from contextlib import ExitStack
from dataclasses import dataclass

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.map_delta import KeyframeDelta, MapDelta
from pliant.algorithms.meshing.keyframe_surface import KeyframeSurfaces, SeenPoints
from pliant.algorithms.meshing.mesh_blocks import MeshBlocks, TriangleMesh
from pliant.algorithms.meshing.parameters import MeshingParameters
from pliant.algorithms.meshing.rendering import DepthMap
from pliant.algorithms.meshing.tsdf_volume import VolumeFullError
from pliant.algorithms.slam.calibration.corrected_view import (
    CorrectedView,
    corrected_view,
    parts_of,
)
from pliant.algorithms.slam.calibration.rolling_shutter import RolledFrame
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.fusion.dense_depth import FINAL, LIVE, DenseDepths, Detail
from pliant.fusion.final_volume import FinalVolume
from pliant.fusion.keyframe_images import View, colour_of, grey_of, unmasked, view_of
from pliant.fusion.keyframe_motions import KeyframeMotions
from pliant.fusion.keyframe_spool import KeyframeSpool
from pliant.fusion.live_mesh import LiveMesh, Sight
from pliant.fusion.memory import too_fine
from pliant.map_history import CurrentMap

_MAX_NOTE = 200
_NO_IMAGE = "it has no image"


@dataclass(frozen=True)
class LiveChange:
    """Blocks of the live mesh of a segment that changed, or are repeated.

    span: of packed keys; there are no other blocks within it.  (0, -1): unknown.
    """

    segment: int
    voxel_size: float
    blocks: MeshBlocks
    again: bool = False
    span: tuple[int, int] = (0, -1)


@dataclass(frozen=True)
class FinalMesh:
    """A mesh made from final poses.  level: "fine" or "coarse"."""

    segment: int
    level: str
    voxel_size: float
    keyframes: int
    mesh: TriangleMesh


class Mesher:
    """A function of what it is given; it holds neither images nor depth maps.

    counts: what has been done so far, for the report.    note: the last problem, or all of those
    of the final meshes; "" without.
    """

    def __init__(
        self, camera: PinholeCamera, parameters: MeshingParameters, spool: KeyframeSpool
    ) -> None:
        self._camera = camera
        self._parameters = parameters
        self._spool = spool
        self._map = CurrentMap()
        self._motions = KeyframeMotions()
        self._corrections: dict[int, tuple[float, ...]] = {}
        self._readouts: dict[int, float] = {}
        self._surfaces = KeyframeSurfaces(camera, parameters.surface)
        self._live_dense = self._dense_depths(LIVE)
        self._live: LiveMesh | None = None
        self._frozen = parts_of(())
        self._segment = -1
        self._pending: list[tuple[int, bool]] = []
        self._told: set[int] = set()
        self._tried: set[int] = set()  # of the segment, fused or without a surface
        self._again: list[int] = []
        self._has_moved = False
        self.note = ""
        self.counts: dict[str, float] = dict.fromkeys(
            ("fused", "settled", "again", "passed_over", "without_surface"), 0.0
        )

    def take(
        self,
        update: MapDelta,
        keyframes: KeyframeDelta,
        images: Mapping[int, bytes],
        frame: int,
        masks: Mapping[int, bytes] | None = None,
    ) -> None:
        """Take the messages of a frame; cheap.  Fusion waits for ``fuse``.

        images: JPEG files of keyframes by their ids, each once.    masks: of those that have
        one, as of ``algorithms.image.masks``: what they cover is no surface.
        """
        self._map.take(update, frame)
        self._motions.take(update)
        if len(update.moved_keyframes):
            self._has_moved = True
            self._live_dense.move(update.map_moves())
            # The last surface is where the map was.
            self._surfaces = KeyframeSurfaces(self._camera, self._parameters.surface)
        if update.calibration_correction:
            self._see(update.segment, update.calibration_correction)
        for keyframe, jpeg in images.items():
            self._spool.put_image(keyframe, jpeg)
        for keyframe, mask in (masks or {}).items():
            self._spool.put_mask(keyframe, mask)
        bounds = np.concatenate([[0], np.cumsum(keyframes.counts)])
        for row, keyframe in enumerate(keyframes.keyframe_ids.tolist()):
            told = slice(int(bounds[row]), int(bounds[row + 1]))
            self._spool.put_observations(
                keyframe, keyframes.point_ids[told], keyframes.points_px[told]
            )
            self._told.add(keyframe)
            self._pending.append((keyframe, bool(keyframes.settled[row])))
        for gone, segment in update.joined.tolist():
            self._join(gone, segment)

    def _join(self, gone: int, segment: int) -> None:
        """Two segments are one."""
        if self._segment == gone:
            self._begin_live(segment)
        elif self._segment == segment:
            self._again = self._untried()

    def _begin_live(self, segment: int) -> None:
        """The camera is in another segment: its earlier keyframes are fused one by one."""
        self._segment, self._live, self._tried = segment, None, set()
        self._again = self._untried()

    def _untried(self) -> list[int]:
        left = sorted(self._told - self._tried)
        return [k for k in left if self._map.keyframes[k].segment == self._segment]

    def _see(self, segment: int, correction: tuple[float, ...]) -> None:
        """A segment is made with a corrected calibration."""
        if not self._corrections and not self._told:
            # Nothing was fused yet: where the focal length was a guess, all of the view is wanted.
            self._frozen = parts_of(correction)
            self._camera = corrected_view(self._camera, correction).camera
            self._surfaces = KeyframeSurfaces(self._camera, self._parameters.surface)
            self._live_dense = self._dense_depths(LIVE)
        left = self._left_of(correction)
        self._has_moved |= left != self._corrections.get(segment, left)
        self._corrections[segment] = left
        self._readouts[segment] = correction[3] if len(correction) > 3 else 0.0

    def _left_of(self, correction: tuple[float, ...]) -> tuple[float, ...]:
        """The rest of a correction relative to the frozen pinhole."""
        s, k1, k2, a, b, t = parts_of(correction)
        s0, _, _, a0, b0, t0 = self._frozen
        across, down = float(np.exp(s0 - s)), float(np.exp(s0 + t0 - s - t))
        return (s - s0, k1, k2, 0.0, a - across * a0, b - down * b0, t - t0)

    def fuse(self, *, newest_only: bool = False, timer: StageTimer = no_stages) -> list[LiveChange]:
        """Fuse what waits; returns what changed.

        newest_only: of the keyframes that are new, all but the last are passed over.  Of those that
        settle only the last is swept.
        """
        self.note = ""
        pending, self._pending = self._pending, []
        if newest_only:
            passed_over = [keyframe for keyframe, settled in pending if not settled][:-1]
            pending = [item for item in pending if item[1] or item[0] not in passed_over]
            self.counts["passed_over"] += len(passed_over)
            self._told -= {*passed_over} - {keyframe for keyframe, _ in pending}
        changed: list[LiveChange] = []
        newest_settled = max((k for k, settled in pending if settled), default=-1)
        for keyframe, settled in pending:
            segment = self._map.keyframes[keyframe].segment
            if segment != self._segment:
                changed += self._changes(timer)
                self._begin_live(segment)
            may_sweep = keyframe == newest_settled or not newest_only
            if settled and may_sweep and not self.behind:
                self._sweep(keyframe, timer)
            self._fuse_one(keyframe, "settled" if settled else "fused", timer)
        self._follow_map(timer)
        # Keyframes fused again are published with the next one, or when all are.
        if pending or not self._again:
            changed += self._changes(timer)
        return changed

    def _follow_map(self, timer: StageTimer) -> None:
        """Fuse a keyframe that the live mesh lacks, or has elsewhere than the map has it by now:
        one at a time, so that no message waits for all."""
        if self._has_moved and self._live is not None:
            lacking = [keyframe for keyframe in self._again if keyframe not in self._live.fused]
            self._again = [*lacking, *self._live.moved(self._map)]
        self._has_moved = False
        if self._again:
            self._fuse_one(self._again[0], "again", timer)

    @property
    def behind(self) -> int:
        """Keyframes that the live mesh lacks or has at an old pose: ``fuse`` takes one."""
        return len(self._again)

    @property
    def memory(self) -> dict[str, float]:
        """Bytes of the live volume and of the spool on disk, and blocks of the volume."""
        live = self._live.volume if self._live is not None else None
        return {
            "volume_mib": live.memory_bytes / 2**20 if live is not None else 0.0,
            "blocks": float(len(live.keys)) if live is not None else 0.0,
            "spool_mib": self._spool.size_bytes / 2**20,
        }

    def finish(self, *, timer: StageTimer = no_stages) -> Iterator[FinalMesh]:
        """The meshes of every segment, fine and coarse, from the map as it is now."""
        self.note, self._live = "", None
        self._surfaces = KeyframeSurfaces(self._camera, self._parameters.final_surface)
        by_segment: dict[int, list[int]] = {}
        for keyframe in self._spool.keyframes():
            by_segment.setdefault(self._map.keyframes[keyframe].segment, []).append(keyframe)
        for segment, keyframes in sorted(by_segment.items()):
            with ExitStack() as held:
                yield from self._finish_segment(segment, keyframes, timer, held)

    def _fuse_one(self, keyframe: int, count: str, timer: StageTimer) -> None:
        """Put a keyframe into the live mesh as the map has it now, in place of what is in there."""
        self._tried.add(keyframe)
        self._again = [other for other in self._again if other != keyframe]
        seen, correction = self._seen(keyframe), self._correction(keyframe)
        dense = self._with_dense(keyframe, seen, timer)
        surface = self._surfaces.surface(self._pose(keyframe), dense, timer)
        colour = self._colour(keyframe, correction)
        if self._live is not None:
            with timer("coarse fusion"):
                self._take_out(keyframe, self._live, colour, correction)
        if surface.depth_map is None or surface.drawn is None or colour is None:
            self._pass_over(keyframe, surface.problem or _NO_IMAGE)
            return
        self._spool.put_surface(keyframe, surface.drawn)
        depth_map = self._within(keyframe, surface.depth_map, view_of(self._camera, correction))
        sight = Sight(depth_map, colour, self._pose(keyframe))
        tsdf = self._parameters.tsdf
        try:
            if self._live is None:
                voxel_size = tsdf.coarse_voxel * surface.median_depth
                self._live = LiveMesh(voxel_size, self._camera, tsdf, self._parameters.again_blocks)
            with timer("coarse fusion"):
                self._live.put(keyframe, sight, correction, seen)
        except VolumeFullError as error:
            needed = error.needed_bytes
            self._pass_over(keyframe, too_fine("coarse", tsdf, needed, "the scene so far"))
            return
        self.counts[count] += 1

    def _sweep(self, keyframe: int, timer: StageTimer) -> None:
        """The dense depth of a keyframe that has left the window, from those swept before it."""
        if self._parameters.live_depth == "points":
            return
        self._take_dense(self._live_dense, keyframe, timer)
        segment = self._segment

        def usable(other: int) -> bool:
            return self._map.keyframes[other].segment == segment

        self._live_dense.add(keyframe, self._seen(keyframe), usable, timer)

    def _with_dense(self, keyframe: int, seen: SeenPoints, timer: StageTimer) -> SeenPoints:
        """The points of a keyframe, and the pixels on which it and earlier swept ones agree."""
        if not self._live_dense.is_swept(keyframe):
            return seen
        with timer("dense consensus"):
            agreed = self._live_dense.agreed_on(keyframe)
        return self._live_dense.with_sure_pixels(keyframe, seen, agreed)

    def _take_out(
        self, keyframe: int, live: LiveMesh, colour: U8 | None, correction: tuple[float, ...]
    ) -> None:
        """By the same depth map and image with which it was put in; nothing where it is not.

        colour (H, W, 3): of the keyframe, under a correction, which is mostly the same as then.
        """
        old = live.fused.get(keyframe)
        if old is None:
            return
        if old.correction != correction:
            colour = self._colour(keyframe, old.correction)
        assert colour is not None
        depth_map = self._spool.surface(keyframe).depth_map(self._camera)
        view = view_of(self._camera, old.correction)
        live.take_out(keyframe, self._within(keyframe, depth_map, view), colour)

    def _finish_segment(
        self, segment: int, keyframes: list[int], timer: StageTimer, held: ExitStack
    ) -> Iterator[FinalMesh]:
        unit = self._median_depth(keyframes)
        tsdf = self._parameters.tsdf
        if self._parameters.depth == "dense":
            tsdf = tsdf.model_copy(update={"min_weight": tsdf.dense_min_weight})
        volumes = {
            level: held.enter_context(FinalVolume(share * unit, self._camera, tsdf))
            for level, share in (("fine", tsdf.fine_voxel), ("coarse", tsdf.coarse_voxel))
        }
        dense = self._dense(keyframes, timer)
        fused, problem = 0, ""
        agreements = dense.agreed(keyframes, timer)
        for keyframe, agreed in zip(keyframes, agreements, strict=True):
            view, pose = self._still(keyframe), self._pose(keyframe)
            colour = colour_of(self._spool.image(keyframe), view)
            seen = dense.with_sure_pixels(keyframe, self._seen(keyframe), agreed)
            surface = self._surfaces.surface(pose, seen, timer)
            if surface.depth_map is None or colour is None:
                problem = f"keyframe {keyframe}: {surface.problem or _NO_IMAGE}"
                continue
            with timer("dense filling"):
                depth_map = dense.filled(keyframe, surface.depth_map, agreed)
            depth_map = self._within(keyframe, depth_map, view)
            for level, volume in volumes.items():
                with timer(f"final {level} fusion"):
                    volume.put(depth_map, colour, pose)
            fused += 1
        if fused == 0:
            self._tell(f"no keyframe of segment {segment} has a surface ({problem})")
            return
        for level, volume in volumes.items():
            if volume.is_full:
                needed, room, what = volume.needed_bytes, volume.most_bytes, f"segment {segment}"
                self._tell(f"no {level} mesh: {too_fine(level, tsdf, needed, what, room)}")
                continue
            self.counts[f"final_{level}_mib"] = volume.memory_bytes / 2**20
            self.counts[f"final_{level}_file_mib"] = volume.file_bytes / 2**20
            with timer(f"final {level} meshing"):
                finish = level == "fine" and self._finishes
                mesh = volume.mesh(finish=finish)
            yield FinalMesh(segment, level, volume.volume.scale.voxel, fused, mesh)

    @property
    def _finishes(self) -> bool:
        """The mesh of the points alone is the paper's."""
        return self._parameters.finish and self._parameters.depth == "dense"

    def _dense(self, keyframes: list[int], timer: StageTimer) -> DenseDepths:
        """The dense depths of the keyframes of a segment; none with the points alone."""
        dense = self._dense_depths(FINAL)
        if self._parameters.depth == "points":
            return dense
        for keyframe in keyframes:
            self._take_dense(dense, keyframe, timer)
        dense.sweep(((keyframe, self._seen(keyframe)) for keyframe in keyframes), timer)
        return dense

    def _dense_depths(self, detail: Detail) -> DenseDepths:
        noise_px = self._parameters.surface.noise_px
        return DenseDepths(self._camera, noise_px, self._spool, detail=detail)

    def _take_dense(self, dense: DenseDepths, keyframe: int, timer: StageTimer) -> None:
        """Give the image of a keyframe to be swept; nothing where it has none."""
        with timer("dense images"):
            view = self._still(keyframe)
            colour = colour_of(self._spool.image(keyframe), view)
            if colour is None:
                return
            used = unmasked(self._spool.mask(keyframe), view)
            shown = view.shows if used is None else view.shows & used
            points = self._seen(keyframe).points_world
            dense.take(keyframe, self._pose(keyframe), points, grey_of(colour), shown)

    def _median_depth(self, keyframes: list[int]) -> float:
        """Median over the keyframes of the median depth of their points."""
        medians: list[float] = []
        for keyframe in keyframes:
            depths = self._depths(keyframe, self._seen(keyframe).points_world)
            depths = depths[np.isfinite(depths) & (depths > 0.0)]
            if len(depths):
                medians.append(float(np.median(depths)))
        return float(np.median(medians)) if medians else 1.0

    def _within(self, keyframe: int, depth_map: DepthMap, view: View) -> DepthMap:
        """The depth map without the pixels that the keyframe's mask covers."""
        used = unmasked(self._spool.mask(keyframe), view)
        return depth_map if used is None else depth_map.within(used)

    def _correction(self, keyframe: int) -> tuple[float, ...]:
        """The remaining correction of the calibration with which a keyframe's segment was made."""
        segment = self._map.keyframes[keyframe].segment
        return self._corrections.get(segment, self._left_of(()))

    def _pose(self, keyframe: int) -> F64:
        return pose_to_matrix(self._map.keyframes[keyframe].pose_world_camera)

    def _depths(self, keyframe: int, points_world: F64) -> F64:
        T = self._pose(keyframe)
        return (points_world - T[:3, 3]) @ T[:3, 2]

    def _still(self, keyframe: int) -> View:
        """What a keyframe would see with a global shutter, at the depth of its points."""
        view = view_of(self._camera, self._correction(keyframe))
        readout = self._readouts.get(self._map.keyframes[keyframe].segment, 0.0)
        motion = self._motions.motion(keyframe, self._map.keyframes) if readout else None
        if motion is None:
            return view
        _, points = self._map.points_of(self._spool.observations(keyframe)[0])
        depths = self._depths(keyframe, points.positions)
        depths = depths[depths > 0.0]
        inverse_depth = float(1.0 / np.median(depths)) if len(depths) else 0.0
        return RolledFrame(view, readout, motion, inverse_depth)

    def _seen(self, keyframe: int) -> SeenPoints:
        """The points that a keyframe observes, without those that are gone."""
        ids, pixels = self._spool.observations(keyframe)
        rows, points = self._map.points_of(ids)
        view = self._still(keyframe)
        if isinstance(view, CorrectedView):
            points_px = view.pixels(pixels[rows])
        else:
            with np.errstate(divide="ignore"):
                inverse_depths = 1.0 / self._depths(keyframe, points.positions)
            points_px = view.removed(view.view.pixels(pixels[rows]), inverse_depths)
        return SeenPoints(
            ids=points.ids,
            points_px=points_px,
            points_world=points.positions,
            sigmas=np.asarray(points.sigmas, np.float32),
            keyframes=np.asarray(points.keyframes, np.int32),
        )

    def _colour(self, keyframe: int, correction: tuple[float, ...]) -> U8 | None:
        """(H, W, 3) RGB of a keyframe; None where its image is missing or broken."""
        return colour_of(self._spool.image(keyframe), view_of(self._camera, correction))

    def _pass_over(self, keyframe: int, why: str) -> None:
        self.counts["without_surface"] += 1
        self.note = f"keyframe {keyframe} is passed over: {why}"[:_MAX_NOTE]

    def _tell(self, problem: str) -> None:
        self.note = f"{self.note}; {problem}" if self.note else problem

    def _changes(self, timer: StageTimer) -> list[LiveChange]:
        if self._live is None:
            return []
        blocks = self._live.changes(timer)
        if blocks is None:
            return []
        size = self._live.volume.scale.voxel
        again, span = self._live.again()
        return [
            LiveChange(self._segment, size, blocks),
            LiveChange(self._segment, size, again, again=True, span=span),
        ]
