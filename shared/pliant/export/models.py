"""Exports that other programs go on with: Foxglove, Rerun, COLMAP, images, clouds."""

from collections.abc import Iterator
from pathlib import Path

import cv2
import numpy as np

from pliant.algorithms.arrays import U8
from pliant.algorithms.corrected_view import corrected_view
from pliant.algorithms.meshing.mesh_blocks import TriangleMesh
from pliant.datasets.base import BrokenFrame
from pliant.datasets.calibration import Calibration, calibration_from_yaml, calibration_yaml
from pliant.datasets.own_recording import recorded_frame
from pliant.datasets.rectifier import Rectifier
from pliant.errors import ResultError
from pliant.export.colmap import image_name, write_colmap_model
from pliant.formats.ply import read_ply, write_ply
from pliant.formats.text import format_seconds, write_bytes
from pliant.messages import topics
from pliant.messages.types import CameraStream, MapUpdate, SourceImage
from pliant.recording.reader import Recording
from pliant.results.run import read_run
from pliant.viewers.canvas import Canvas
from pliant.viewers.foxglove import FoxgloveFile
from pliant.viewers.rerun import RerunCanvas
from pliant.viewers.scene import Scene

MESH_NAME = "mesh.ply"


def draw(recording: Recording, canvas: Canvas, mesh: Path | None = None) -> None:
    """Draw a whole recording in file order; memory holds one message and the map."""
    scene = Scene(canvas)
    scene.take(topics.STREAM, camera_of(recording), 0, 0)  # images may have been recorded before it
    for recorded in recording.messages():
        message = recorded.decode()
        scene.take(recorded.topic, message, recorded.sequence, recorded.log_time_ns)
    scene.close()
    if mesh is not None and mesh.is_file() and not scene.mesh.is_final:
        surface = _surface_of(mesh)
        if surface is not None:
            scene.mesh.show(scene.last, surface)


def _surface_of(path: Path) -> TriangleMesh | None:
    """The mesh of a PLY file, None where it is a cloud of points."""
    data = read_ply(path)
    if data.faces is None:
        return None
    grey = np.full((len(data.points), 3), 200, np.uint8)
    return TriangleMesh(
        positions=data.points,
        normals=np.zeros_like(data.points) if data.normals is None else data.normals,
        colours=grey if data.colours is None else data.colours,
        triangles=data.faces,
    )


def foxglove(recording: Recording, path: Path, folder: Path | None) -> None:
    """MCAP with Foxglove's messages."""
    with FoxgloveFile(path) as file:
        draw(recording, file, folder / MESH_NAME if folder else None)


def rerun(recording: Recording, path: Path, folder: Path | None) -> None:
    """A Rerun recording."""
    canvas = RerunCanvas(path, name=path.stem)
    try:
        draw(recording, canvas, folder / MESH_NAME if folder else None)
    finally:
        canvas.close()


def colmap(recording: Recording, path: Path, folder: Path | None) -> None:
    """``sparse/0`` with the text model, ``images`` with the keyframes as its camera sees them."""
    stream = camera_of(recording)
    run = read_run(recording.path)
    view = corrected_view(stream.camera, run.correction_of(run.history.longest_segment()))
    model = path / "sparse" / "0"
    make_folder(model)
    frames = set(write_colmap_model(recording, view, run.history, model))
    make_folder(path / "images")
    for frame, _, pixels in rectified_images(recording, stream):
        if frame in frames:
            write_png(path / "images" / image_name(frame), view.image(pixels))


def images(recording: Recording, path: Path, folder: Path | None) -> None:
    """A folder that ``pliant run`` opens: rectified PNG, ``rgb.txt`` and ``calib.yaml``.

    As the camera sees that the last adjustment found, if there was one.
    """
    stream = camera_of(recording)
    view = corrected_view(stream.camera, _correction(recording))
    make_folder(path / "images")
    lines = ["# seconds file"]
    for frame, stamp_ns, pixels in rectified_images(recording, stream):
        write_png(path / "images" / image_name(frame), view.image(pixels))
        lines.append(f"{format_seconds(stamp_ns)} images/{image_name(frame)}")
    camera = view.camera
    pinhole = Calibration(
        model="pinhole", width=camera.width, height=camera.height,
        fx=camera.fx, fy=camera.fy, cx=camera.cx, cy=camera.cy,
    )  # fmt: skip
    write_bytes(path / "calib.yaml", calibration_yaml(pinhole).encode())
    write_bytes(path / "rgb.txt", "".join(f"{line}\n" for line in lines).encode())


def ply(recording: Recording, path: Path, folder: Path | None) -> None:
    """The points of the longest segment."""
    history = read_run(recording.path).history
    points = history.points_in(history.longest_segment())
    if not len(points):
        raise ResultError(f"{recording.path}: the run has no map to export")
    colours = np.asarray(points.colours, np.uint8).reshape(-1, 3)
    write_ply(path, np.asarray(points.positions, np.float32), colours)


def _correction(recording: Recording) -> tuple[float, ...]:
    for final in recording.decoded(topics.MAP_FINAL):
        assert isinstance(final, MapUpdate)
        return final.calibration_correction
    return ()


def camera_of(recording: Recording) -> CameraStream:
    """The camera of a recording.  Raises ResultError where it stopped before its first frame."""
    for message in recording.decoded(topics.STREAM):
        assert isinstance(message, CameraStream)
        return message
    raise ResultError("the recording has no camera: it stopped before its first frame")


def rectified_images(recording: Recording, stream: CameraStream) -> Iterator[tuple[int, int, U8]]:
    """Number, time and pixels (grey or RGB) of each frame that has some, one after the other.

    Raises ResultError where the recording has no images.
    """
    rectifier = Rectifier(calibration_from_yaml(stream.calibration))
    found = False
    for source in recording.decoded(topics.SOURCE):
        assert isinstance(source, SourceImage)
        found = True
        try:
            grey, colour = rectifier.rectify(recorded_frame(source))
        except BrokenFrame:
            continue
        yield source.frame, source.stamp_ns, grey if colour is None else colour
    if not found:
        raise ResultError("the recording has no images (--no-images): run its source again")


def make_folder(folder: Path) -> None:
    """Make a folder and those above it.  Raises ResultError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultError(f"{folder}: cannot be made ({error.strerror})") from None


def write_png(path: Path, pixels: U8) -> None:
    """Write (H, W) grey or (H, W, 3) RGB, losslessly."""
    bgr = pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[:, :, ::-1])
    _, data = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    write_bytes(path, data.tobytes())
