"""The mapper: from the tracks of each frame to its pose and a dense map.

VITAMIN-E section 3: start by essential matrix, poses by P3P and RANSAC, points by triangulation,
and bundle adjustment on every frame by the subspace Gauss-Newton method; on top of it, Schur LM
over the window at keyframes and re-acquisition of points that lost their track.
"""

import dataclasses

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.map_delta import LOST, TRACKING, WAITING, KeyframeDelta, MapDelta
from pliant.algorithms.mapping.active_map import ActiveMap
from pliant.algorithms.mapping.localisation import locate, refine
from pliant.algorithms.mapping.map_store import MAPPED, Keyframe, Observations, PointRows
from pliant.algorithms.mapping.observation_table import reprojection_errors
from pliant.algorithms.mapping.parameters import MappingParameters
from pliant.algorithms.mapping.publication import KeyframeChanges, MapChanges
from pliant.algorithms.mapping.reacquisition import MaximaGrid, reacquire
from pliant.algorithms.mapping.rolling_shutter import Path
from pliant.algorithms.mapping.start import Start, WaitingFrame, find_start
from pliant.algorithms.stages import StageTimer, no_stages
from pliant.algorithms.tracks import FrameTracks


class Mapper:
    """Builds the map and localises every frame in it.

    A pure function of camera, parameters, seed and the frames given, one after the other.
    """

    def __init__(
        self,
        camera: PinholeCamera,
        parameters: MappingParameters,
        seed: int,
    ) -> None:
        self._camera = camera
        self._parameters = parameters
        self._generator = np.random.default_rng(seed)
        self._timer: StageTimer = no_stages
        self._points = PointRows()
        self._changes = MapChanges()
        self._path = Path()
        self._keyframe_changes = KeyframeChanges(self._points)
        self._waiting: list[WaitingFrame] = []
        self._map: ActiveMap | None = None
        self._segments = 0
        self._keyframes = 0
        self._recent_poses: list[F64] = []
        self._lost_frames = 0
        self._since_keyframe = 0
        self._published_frames = 0

    def process(
        self,
        frame: int,
        tracks: FrameTracks,
        grey: U8 | None,
        colour: U8 | None,
        timer: StageTimer = no_stages,
    ) -> MapDelta:
        """Localise a frame and let the map grow.  grey: (H, W).  colour: (H, W, 3) RGB."""
        self._timer = timer
        if self._map is None:
            return self._wait(frame, tracks, grey, colour)
        self._map.links.follow(tracks.ids)
        with self._timer("localisation"):
            located = self._localise(self._map, tracks)
        if located is None:
            return self._lost(self._map, frame, tracks)
        with self._timer("reacquisition"):
            T_world_camera, found = self._reacquire(self._map, frame, located, tracks, grey)
        with self._timer("subspace adjustment"):
            T_world_camera, inliers = self._adjust(self._map, T_world_camera, found, tracks)
        with self._timer("triangulation"):
            self._map.triangulate()
        hanging = self._map.keyframes[-1]
        if self._keyframe_is_due(self._map):
            with self._timer("keyframe"):
                hanging = self._map.insert_keyframe(
                    frame, T_world_camera, tracks.points_px, found, grey, colour
                )
            T_world_camera = hanging.T_world_camera
            self._since_keyframe = 0
        self._since_keyframe += 1
        self._lost_frames = 0
        self._recent_poses = [*self._recent_poses[-1:], T_world_camera]
        self._add_pose(self._map, frame, hanging, T_world_camera, inliers)
        return self._publish(TRACKING, "", inliers)

    def skip(self, frame: int, reason: str = "the frame has no pixels") -> MapDelta:
        """Pass over a frame, without pixels (dropped or broken) or without time: it gets no pose.

        Whether the camera is lost is for frames with pixels to decide: the state stays as it was.
        The tracks that live on are taken up again by the next frame.
        """
        if self._map is None:
            state = WAITING
        else:
            state = LOST if self._lost_frames else TRACKING
        return self._publish(state, reason, 0)

    @property
    def point_count(self) -> int:
        """Points of the map now, of all segments."""
        return self._points.culled + int(np.count_nonzero(self._points.state == MAPPED))

    def finish(self) -> MapDelta:
        """What is still to be corrected at the end of the stream."""
        if self._map is None:
            return self._publish(WAITING, "the stream has ended", 0, snapshot=True)
        correction: tuple[float, ...] = ()
        whole = self._finishes(self._map)
        if whole:
            self._map.collect_garbage()
            found = self._map.adjust_all(self._path)
            if self._parameters.calibration.sigmas.any():
                correction = tuple(found.tolist())
        self._keyframe_changes.settle(self._map.keyframes)
        delta = self._publish(TRACKING, "", 0, snapshot=True, whole=whole)
        return dataclasses.replace(delta, calibration_correction=correction)

    def _finishes(self, active: ActiveMap) -> bool:
        limits = self._parameters.window
        few = len(active.keyframes) + active.culled <= limits.final_max_keyframes
        return limits.final_adjustment and few

    def _add_pose(
        self, active: ActiveMap, frame: int, keyframe: Keyframe, T_world_camera: F64, inliers: int
    ) -> None:
        self._changes.add_pose(frame, keyframe, T_world_camera, inliers)
        if self._finishes(active):
            self._path.add(frame, keyframe, T_world_camera)
        else:
            self._path.forget()

    def publish_keyframes(self) -> KeyframeDelta:
        """What is to be published of keyframes after the last frame, or after ``finish``."""
        if self._map is None:
            return self._keyframe_changes.publish(None)
        self._keyframe_changes.settle(self._map.keyframes[: -self._parameters.window.keyframes])
        return self._keyframe_changes.publish(self._map.keyframes[-1])

    def _wait(
        self, frame: int, tracks: FrameTracks, grey: U8 | None, colour: U8 | None
    ) -> MapDelta:
        waiting = WaitingFrame(
            frame=frame, ids=tracks.ids, points_px=tracks.points_px, kappas=tracks.kappas
        )
        self._waiting = [*self._waiting[1 - self._parameters.start.max_frames :], waiting]
        with self._timer("start"):
            start = find_start(self._waiting, self._camera, self._parameters)
        if isinstance(start, str):
            return self._publish(WAITING, start, 0)
        with self._timer("start"):
            inliers = self._begin(start, tracks, grey, colour)
        return self._publish(TRACKING, "", inliers)

    def _begin(self, start: Start, tracks: FrameTracks, grey: U8 | None, colour: U8 | None) -> int:
        """Let the map start, and give poses to the frames that waited, backwards."""
        self._points.cull_all()  # of earlier segments, which have been published
        self._map = ActiveMap(
            self._segments, self._points, self._keyframes, self._camera, self._parameters
        )
        self._segments += 1
        self._path.forget()
        self._map.begin(start, self._waiting, grey, colour)
        keyframes = {keyframe.frame: keyframe for keyframe in self._map.keyframes}
        T_world_camera = self._map.keyframes[-1].T_world_camera
        hanging = self._map.keyframes[-1]
        poses: list[F64] = []
        inliers = 0
        for waiting in reversed(self._waiting):
            _, i, j = np.intersect1d(
                waiting.ids, start.ids, assume_unique=True, return_indices=True
            )
            if waiting.frame in keyframes:
                hanging = keyframes[waiting.frame]
                T_world_camera = hanging.T_world_camera
            if len(i) < self._parameters.localisation.min_inliers:
                continue
            located = refine(
                T_world_camera,
                start.points_world[j],
                waiting.points_px[i],
                self._camera,
                self._parameters.localisation,
            )
            count = int(located.inliers.sum())
            if count < self._parameters.localisation.min_inliers:
                continue
            if waiting.frame not in keyframes:
                T_world_camera = located.T_world_camera
            self._add_pose(self._map, waiting.frame, hanging, T_world_camera, count)
            poses.append(T_world_camera)
            inliers = inliers or count
        self._recent_poses = poses[1::-1]
        self._waiting = []
        self._since_keyframe = 1
        return inliers

    def _localise(self, active: ActiveMap, tracks: FrameTracks) -> F64 | None:
        """T_world_camera of the frame from the tracks of mapped points, None where it fails."""
        linked = active.linked(MAPPED)
        limits = self._parameters.localisation
        if len(linked) < limits.min_inliers:
            return None
        last, previous = self._recent_poses[-1], self._recent_poses[0]
        located = locate(
            [last @ inverse(previous) @ last, last],
            self._points.xyz[active.links.rows[linked]],
            tracks.points_px[linked],
            self._camera,
            limits,
            self._generator,
        )
        if located.inliers.sum() < limits.min_inliers:
            return None
        return located.T_world_camera

    def _lost(self, active: ActiveMap, frame: int, tracks: FrameTracks) -> MapDelta:
        """The frame has no pose.  After several such frames the segment is closed."""
        seen = len(active.linked(MAPPED))
        reason = f"lost: the pose of frame {frame} is not supported, {seen} mapped tracks"
        self._lost_frames += 1
        delta = self._publish(LOST, reason, 0)
        if self._lost_frames > self._parameters.localisation.max_lost_frames:
            self._keyframe_changes.settle(active.keyframes)
            self._keyframes = active.next_keyframe_id
            self._map = None
        return delta

    def _reacquire(
        self,
        active: ActiveMap,
        frame: int,
        T_world_camera: F64,
        tracks: FrameTracks,
        grey: U8 | None,
    ) -> tuple[F64, Observations]:
        """Find points without a track among the maxima, and refine the pose with them."""
        points = self._points
        none = Observations(rows=np.zeros(0, np.int32), points_px=np.zeros((0, 2), np.float32))
        if not self._parameters.reacquisition.enabled:
            return T_world_camera, none
        grid = MaximaGrid.build(tracks.maxima, self._camera.width, self._camera.height)
        reacquired = reacquire(
            T_world_camera,
            active.missing(frame),
            points.xyz,
            points.kappas,
            points.patches,
            grid,
            grey,
            self._camera,
            self._parameters.reacquisition,
        )
        found = active.take_over(reacquired, tracks)
        rows, points_px = active.observed(tracks.points_px, found)
        located = refine(
            T_world_camera,
            points.xyz[rows],
            points_px,
            self._camera,
            self._parameters.localisation,
            near=True,
        )
        linked = active.linked(MAPPED)
        points.kappas[active.links.rows[linked]] = tracks.kappas[linked]
        return located.T_world_camera, found

    def _adjust(
        self, active: ActiveMap, T_world_camera: F64, found: Observations, tracks: FrameTracks
    ) -> tuple[F64, int]:
        """Eq. 6 over the window and this frame.  Returns its pose and the number of inliers."""
        limits = self._parameters.localisation
        linked = active.linked(MAPPED)
        errors = reprojection_errors(
            T_world_camera,
            self._points.xyz[active.links.rows[linked]],
            tracks.points_px[linked],
            self._camera,
        )
        active.judge_tracks(linked, errors)
        active.see(T_world_camera, tracks.points_px, found)
        if self._parameters.window.sweeps > 0:
            T_world_camera = active.window.sweep_current(self._camera, self._parameters)
        rows, points_px = active.observed(tracks.points_px, found)
        errors = reprojection_errors(
            T_world_camera, self._points.xyz[rows], points_px, self._camera
        )
        return T_world_camera, int((errors < limits.inlier_px).sum())

    def _keyframe_is_due(self, active: ActiveMap) -> bool:
        limits = self._parameters.keyframe
        share, flow = active.window.flow_since_keyframe()
        unit = self._camera.width / 640.0
        if share < limits.min_shared_share or flow > limits.max_flow_px * unit:
            return True
        return self._since_keyframe >= limits.max_frames and flow > limits.min_flow_px * unit

    def _publish(
        self,
        state: int,
        reason: str,
        inliers: int,
        snapshot: bool = False,
        whole: bool = False,
    ) -> MapDelta:
        # Now and then everything active is published, for those who came late.
        self._timer = no_stages  # the frame is done: nothing of its caller stays with the map
        self._published_frames += 1
        snapshot = snapshot or self._published_frames % self._parameters.snapshot_frames == 0
        active = self._map
        if active is None:
            keyframes: list[Keyframe] = []
            rows, centre = np.zeros(0, np.int32), np.zeros(3)
        else:
            keyframes = active.keyframes if whole else active.window.keyframes
            # Between keyframes only points that the frame sees can move or be new.
            everything = snapshot or self._since_keyframe <= 1
            rows = active.window.rows if everything else active.window.current_rows()
            if whole:
                rows = active.mapped_rows()
            centre = active.keyframes[-1].T_world_camera[:3, 3].copy()
            self._changes.remove_points(active.take_removed())
        return self._changes.publish(
            state=state,
            reason=reason,
            segment=self._segments - 1,
            inliers=inliers,
            keyframes=keyframes,
            points=self._points,
            rows=rows,
            centre=centre,
            snapshot=snapshot,
        )
