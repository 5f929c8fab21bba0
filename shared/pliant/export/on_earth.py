"""The trajectory of the longest segment on the Earth, as GPX and GeoJSON."""

from pathlib import Path

from pliant.algorithms.geometry import transform
from pliant.algorithms.inertial.geodesy import geodetic_of_enu
from pliant.algorithms.inertial.gps_fit import GpsFit
from pliant.errors import ResultError
from pliant.formats.earth_track import EarthTrack, write_geojson, write_gpx
from pliant.recording.reader import Recording
from pliant.results.earth import place_on_earth, summary_of
from pliant.results.run import read_run


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


def _track(recording: Recording) -> tuple[EarthTrack, GpsFit]:
    """Raises ResultError if the run has no poses, or its source no fixes that place them."""
    run = read_run(recording.path)
    history = run.history
    longest = history.longest_segment()
    poses = {frame: pose for frame, pose in history.final().items() if pose[0] == longest}
    trajectory = history.trajectory(poses)
    if not len(trajectory):
        raise ResultError(f"{recording.path}: the run has no poses to export")
    fit = place_on_earth(recording, run, trajectory)
    enu = transform(fit.S_enu_world, trajectory.positions)
    latitude, longitude, altitude = geodetic_of_enu(enu, fit.origin)
    track = EarthTrack(
        stamps_ns=trajectory.stamps_ns,
        latitude_deg=latitude,
        longitude_deg=longitude,
        altitude_m=altitude,
        about=f"Pliant: {summary_of(fit)}",
    )
    return track, fit
