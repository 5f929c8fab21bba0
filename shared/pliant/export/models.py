"""Exports for other programs: Foxglove, Rerun, point clouds."""

from pathlib import Path

import numpy as np

from pliant.datasets.recorded_images import RecordedImages
from pliant.errors import ResultError
from pliant.export.crop import Box, cropped_mesh, rows_in
from pliant.export.images import camera_of
from pliant.export.watertight import watertight
from pliant.formats.ply import write_ply
from pliant.map_history import Points
from pliant.messages import topics
from pliant.messages.types import SourceImage
from pliant.open3d_library import load_open3d
from pliant.recording.reader import Recording
from pliant.results.mesh_files import mesh_of, read_mesh, write_mesh
from pliant.results.run import read_run
from pliant.viewers.canvas import Canvas
from pliant.viewers.drawn_scene import Scene
from pliant.viewers.foxglove import FoxgloveFile
from pliant.viewers.rerun import RerunCanvas

MESH_NAME = "mesh.ply"


def draw(recording: Recording, canvas: Canvas, mesh: Path | None = None) -> None:
    """Draw a whole recording in file order; memory holds one message and the map."""
    scene = Scene(canvas)
    scene.take(topics.STREAM, camera_of(recording), 0, 0)  # images may have been recorded before it
    images = RecordedImages(recording)
    for recorded in recording.messages():
        message = recorded.decode()
        if isinstance(message, SourceImage):
            message = images.whole(message)
        scene.take(recorded.topic, message, recorded.sequence, recorded.log_time_ns)
    scene.close()
    if mesh is not None and mesh.is_file() and not scene.mesh.is_final:
        surface = read_mesh(mesh)
        if surface is not None:
            scene.mesh.show(scene.last, surface)


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


def ply(recording: Recording, path: Path, folder: Path | None, crop: Box | None = None) -> None:
    """The points of the longest segment.  crop: only points in this box."""
    history = read_run(recording.path).history
    points = history.points_in(history.longest_segment())
    if not len(points):
        raise ResultError(f"{recording.path}: the run has no map to export")
    write_points(path, points.select(rows_in(crop, points.positions)))


def solid(recording: Recording, path: Path, folder: Path | None, crop: Box | None = None) -> None:
    """The fine mesh of the longest segment, closed to a solid.  crop: what lies in this box."""
    load_open3d()  # said before the work
    run = read_run(recording.path)
    mesh = mesh_of(run.mesh, run.history.longest_segment())
    if mesh is None or not len(mesh.triangles):
        raise ResultError(f"{recording.path}: has no mesh: run its source again")
    write_mesh(path, watertight(cropped_mesh(mesh, crop)))


def write_points(path: Path, points: Points) -> None:
    """Points of a map with their colours."""
    colours = np.asarray(points.colours, np.uint8).reshape(-1, 3)
    write_ply(path, np.asarray(points.positions, np.float32), colours)
