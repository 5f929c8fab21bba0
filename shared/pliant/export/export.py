"""Behind ``pliant export``: what a result folder becomes for other programs and for the eye."""

import shutil
from collections.abc import Callable, Container, Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.map_delta import LOST, TRACKING, WAITING
from pliant.errors import ResultError
from pliant.export.colmap import colmap
from pliant.export.depth import depth
from pliant.export.images import camera_of, images, rectified_images
from pliant.export.models import foxglove, ply, rerun
from pliant.export.nerfstudio import nerfstudio
from pliant.export.surface import overlay_pictures, surfaces
from pliant.export.textured import glb, obj
from pliant.formats.euroc import write_euroc
from pliant.formats.kitti import write_kitti
from pliant.formats.tum import write_tum
from pliant.map_history import MapHistory, Points
from pliant.messages import topics
from pliant.messages.topics import Topic
from pliant.messages.types import CameraStream, Extrema, MapUpdate
from pliant.pictures.map import choose_view, render_map, write_map_picture
from pliant.pictures.movie import beside, write_animation, write_movie
from pliant.pictures.overlay import OverlayFrame, TrackPainter, write_overlay_video
from pliant.recording.parts import parts_in
from pliant.recording.reader import Recorded, Recording
from pliant.results.folder import RECORDING_NAME, files_read, keep_apart
from pliant.results.run import read_run
from pliant.results.scale import MetricRecording
from pliant.results.surfels import has_surfels, surfel_trajectory
from pliant.trajectory import Trajectory

_OVERVIEW_FRAMES = 40
_OVERVIEW_WIDTH = 960
_OVERVIEW_FPS = 10.0


Export = Callable[..., None]
"""Writes to a path what a recording holds: the recording, the path, the folder if it is that of a
result, and options of its own."""

Progress = Callable[[int, int], None]
"""Is told how much is done, of how much; less than 1: nobody knows."""


@dataclass(frozen=True)
class RecordedFrame:
    """One frame of a recording with what became of it.  image: None where it has no pixels."""

    image: U8 | None
    tracks: Extrema
    update: MapUpdate


def export_result(
    result: Path, to: str, output: Path | None, *, force: bool = False,
    every: int | None = None, triangles: int | None = None, progress: Progress | None = None,
) -> Path:  # fmt: skip
    """Write one export of a result folder or a recording and return where.

    every: of surfaces, which frames.    triangles: most of a textured mesh.
    progress: is told how many images have been read, and of how many.

    Raises ResultError for an unknown kind, and for what is there already unless ``force``.
    """
    if to not in EXPORTS:
        raise ResultError(f"--to {to}: choose {', '.join(EXPORTS)}")
    options = {"every": every, "triangles": triangles}
    given = {name: value for name, value in options.items() if value is not None}
    for option in given:
        if to not in _OPTIONS[option]:
            has = " and ".join(_OPTIONS[option])
            raise ResultError(f"--{option}: {to} has no such option, only {has}")
    if not result.exists():
        raise ResultError(f"{result}: no such result folder or recording")
    folder = result if result.is_dir() and not parts_in(result) else None
    recording = _Followed(result / RECORDING_NAME if folder is not None else result, progress)
    name, write = EXPORTS[to]
    path = output or (result / name if folder is not None else _beside(result, name))
    keep_apart(path, files_read(result))
    if path.exists() and not force:
        raise ResultError(f"{path} exists: choose another --output, or --force to replace it")
    fresh = not path.exists()
    try:
        write(recording, path, folder, **given)
    except BaseException:  # Ctrl-C, too: half an export is none
        if fresh:
            _remove(path)
        raise
    return path


class _Followed(MetricRecording):
    """A recording that tells how many of its images have been read: they take the time."""

    def __init__(self, path: Path, progress: Progress | None) -> None:
        super().__init__(path)
        self._progress = progress

    def messages(self, *topics_: Topic) -> Iterator[Recorded]:
        """As of a recording."""
        with_images = not topics_ or topics.SOURCE in topics_
        frames = camera_of(self).frames if with_images else 0
        for recorded in super().messages(*topics_):
            if self._progress is not None and recorded.topic == topics.SOURCE:
                self._progress(recorded.sequence + 1, frames)
            yield recorded


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        with suppress(OSError):
            path.unlink()


def _beside(recording: Path, name: str) -> Path:
    """Beside a recording, an export is called after it."""
    return recording.with_name(f"{recording.stem}_{name}")


def recorded_frames(
    recording: Recording, wanted: Container[int] | None = None
) -> Iterator[RecordedFrame]:
    """The frames of a recording, their images rectified again from their source bytes.

    wanted: numbers of those whose image is; None: all.
    """
    images = rectified_images(recording, camera_of(recording), wanted)
    others = zip(
        recording.decoded(topics.EXTREMA),
        recording.decoded(topics.MAP_UPDATE),
        strict=False,  # a recording that was cut off ends where its shortest topic ends
    )
    at, pixels = -1, None
    for tracks, update in others:
        assert isinstance(tracks, Extrema)
        assert isinstance(update, MapUpdate)
        while at < tracks.frame:
            at, _, pixels = next(images, (tracks.frame, 0, None))
        yield RecordedFrame(pixels if at == tracks.frame else None, tracks, update)


def _overlay(recording: Recording, path: Path, folder: Path | None) -> None:
    if has_surfels(recording.path):
        fps = _frames_per_second(recording, topics.SURFELS)
        write_movie(path, overlay_pictures(recording), fps=fps)
        return
    stream = camera_of(recording)
    drawn = (_overlay_frame(frame, stream) for frame in recorded_frames(recording))
    frames = (frame for frame in drawn if frame is not None)
    write_overlay_video(path, frames, fps=_frames_per_second(recording), scale=1)


def _picture(recording: Recording, path: Path, folder: Path | None) -> None:
    points, T_world_camera = _longest_segment(read_run(recording.path).history)
    if not len(T_world_camera):
        raise ResultError(f"{recording.path}: the run has no map to draw")
    write_map_picture(path, points.positions, points.colours, T_world_camera)


def _overview(recording: Recording, path: Path, folder: Path | None) -> None:
    """Tracks on the image beside the map that grows: the moving picture of the README."""
    run = read_run(recording.path)
    stream = run.stream
    last, final = _longest_segment(run.history)
    if stream is None or not len(final):
        raise ResultError(f"{recording.path}: the run has no map to draw")
    view = choose_view(last.positions, final)
    every = max(1, len(run.tracks) // _OVERVIEW_FRAMES)
    painter, history, pictures = TrackPainter(scale=2), MapHistory(), list[U8]()
    for frame in recorded_frames(recording, range(0, len(run.tracks), every)):
        update = frame.update
        history.apply(update, frame=update.frame, stamp_ns=update.stamp_ns)
        shown = _overlay_frame(frame, stream)
        if shown is None:
            painter.follow(frame.tracks)
            continue
        points, poses = _longest_segment(history)
        right = render_map(points.positions, points.colours, poses, view=view)
        pictures.append(beside(painter.draw(shown), right))
    write_animation(path, pictures, fps=_OVERVIEW_FPS, width=_OVERVIEW_WIDTH)


def _longest_segment(history: MapHistory) -> tuple[Points, F64]:
    """Points and (N, 4, 4) poses of one map segment: those of others lie in worlds of their own."""
    longest = history.longest_segment()
    path = history.trajectory_in(longest, history.final())
    return history.points_in(longest), path.T_world_camera


def _overlay_frame(frame: RecordedFrame, stream: CameraStream) -> OverlayFrame | None:
    if frame.image is None:
        return None
    update = frame.update
    words = {WAITING: "starting", TRACKING: "tracking", LOST: "lost"}[update.state]
    detail = f"{update.inliers} mapped" if update.state == TRACKING else update.reason
    return OverlayFrame(
        image=frame.image,
        tracks=frame.tracks,
        number=update.frame,
        status=f"{stream.source}  {words}  {detail}",
    )


def _poses(write: Callable[[Path, Trajectory], None]) -> Export:
    """Writes the final poses of the longest segment in one of the formats of trajectories."""

    def export(recording: Recording, path: Path, folder: Path | None) -> None:
        poses = _final_poses(recording)
        if not len(poses.stamps_ns):
            raise ResultError(f"{recording.path}: the run has no poses to export")
        write(path, poses)

    return export


def _final_poses(recording: Recording) -> Trajectory:
    if has_surfels(recording.path):
        return surfel_trajectory(recording.path)
    history = read_run(recording.path).history
    longest = history.longest_segment()
    return history.trajectory({f: p for f, p in history.final().items() if p[0] == longest})


def _frames_per_second(recording: Recording, topic: Topic = topics.EXTREMA) -> float:
    stamps = [m.stamp_ns for m in recording.decoded(topic)]
    steps = np.diff(stamps)
    return float(1e9 / np.median(steps)) if len(steps) and np.median(steps) > 0 else 30.0


EXPORTS: dict[str, tuple[str, Export]] = {
    "foxglove": ("foxglove.mcap", foxglove),
    "rerun": ("rerun.rrd", rerun),
    "tum": ("trajectory_tum.txt", _poses(write_tum)),
    "kitti": ("trajectory_kitti.txt", _poses(write_kitti)),
    "euroc": ("trajectory_euroc.csv", _poses(write_euroc)),
    "ply": ("points_longest.ply", ply),
    "colmap": ("colmap", colmap),
    "nerfstudio": ("nerfstudio", nerfstudio),
    "depth": ("depth", depth),
    "images": ("images", images),
    "glb": ("mesh.glb", glb),
    "obj": ("obj", obj),
    "surface": ("surface", surfaces),
    "overlay": ("overlay.mp4", _overlay),
    "picture": ("picture.png", _picture),
    "overview": ("overview.webp", _overview),
}
"""Kind of export: its default name, and who writes it."""
_OPTIONS = {"every": ("surface",), "triangles": ("glb", "obj")}
"""Which kinds have an option."""
