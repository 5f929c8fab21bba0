"""From keyframes to meshes: a live one that follows the map, and a final one from its last word.

VITAMIN-E section 4, but at keyframes instead of every frame.  While the map grows, a keyframe is a
preview until it leaves the window of bundle adjustment; then its last pose, points and observations
take the preview's place.  The final mesh is made anew from the final poses of all keyframes, whose
images and observations wait on disk.
"""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.corrected_view import CorrectedView, corrected_view, parts_of
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.image.masks import unpacked
from pliant.algorithms.map_delta import KeyframeDelta, MapDelta
from pliant.algorithms.meshing.keyframe_surface import KeyframeSurfaces, SeenPoints, Surface
from pliant.algorithms.meshing.mesh_blocks import BLOCK_BYTES, MeshBlocks, TriangleMesh, sorted_keys
from pliant.algorithms.meshing.parameters import MeshingParameters, TsdfParameters
from pliant.algorithms.meshing.rendering import DepthMap
from pliant.algorithms.meshing.tsdf_integrate import blocks_in_band, pixel_planes
from pliant.algorithms.meshing.tsdf_volume import TsdfVolume, VolumeFullError
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.fusion.keyframe_spool import KeyframeSpool
from pliant.fusion.live_mesh import LiveMesh
from pliant.fusion.memory import too_fine
from pliant.map_history import CurrentMap

_MAX_NOTE = 200
_NO_IMAGE = "it has no image"


@dataclass(frozen=True)
class LiveChange:
    """Blocks of the live mesh of a segment that changed, or are told again.

    span: of packed keys; there are no other blocks within it.  (0, -1): it says nothing.
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


class _FinalVolume:
    """A volume for a final mesh.  Once it is full it is empty, and counts what it would take."""

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


class Mesher:
    """A function of what it is given; it holds no image but those of keyframes in the window.

    focal: logarithm of the camera's focal length over that of the camera which was given.
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
        self._views: dict[int, CorrectedView] = {}
        self._surfaces = KeyframeSurfaces(camera, parameters.surface)
        self._live: LiveMesh | None = None
        self._frozen = parts_of(())
        self._segment = -1
        self._pending: list[tuple[int, bool]] = []
        self._told: dict[int, bool] = {}  # keyframes, and whether they were settled
        self._fused: set[int] = set()
        self._again: list[int] = []
        self.note = ""
        self.counts: dict[str, float] = dict.fromkeys(
            ("fused", "settled", "passed_over", "without_surface"), 0.0
        )

    def take(
        self,
        update: MapDelta,
        keyframes: KeyframeDelta,
        images: Mapping[int, bytes],
        frame: int,
        masks: Mapping[int, bytes] | None = None,
    ) -> None:
        """Take in what a frame tells; cheap.  What is to be fused waits for ``fuse``.

        images: JPEG files of keyframes by their ids, each told once.    masks: of those that have
        one, as of ``algorithms.image.masks``: what they cover is no surface.
        """
        self._map.take(update, frame)
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
            self._told[keyframe] = bool(keyframes.settled[row])
            self._pending.append((keyframe, self._told[keyframe]))
        for gone, segment in update.joined.tolist():
            self._join(gone, segment)

    def _join(self, gone: int, segment: int) -> None:
        """Two segments are one: what the live mesh lacks of it is fused one by one."""
        if self._segment == gone:
            self._begin_live(segment)
        if self._segment == segment:
            joined = (k for k in self._told if self._map.keyframes[k].segment == segment)
            self._again = sorted(k for k in joined if k not in self._fused)

    def _begin_live(self, segment: int) -> None:
        self._segment, self._live, self._fused, self._again = segment, None, set(), []

    def _see(self, segment: int, correction: tuple[float, ...]) -> None:
        """A segment is made with a corrected calibration."""
        if not self._views and not self._spool.keyframes():
            # Nothing was fused yet: where the focal length was a guess, all of the view is wanted.
            self._frozen = parts_of(correction)
            self._camera = corrected_view(self._camera, correction).camera
            self._surfaces = KeyframeSurfaces(self._camera, self._parameters.surface)
        self._views[segment] = self._left_of(correction)

    def _left_of(self, correction: tuple[float, ...]) -> CorrectedView:
        """What of a correction is left beside the pinhole that was frozen."""
        s, k1, k2, a, b = parts_of(correction)
        s0, _, _, a0, b0 = self._frozen
        share = float(np.exp(s0 - s))
        rest = (s - s0, k1, k2, 0.0, a - share * a0, b - share * b0)
        return CorrectedView(self._camera, rest)

    def fuse(self, *, newest_only: bool = False, timer: StageTimer = no_stages) -> list[LiveChange]:
        """Fuse what waits; returns what changed.

        newest_only: of the keyframes that are new, all but the last are passed over.
        """
        self.note = ""
        pending, self._pending = self._pending, []
        if newest_only:
            fresh = [item for item in pending if not item[1]]
            self.counts["passed_over"] += max(0, len(fresh) - 1)
            pending = [item for item in pending if item[1] or item == fresh[-1]]
        if self._live is not None and self._parameters.corrections == "moved":
            told = [keyframe for keyframe, _ in pending]
            moved = [k for k in self._live.moved(self._pose) if k not in told]
            self.counts["again"] = self.counts.get("again", 0.0) + len(moved)
            pending = [*((k, False) for k in moved), *pending]
        changed: list[LiveChange] = []
        for keyframe, settled in pending:
            segment = self._map.keyframes[keyframe].segment
            if segment != self._segment:
                changed += self._changes(timer)
                self._begin_live(segment)
            self._fuse_one(keyframe, settled=settled, timer=timer)
        self._again = [keyframe for keyframe in self._again if keyframe not in self._fused]
        if self._again:  # of a segment that was joined: one by one, so that nobody waits for all
            keyframe = self._again[0]
            self._fuse_one(keyframe, settled=self._told[keyframe], timer=timer)
        return changed + self._changes(timer)

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
        self._surfaces = KeyframeSurfaces(self._camera, self._parameters.surface)
        by_segment: dict[int, list[int]] = {}
        for keyframe in self._spool.keyframes():
            by_segment.setdefault(self._map.keyframes[keyframe].segment, []).append(keyframe)
        for segment, keyframes in sorted(by_segment.items()):
            yield from self._finish_segment(segment, keyframes, timer)

    def _fuse_one(self, keyframe: int, *, settled: bool, timer: StageTimer) -> None:
        self._fused.add(keyframe)
        colour = self._colour(keyframe)
        surface = self._surface(keyframe, timer)
        if surface.depth_map is None or colour is None:
            self._pass_over(keyframe, surface.problem or _NO_IMAGE)
            if self._live is not None:
                self._live.take_out(keyframe)
            return
        tsdf = self._parameters.tsdf
        try:
            if self._live is None:
                voxel_size = tsdf.coarse_voxel * surface.median_depth
                self._live = LiveMesh(voxel_size, self._camera, tsdf, self._parameters.again_blocks)
            with timer("coarse fusion"):
                self._live.put(
                    keyframe, surface.depth_map, colour, self._pose(keyframe), settled=settled
                )
        except VolumeFullError as error:
            needed = error.needed_bytes
            self._pass_over(keyframe, too_fine("coarse", tsdf, needed, "what was seen so far"))
            return
        self.counts["settled" if settled else "fused"] += 1

    def _finish_segment(
        self, segment: int, keyframes: list[int], timer: StageTimer
    ) -> Iterator[FinalMesh]:
        unit = self._median_depth(keyframes)
        tsdf = self._parameters.tsdf
        volumes = {
            level: _FinalVolume(share * unit, self._camera, tsdf)
            for level, share in (("fine", tsdf.fine_voxel), ("coarse", tsdf.coarse_voxel))
        }
        fused, problem = 0, ""
        for keyframe in keyframes:
            colour = self._colour(keyframe)
            surface = self._surface(keyframe, timer)
            if surface.depth_map is None or colour is None:
                problem = f"keyframe {keyframe}: {surface.problem or _NO_IMAGE}"
                continue
            for level, volume in volumes.items():
                with timer(f"final {level} fusion"):
                    volume.put(surface.depth_map, colour, self._pose(keyframe))
            fused += 1
        if fused == 0:
            self._tell(f"no keyframe of segment {segment} has a surface ({problem})")
            return
        for level, volume in volumes.items():
            if volume.is_full:
                what = f"segment {segment}"
                self._tell(f"no {level} mesh: {too_fine(level, tsdf, volume.needed_bytes, what)}")
                continue
            self.counts[f"final_{level}_mib"] = volume.volume.memory_bytes / 2**20
            with timer(f"final {level} meshing"):
                mesh = volume.volume.extract_all()
            yield FinalMesh(segment, level, volume.volume.scale.voxel, fused, mesh)

    def _median_depth(self, keyframes: list[int]) -> float:
        """Of the points that the keyframes see, the median of their medians."""
        medians: list[float] = []
        for keyframe in keyframes:
            T = self._pose(keyframe)
            points = self._seen(keyframe).points_world
            depths = (points - T[:3, 3]) @ T[:3, 2]
            depths = depths[np.isfinite(depths) & (depths > 0.0)]
            if len(depths):
                medians.append(float(np.median(depths)))
        return float(np.median(medians)) if medians else 1.0

    def _surface(self, keyframe: int, timer: StageTimer) -> Surface:
        found = self._surfaces.surface(self._pose(keyframe), self._seen(keyframe), timer)
        mask = self._spool.mask(keyframe)
        if found.depth_map is None or not mask:
            return found
        used = self._view(keyframe).image(np.uint8(255) * unpacked(mask).astype(np.uint8)) == 255
        return replace(found, depth_map=found.depth_map.within(used))

    def _view(self, keyframe: int) -> CorrectedView:
        """As the calibration has it with which the segment of the keyframe was made."""
        none = self._left_of(())
        return self._views.get(self._map.keyframes[keyframe].segment, none)

    def _pose(self, keyframe: int) -> F64:
        return pose_to_matrix(self._map.keyframes[keyframe].pose_world_camera)

    def _seen(self, keyframe: int) -> SeenPoints:
        """The points that a keyframe observes, without those that are gone."""
        ids, pixels = self._spool.observations(keyframe)
        rows, points = self._map.points_of(ids)
        return SeenPoints(
            ids=points.ids,
            points_px=self._view(keyframe).pixels(pixels[rows]),
            points_world=points.positions,
            sigmas=np.asarray(points.sigmas, np.float32),
            keyframes=np.asarray(points.keyframes, np.int32),
        )

    def _colour(self, keyframe: int) -> U8 | None:
        """(H, W, 3) RGB of a keyframe; None where its image is missing or broken."""
        jpeg = self._spool.image(keyframe)
        if not jpeg:
            return None
        pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR_RGB)
        return None if pixels is None else self._view(keyframe).image(np.asarray(pixels, np.uint8))

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
