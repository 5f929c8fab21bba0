"""The longest segment on the Earth: its trajectory as GPX and GeoJSON, its surface as LAS."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.geometry import transform
from pliant.algorithms.inertial.geodesy import geodetic_of_enu
from pliant.algorithms.inertial.gps_fit import GpsFit
from pliant.errors import ResultError
from pliant.export.crop import Box, rows_in
from pliant.export.posed_images import PosedImage
from pliant.formats.earth_track import EarthTrack, write_geojson, write_gpx
from pliant.formats.las import load_las, write_las
from pliant.formats.text import write_lines
from pliant.recording.measured import fixes_of
from pliant.recording.reader import Recording
from pliant.results.earth import place_on_earth, summary_of
from pliant.results.mesh_files import mesh_of
from pliant.results.run import Run, read_run
from pliant.trajectory import Trajectory


def gpx(recording: Recording, path: Path, folder: Path | None) -> None:
    """The positions of the camera, a track point a frame."""
    write_gpx(path, _track(recording)[0])


def geojson(recording: Recording, path: Path, folder: Path | None) -> None:
    """The positions as a line, with what places the map: see ``docs/metric.md``."""
    track, fit = _track(recording)
    origin = fit.origin
    properties = {
        "enu_origin": [origin.latitude_deg, origin.longitude_deg, origin.altitude_m],
        "S_enu_world": fit.S_enu_world.tolist(),
        "metres_per_unit": fit.metres_per_unit,
        "scale_sigma": fit.scale_sigma,
        "orientation_sigma_rad": fit.turn_sigma_rad,
        "error_m": fit.error_m,
    }
    write_geojson(path, track, properties)


def las(recording: Recording, path: Path, folder: Path | None, crop: Box | None = None) -> None:
    """The vertices of the fine mesh, or the points of a run without one.

    crop: only what lies in this box.
    """
    load_las()  # said before the work
    run = read_run(recording.path)
    trajectory, fit = _placed(recording, run)
    positions, colours = _surface(run)
    if not len(positions):
        raise ResultError(f"{recording.path}: the run has no map to export")
    rows = rows_in(crop, positions)
    latitude, longitude, altitude = _geodetic(fit, positions[rows])
    write_las(
        path, latitude_deg=latitude, longitude_deg=longitude, altitude_m=altitude,
        colours=colours[rows], stamp_ns=int(trajectory.stamps_ns[0]),
    )  # fmt: skip


def write_geo_registration(
    recording: Recording, run: Run, path: Path, images: Sequence[PosedImage]
) -> None:
    """A line "NAME LATITUDE LONGITUDE ALTITUDE" for each image, as COLMAP's ``model_aligner`` reads
    them.  No file if no fixes place the map.
    """
    if not len(fixes_of(recording).stamps_ns):
        return
    try:
        _, fit = _placed(recording, run)
    except ResultError:
        return
    positions = np.array([image.T_world_camera[:3, 3] for image in images])
    rows = np.stack(_geodetic(fit, positions), axis=1).tolist()
    lines = [
        f"{image.name} {latitude:.9f} {longitude:.9f} {altitude:.4f}"
        for image, (latitude, longitude, altitude) in zip(images, rows, strict=True)
    ]
    write_lines(path, lines)


def _geodetic(fit: GpsFit, positions: F64) -> tuple[F64, F64, F64]:
    """Latitudes and longitudes in degrees and altitudes in metres of (N, 3) places of the map."""
    return geodetic_of_enu(transform(fit.S_enu_world, positions), fit.origin)


def _surface(run: Run) -> tuple[F64, U8]:
    """(N, 3) positions and colours."""
    longest = run.history.longest_segment()
    mesh = mesh_of(run.mesh, longest)
    if mesh is not None and len(mesh.positions):
        return np.asarray(mesh.positions, np.float64), mesh.colours
    points = run.history.points_in(longest)
    return points.positions, np.asarray(points.colours, np.uint8).reshape(-1, 3)


def _track(recording: Recording) -> tuple[EarthTrack, GpsFit]:
    """Raises ResultError if the run has no poses, or its source no fixes that place them."""
    trajectory, fit = _placed(recording, read_run(recording.path))
    latitude, longitude, altitude = _geodetic(fit, trajectory.positions)
    track = EarthTrack(
        stamps_ns=trajectory.stamps_ns,
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=altitude,
        about=f"Pliant: {summary_of(fit)}",
    )
    return track, fit


def _placed(recording: Recording, run: Run) -> tuple[Trajectory, GpsFit]:
    history = run.history
    trajectory = history.trajectory_in(history.longest_segment(), history.final())
    if not len(trajectory):
        raise ResultError(f"{recording.path}: the run has no poses to export")
    return trajectory, place_on_earth(recording, run, trajectory)
