"""Deformable mapping: the map of the last seconds, for a scene that deforms before a moving camera.

in   camera/stream    once
     tracks/extrema   every frame
     map/update       every frame: the rigid map, from which each adjustment starts
out  map/deforming    one per frame: with landmarks about once a second, where they can be trusted,
                      and the camera of each frame since
"""

from dataclasses import dataclass, replace

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.deformable.deforming_window import DeformingWindow
from pliant.algorithms.deformable.moving_landmarks import WindowMap
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.map_delta import TRACKING
from pliant.algorithms.slam.calibration.corrected_view import corrected_view
from pliant.bus.base import Bus, join, receive, receive_one, resume
from pliant.config import Config
from pliant.map_history import MapHistory
from pliant.messages import topics
from pliant.messages.types import (
    WORLD_FRAME_ID,
    CameraStream,
    DeformingLandmarks,
    Extrema,
    MapUpdate,
)
from pliant_services.runtime.monitor import Monitor


@dataclass
class _State:
    """rigid: the map, with the frames of the window alone.    correction: of the calibration."""

    stream: CameraStream
    rigid: MapHistory
    window: DeformingWindow
    correction: tuple[float, ...] = ()


def run(bus: Bus, config: Config, monitor: Monitor) -> None:
    """Map until the tracks end."""

    def start() -> tuple[CameraStream, MapHistory, DeformingWindow]:
        return receive_one(bus, topics.STREAM, CameraStream), MapHistory(), DeformingWindow()

    state = _State(*resume(bus, start))
    pairs = join(receive(bus, topics.EXTREMA, Extrema), receive(bus, topics.MAP_UPDATE, MapUpdate))
    for tracks, update in pairs:
        found = _take(state, tracks, update, monitor)
        message = DeformingLandmarks.of(tracks, found, frame_id=WORLD_FRAME_ID)
        bus.publish(topics.MAP_DEFORMING, message)
        monitor.report(tracks, landmarks=len(found.ids))
        bus.checkpoint(tracks.frame, tuple(vars(state).values()))


def _take(state: _State, tracks: Extrema, update: MapUpdate, monitor: Monitor) -> WindowMap:
    state.rigid.apply(update, frame=tracks.frame, stamp_ns=tracks.stamp_ns)
    if state.stream.focal_sigma > 0.0 and update.calibration_correction:
        state.correction = update.calibration_correction
    if update.state != TRACKING:
        return WindowMap()
    view = corrected_view(state.stream.camera, state.correction)
    with monitor.stage("camera"):
        T = state.window.follow(tracks.ids, tracks.points_px, view)
    frame = np.zeros((0, 4, 4)) if T is None else T[None]
    due = state.window.take(
        tracks.frame, tracks.stamp_ns, tracks.ids, tracks.points_px, T,
        of_map=tracks.frame in update.keyframe_frames,
    )  # fmt: skip
    state.rigid.forget_before(state.window.keyframes[0].frame)
    if not due:
        return WindowMap(T_frame=frame)
    poses = {
        frame: pose_to_matrix(pose[None])[0]
        for frame, (segment, pose) in state.rigid.final().items()
        if segment == update.segment
    }
    with monitor.stage("adjustment"):
        return replace(state.window.adjust(poses, view), T_frame=frame)


def warm_up() -> None:
    """A window of a camera that moves before a sheet that waves."""
    camera = PinholeCamera(width=96, height=72, fx=90.0, fy=90.0, cx=47.5, cy=35.5)
    window, rigid = DeformingWindow(), dict[int, F64]()
    columns, rows = np.meshgrid(np.arange(12.0), np.arange(9.0))
    sheet = np.stack([columns - 5.5, rows - 4.0, np.zeros_like(rows)], axis=2).reshape(-1, 3) * 0.08
    sheet = np.repeat(sheet, 2, axis=0)  # one makes the map, the other judges it
    ids, due = np.arange(len(sheet), dtype=np.int64), False
    for frame in range(15):
        points = sheet + np.array([0.02 * frame, 0.0, 1.0])
        points[:, 2] += 0.02 * np.sin(frame + 8.0 * sheet[:, 0])
        points_px = camera.project(points).astype(np.float32)
        rigid[frame] = np.eye(4)
        rigid[frame][0, 3] = -0.02 * frame
        due = window.take(frame, 200_000_000 * frame, ids, points_px)
    assert due
    window.adjust(rigid, corrected_view(camera, ()))
