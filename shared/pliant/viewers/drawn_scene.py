"""The conversion from messages to drawings, shared by the live viewer and the exporters.

Messages of one topic come in order; topics need not be synchronous.  Some may be missing: a viewer
gives no credit, and a slow one receives only the newest.
"""

from dataclasses import dataclass, field

import cv2
import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import matrix_to_pose, move_by_similarity, pose_to_matrix
from pliant.algorithms.map_delta import MapMoves
from pliant.algorithms.slam.calibration.corrected_view import corrected_view
from pliant.datasets.base import BrokenFrame, SourceFrame
from pliant.datasets.calibration import calibration_from_yaml
from pliant.datasets.own_recording import recorded_frame
from pliant.datasets.rectifier import Rectifier
from pliant.messages import topics
from pliant.messages.topics import Topic
from pliant.messages.types import (
    CameraStream,
    Extrema,
    Header,
    MapUpdate,
    MeshPiece,
    MeshUpdate,
    SourceImage,
    Status,
    Surfels,
)
from pliant.pictures.masked import dimmed_by
from pliant.viewers.canvas import Canvas, Moment
from pliant.viewers.point_blocks import PointBlocks
from pliant.viewers.rates import Rates
from pliant.viewers.scene_mesh import SceneMesh
from pliant.viewers.scene_surfels import SceneSurfels

REDRAW_FRAMES = 10
"""Points are drawn again this often; in between they hardly move."""
_JPEG_QUALITY = 90
_EXIF_WITHIN = 1 << 16


@dataclass
class _World:
    """A segment of the map."""

    segment: int = -1
    points: PointBlocks = field(default_factory=PointBlocks)
    keyframes: dict[int, tuple[int, F64]] = field(default_factory=dict[int, tuple[int, F64]])
    same_places: set[tuple[int, int]] = field(default_factory=set[tuple[int, int]])
    moved: bool = False


class Scene:
    """Draws a run on a canvas, message by message."""

    def __init__(self, canvas: Canvas) -> None:
        self._canvas = canvas
        self._rectifier: Rectifier | None = None
        self._camera: PinholeCamera | None = None
        self._world = _World()
        self._worlds: dict[int, _World] = {}
        self._expected = 0
        self._drawn = -REDRAW_FRAMES
        self._last = Moment(0, 0)
        self._entered = 0
        self._rates = Rates()
        self._reported: dict[str, int] = {}
        self.mesh = SceneMesh(canvas)
        """The final mesh of a result may be shown by it, where the messages brought none."""
        self._surfels = SceneSurfels(canvas)
        self.missed_updates = 0

    def take(self, topic: Topic, message: Header, sequence: int, arrived_ns: int) -> None:
        """Draw a message.

        sequence: its number in its topic, which shows what was missed.    arrived_ns: when it came,
        by whatever clock: rates are measured by it.
        """
        at = Moment(message.frame, message.stamp_ns)
        if isinstance(message, CameraStream):
            self._begin(at, message)
        elif isinstance(message, SourceImage):
            self._entered = max(self._entered, message.frame)
            self._draw_image(at, recorded_frame(message))
        elif isinstance(message, Extrema):
            self._canvas.tracks(at, message.points_px, message.ages)
        elif isinstance(message, MapUpdate):
            self._take_update(at, message, sequence, final=topic.key == topics.MAP_FINAL.key)
        elif isinstance(message, MeshUpdate):
            self.mesh.take_blocks(at, message)
        elif isinstance(message, MeshPiece):
            self.mesh.take_piece(at, message)
        elif isinstance(message, Surfels):
            self._surfels.take(at, message)
        elif isinstance(message, Status):
            self._take_status(at, message, arrived_ns)

    def close(self) -> None:
        """Draw what is left: the whole map, now that nothing more can come."""
        if self._world.segment >= 0:
            self._draw_map(self._last)
            self._canvas.whole_map(self._last, self._world.segment, self._world.points)

    @property
    def last(self) -> Moment:
        """The last moment of the map."""
        return self._last

    def _begin(self, at: Moment, stream: CameraStream) -> None:
        if self._rectifier is None:  # repeated for late viewers
            self._rectifier = Rectifier(calibration_from_yaml(stream.calibration))
            self._camera = stream.camera
            self._canvas.camera(at, stream.camera)
            if stream.z_is_up:
                self._canvas.level()
            self._surfels.camera = stream.camera

    def _draw_image(self, at: Moment, frame: SourceFrame) -> None:
        if self._rectifier is None or frame.dropped:
            return
        dims = frame.mask and self._canvas.dims_masks
        if self._rectifier.changes_nothing and _shows_as_it_is(frame) and not dims:
            self._canvas.image(at, frame.data, frame.encoding)
            return
        try:
            grey, colour = self._rectifier.rectify(frame)
            mask = self._rectifier.mask(frame) if dims else b""
        except BrokenFrame:
            return
        shown = dimmed_by(grey if colour is None else colour, mask)
        bgr = shown if colour is None else np.ascontiguousarray(shown[:, :, ::-1])
        _, data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
        self._canvas.image(at, data.tobytes(), "jpeg")

    def _take_update(self, at: Moment, update: MapUpdate, sequence: int, *, final: bool) -> None:
        if not final:
            self._notice_gap(at, sequence)
        self._last = at
        if len(update.moved_keyframes):
            for segment in {self._world.segment: 0} | dict(update.joined.tolist()):
                if segment in self._worlds:
                    self._move(self._worlds[segment], update.map_moves())
        for gone, segment in update.joined.tolist():
            self._join(at, gone, segment)
        world = self._world
        if update.segment not in (-1, world.segment):
            world = self._enter(at, update.segment)
        mine = update.keyframe_segments == world.segment
        for row in np.flatnonzero(mine):
            frame, pose = int(update.keyframe_frames[row]), update.keyframe_poses[row]
            world.keyframes[int(update.keyframe_ids[row])] = (frame, pose)
        world.moved = world.moved or bool(mine.any())
        self._take_places(at, update, final=final)
        here = update.point_segments == world.segment
        world.points.update(
            update.point_ids[here],
            update.points_world[here].astype(np.float32),
            update.point_colours[here],
            update.hosts()[here],
            update.removed_point_ids,
            snapshot=update.snapshot,
        )
        self._draw_pose(at, update)
        if update.calibration_correction and self._camera is not None:
            view = corrected_view(self._camera, update.calibration_correction)
            self._canvas.camera(at, view.camera, view.lens)
        if final or at.frame - self._drawn >= REDRAW_FRAMES:
            self._draw_map(at)

    def _enter(self, at: Moment, segment: int) -> _World:
        """Begin a new world, or continue an earlier one; the one before is no longer drawn."""
        before = self._world
        if before.segment >= 0:
            self._draw_map(at)
            self._canvas.whole_map(at, before.segment, before.points)
            self.mesh.begin(at, segment)
            self._canvas.forget(at, before.segment)
        world = self._world = self._worlds.setdefault(segment, _World(segment=segment))
        world.points.draw_again()
        world.moved = bool(world.keyframes)
        self._drawn = at.frame - REDRAW_FRAMES
        return world

    def _join(self, at: Moment, gone: int, segment: int) -> None:
        """Move the drawings of a world that has been joined into the other one."""
        old = self._worlds.pop(gone, _World())
        world = self._worlds.setdefault(segment, _World(segment=segment))
        world.keyframes |= old.keyframes
        world.same_places |= old.same_places
        world.points.take_in(old.points)
        world.moved = True
        if self._world is old:
            self.mesh.begin(at, segment)
            self._canvas.forget(at, gone)
            self._world = world
            world.points.draw_again()

    def _move(self, world: _World, moves: MapMoves) -> None:
        """A world moves: keyframes, and points with those on which they hang."""
        ids = np.array(list(world.keyframes), np.int64)
        poses = np.array([pose for _, pose in world.keyframes.values()]).reshape(-1, 7)
        moved = matrix_to_pose(move_by_similarity(moves.matrices(ids), pose_to_matrix(poses)))
        for keyframe, pose in zip(ids.tolist(), moved, strict=True):
            world.keyframes[keyframe] = (world.keyframes[keyframe][0], pose)
        world.points.move(moves)
        world.moved = True

    def _notice_gap(self, at: Moment, sequence: int) -> None:
        missed, self._expected = sequence - self._expected, sequence + 1
        if missed > 0:
            self.missed_updates += missed
            self._world.points.miss()
            what = "began late" if self.missed_updates == sequence else "was too slow"
            self._canvas.note(
                at,
                f"the viewer {what}: {missed} updates of the map are missing before frame "
                f"{at.frame}; points appear when they are sent again, at the latest with the next "
                "snapshot of the window",
            )

    def _take_places(self, at: Moment, update: MapUpdate, *, final: bool) -> None:
        """Log the recognised places; lines between the keyframes are drawn with the map."""
        world = self._world
        new = set(update.keyframe_ids[update.keyframe_frames == at.frame].tolist())
        for pair in update.same_places.tolist():
            before, now = pair
            if (before, now) in world.same_places:
                continue  # what joined two segments is a loop of the one that they are
            here = f"frame {at.frame}"
            if now >= 0:
                world.same_places.add((before, now))
                world.moved = True
                here = _named(world, now)
            what = "loop closed"
            if now < 0 or (now in new and not final):
                what = "recognised"
            if len(update.joined):
                what = f"segment {update.joined[0, 0]} joined to {update.joined[0, 1]}"
            self._canvas.note(at, f"{what}: {here} shows the place of {_named(world, before)}")

    def _draw_pose(self, at: Moment, update: MapUpdate) -> None:
        rows = np.flatnonzero(update.pose_frames == at.frame)
        if not rows.size:
            return
        keyframe = self._world.keyframes.get(int(update.pose_keyframes[rows[0]]))
        if keyframe is None:  # published before this viewer came
            return
        T_world_camera = pose_to_matrix(keyframe[1]) @ pose_to_matrix(
            update.poses_keyframe_camera[rows[0]]
        )
        self._canvas.pose(at, self._world.segment, matrix_to_pose(T_world_camera))

    def _draw_map(self, at: Moment) -> None:
        world = self._world
        if world.segment < 0:
            return
        self._drawn = at.frame
        changed = world.points.take_changed()
        if changed:
            self._canvas.points(at, world.segment, world.points, changed)
        if world.moved:
            world.moved = False
            ordered = sorted(world.keyframes.values(), key=lambda keyframe: keyframe[0])
            positions = np.array([pose[:3] for _, pose in ordered])
            self._canvas.path(at, world.segment, positions)
            known, of = world.keyframes, world.same_places
            lines = [
                [known[a][1][:3], known[b][1][:3]] for a, b in sorted(of) if {a, b} <= known.keys()
            ]
            if lines:
                self._canvas.places(at, world.segment, np.array(lines))

    def _take_status(self, at: Moment, status: Status, arrived_ns: int) -> None:
        is_new = status.frame > self._reported.get(status.service, -1)
        self._reported[status.service] = status.frame
        if is_new:  # else it is the service's last word: what it did after the last frame
            for stage, seconds in zip(status.stages, status.seconds.tolist(), strict=True):
                self._canvas.measure(at, f"stages/{status.service}/{stage}", 1e3 * seconds)
            self._canvas.measure(
                at, f"milliseconds/{status.service}", 1e3 * float(status.seconds.sum())
            )
        self._canvas.measure(
            at, f"lag/{status.service}", float(max(0, self._entered - status.frame))
        )
        rate = self._rates.take(status.service, status.frame, arrived_ns)
        if rate is not None:
            self._canvas.measure(at, f"rate/{status.service}", rate)
        if status.note:
            self._canvas.note(at, f"{status.service}: {status.note}")


def _named(world: _World, keyframe: int) -> str:
    """A keyframe by its frame, where that is known and of this session."""
    frame = world.keyframes.get(keyframe, (-1, None))[0]
    return f"frame {frame}" if frame >= 0 else f"keyframe {keyframe}"


def _shows_as_it_is(frame: SourceFrame) -> bool:
    """Whether every viewer shows the file as our decoder does: 8 bits, not to be turned."""
    if frame.encoding == "png":
        return frame.data[24:25] == b"\x08"
    return frame.encoding == "jpeg" and b"Exif" not in frame.data[:_EXIF_WITHIN]
