"""Behind ``pliant export``: results for other programs and as pictures."""

from collections.abc import Callable, Container, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import U8
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.map_delta import LOST, TRACKING, WAITING
from pliant.errors import PliantError, ResultError
from pliant.export.animation import animation
from pliant.export.colmap import colmap
from pliant.export.crop import Box
from pliant.export.depth import depth
from pliant.export.images import camera_of, images, rectified_images
from pliant.export.kinds import KINDS, OF_STILL_SCENES, OPTIONS
from pliant.export.models import foxglove, ply, rerun, solid
from pliant.export.nerfstudio import nerfstudio
from pliant.export.on_earth import geojson, gpx, las
from pliant.export.overview import (
    FPS,
    FRAMES,
    Layout,
    Made,
    ShownFrame,
    longest_segment,
    overview_pictures,
    still_picture,
)
from pliant.export.splat import splat
from pliant.export.strain_maps import strain_maps
from pliant.export.surface_meshes import overlay_pictures, surfaces
from pliant.export.surfel_tracks import surfel_tracks
from pliant.export.textured import glb, obj
from pliant.files import is_stream, make_folder
from pliant.formats.euroc import write_euroc
from pliant.formats.kitti import write_kitti
from pliant.formats.tum import write_tum
from pliant.messages import topics
from pliant.messages.topics import Topic
from pliant.messages.types import CameraStream, Extrema, MapUpdate
from pliant.pictures.map import choose_view
from pliant.pictures.masked import dimmed
from pliant.pictures.movie import animation_suffix, write_animation, write_image, write_movie
from pliant.pictures.overlay import OverlayFrame, write_overlay_video
from pliant.recording.parts import parts_in
from pliant.recording.reader import Recorded, Recording
from pliant.results.folder import RECORDING_NAME, check_free, files_read, keep_apart
from pliant.results.known_scale import MetricRecording
from pliant.results.mesh_files import mesh_of
from pliant.results.run import Run, read_run
from pliant.results.surfel_frames import has_surfels
from pliant.results.surfels import surfel_trajectory
from pliant.staging import put_tree_in_place, staging
from pliant.trajectory import Trajectory

_QUALITY = 60
"""Quality of the overview: 300 frames stay below 3 MB."""

Export = Callable[..., None]
"""Writes to a path what a recording holds: the recording, the path, the folder if it is that of a
result, and options of its own."""

Progress = Callable[[int, int], None]
"""Called with the amount done, and of how much; less than 1: unknown."""


@dataclass(frozen=True)
class RecordedFrame:
    """One frame of a recording with what became of it.

    image: None if it has no pixels; dark where a mask has it ignored.
    """

    image: U8 | None
    tracks: Extrema
    update: MapUpdate


def export_result(
    result: Path, to: str, output: Path | None, *, force: bool = False,
    every: int | None = None, triangles: int | None = None, clean: bool = False,
    observed: bool = False, crop: Box | None = None, progress: Progress | None = None,
) -> Path:  # fmt: skip
    """Write one export of a result folder or a recording and return where.

    every: which frames of a deforming surface.    triangles: most of a textured mesh.
    clean: leave out its small pieces.    observed: leave out its closed holes.
    crop: only the surface or the points in this box.
    progress: called with the number of images read, and of how many.

    Raises ResultError for an unknown kind, and for an existing output unless ``force``.
    """
    if to not in EXPORTS:
        raise ResultError(f"--to {to}: choose {', '.join(EXPORTS)}")
    options = {
        "every": every, "triangles": triangles, "clean": clean or None,
        "observed": observed or None, "crop": crop,
    }  # fmt: skip
    given = {name: value for name, value in options.items() if value is not None}
    for option in given:
        if to not in OPTIONS[option]:
            *others, last = OPTIONS[option]
            has = f"{', '.join(others)} and {last}" if others else last
            raise ResultError(f"--{option}: not available for {to}, only for {has}")
    if not result.exists():
        raise ResultError(f"{result}: no such result folder or recording")
    folder = result if result.is_dir() and not parts_in(result) else None
    recording = _Followed(result / RECORDING_NAME if folder is not None else result, progress)
    name, write = EXPORTS[to]
    path = output or (result / name if folder is not None else _beside(result, name))
    keep_apart(path, files_read(result))
    _check_ending(path, to, name)
    if path.exists() and not force:
        raise ResultError(f"{path} exists: choose another --output, or --force to replace it")
    check_free(path, path.parent)
    if is_stream(path):
        write(recording, path, folder, **given)
        return path
    try:
        if not Path(name).suffix:
            make_folder(path.parent)
        with staging(path.parent) as partial:
            made = partial / path.name
            try:
                write(recording, made, folder, **given)
            except PliantError as error:
                if to in OF_STILL_SCENES and has_surfels(recording.path):
                    raise ResultError(
                        f"--to {to} needs the map or mesh of a rigid scene, but {result} is "
                        "deforming: use --to surface for its meshes"
                    ) from None
                error.args = (str(error).replace(f"{made}", f"{path}"),)
                raise
            put_tree_in_place(made, path)
    except OSError as error:
        raise ResultError(f"{path}: cannot be written ({error.strerror})") from None
    return path


def exports_in(folder: Path, *, but: Container[str] = ()) -> list[str]:
    """Names of the exports in a result folder that are called as by default, but for some kinds."""
    names = (name for kind, (name, _) in EXPORTS.items() if kind not in but)
    return [name for name in names if (folder / name).exists()]


def _check_ending(path: Path, to: str, name: str) -> None:
    """Raise ResultError if others would take a file for another kind than it is.

    name: the default.  Pictures and videos have several, and are made in the format of the ending.
    """
    given, own = path.suffix.lower(), Path(name).suffix
    if to in _NAMED and given != own:
        raise ResultError(f"{path}: --to {to} writes a {own} file: use this ending")
    files = {Path(each).suffix for each, _ in EXPORTS.values()} | {".obj", ".zip"}
    if not own and given and given in files:
        raise ResultError(f"{path}: --to {to} writes a folder: leave out the ending {given}")


class _Followed(MetricRecording):
    """A recording that reports how many of its images have been read, which takes the time."""

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
    at, pixels, used = -1, None, None
    for tracks, update in others:
        assert isinstance(tracks, Extrema)
        assert isinstance(update, MapUpdate)
        while at < tracks.frame:
            at, _, pixels, used = next(images, (tracks.frame, 0, None, None))
        shown = dimmed(pixels, used) if pixels is not None and at == tracks.frame else None
        yield RecordedFrame(shown, tracks, update)


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
    """One frame with its tracks, where images were recorded, the points and the mesh."""
    run, stream, what = _made(recording)
    has_images = next(recording.messages(topics.SOURCE), None) is not None
    wanted = (_informative_frame(run, what),)
    frames = _shown_frames(recording, stream, wanted) if has_images else iter(())
    write_image(path, still_picture(frames, stream.camera, what))


def _overview(recording: Recording, path: Path, folder: Path | None) -> None:
    """The moving picture of the README."""
    animation_suffix(path)  # said before the work
    run, stream, what = _made(recording)
    wanted = range(0, len(run.tracks), -(-len(run.tracks) // FRAMES))
    layout = Layout(stream.camera.width, stream.camera.height)
    frames = _shown_frames(recording, stream, wanted)
    write_animation(path, list(overview_pictures(frames, layout, what)), fps=FPS, quality=_QUALITY)


def _informative_frame(run: Run, what: Made) -> int:
    """Of the frames that fit the map well, the one that looks at its centre."""
    final, longest = run.history.final(), run.history.longest_segment()
    frames = [frame for frame, (segment, _) in sorted(final.items()) if segment == longest]
    T_world_camera = pose_to_matrix(np.array([final[frame][1] for frame in frames]))
    to_centre = choose_view(what.points.positions, what.poses).centre - T_world_camera[:, :3, 3]
    cosines = (T_world_camera[:, :3, 2] * to_centre).sum(axis=1)
    cosines /= np.maximum(np.linalg.norm(to_centre, axis=1), 1e-9)
    inliers = np.array([run.inliers.get(frame, 0) for frame in frames])
    return frames[int(np.argmax(np.where(inliers >= np.median(inliers), cosines, -np.inf)))]


def _made(recording: Recording) -> tuple[Run, CameraStream, Made]:
    """Raises ResultError for a run without a map."""
    run = read_run(recording.path)
    points, poses = longest_segment(run.history)
    if run.stream is None or not len(poses):
        raise ResultError(f"{recording.path}: the run has no map to draw")
    mesh = mesh_of(run.mesh, run.history.longest_segment())
    mesh = mesh if mesh is not None and len(mesh.triangles) else None
    return run, run.stream, Made(run.stream.source, points, poses, mesh)


def _shown_frames(
    recording: Recording, stream: CameraStream, wanted: Container[int]
) -> Iterator[ShownFrame]:
    for frame in recorded_frames(recording, wanted):
        yield ShownFrame(frame.update, frame.tracks, _overlay_frame(frame, stream))


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
    return history.trajectory_in(longest, history.placed())


def _frames_per_second(recording: Recording, topic: Topic = topics.EXTREMA) -> float:
    stamps = [m.stamp_ns for m in recording.decoded(topic)]
    steps = np.diff(stamps)
    return float(1e9 / np.median(steps)) if len(steps) and np.median(steps) > 0 else 30.0


_WRITERS: dict[str, Export] = {
    "foxglove": foxglove,
    "rerun": rerun,
    "tum": _poses(write_tum),
    "kitti": _poses(write_kitti),
    "euroc": _poses(write_euroc),
    "gpx": gpx,
    "geojson": geojson,
    "las": las,
    "ply": ply,
    "colmap": colmap,
    "nerfstudio": nerfstudio,
    "splat": splat,
    "depth": depth,
    "images": images,
    "glb": glb,
    "obj": obj,
    "watertight": solid,
    "surface": surfaces,
    "animation": animation,
    "tracks": surfel_tracks,
    "strain": strain_maps,
    "overlay": _overlay,
    "picture": _picture,
    "overview": _overview,
}
EXPORTS = {kind: (name, _WRITERS[kind]) for kind, name in KINDS.items()}
"""Kind of export: its default name, and who writes it."""
_NAMED = ("foxglove", "rerun", "gpx", "geojson", "las", "ply", "glb", "watertight", "animation")
"""Kinds that other programs know by the ending; trajectories are text under any."""
