"""A recording with satellite fixes: its scale, and its track on the Earth."""

import dataclasses
import json
from collections.abc import Sequence
from pathlib import Path
from xml.etree import ElementTree

import laspy
import numpy as np
import pyproj
import pytest

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import align_umeyama, pose_to_matrix, so3_exp
from pliant.algorithms.inertial.geodesy import EnuOrigin, enu_of, geodetic_of_enu
from pliant.algorithms.inertial.samples import GpsFixes, ImuSamples
from pliant.algorithms.map_delta import BY_GYRO, TRACKING
from pliant.algorithms.tracks import FrameTracks
from pliant.bus.replay_bus import ReplayBus
from pliant.config import Config
from pliant.datasets.measured.fix_files import read_gpx
from pliant.errors import ResultError
from pliant.export.export import export_result
from pliant.export.on_earth import write_geo_registration
from pliant.export.posed_images import PosedImage
from pliant.formats.las import write_las
from pliant.formats.tum import read_tum
from pliant.messages import topics
from pliant.messages.types import CameraStream, Extrema, Header, MapUpdate
from pliant.recording.measured import gps_pieces, imu_pieces
from pliant.results.known_scale import MetricRecording
from pliant.results.run import read_run
from pliant.results.verdict import summary
from pliant.results.write import write_rigid_results
from pliant.scale.gps import from_gps
from pliant_services.nodes import recorder

EMPTY = Extrema.of(Header(frame=0, stamp_ns=0, frame_id=""), FrameTracks.empty())
FRAMES, STEP_NS, BEGIN_NS = 400, 10**8, 1_700_000_000 * 10**9
ORIGIN = EnuOrigin(latitude_deg=-33.9, longitude_deg=151.2, altitude_m=58.0)
NO_POINTS = np.zeros((0, 3))
SCALE, TURN = 3.0, so3_exp(np.array([0.4, 0.2, -1.0]))


def path() -> tuple[F64, F64]:
    """Stamps of the frames, and true positions east, north and up."""
    times = 1e-9 * STEP_NS * np.arange(FRAMES)
    turns = [30 * np.sin(0.2 * times), 20 * np.cos(0.3 * times), 5 * np.sin(0.4 * times)]
    return BEGIN_NS + STEP_NS * np.arange(FRAMES), np.stack(turns, axis=1)


def fixes_on(stamps: F64, enu: F64) -> GpsFixes:
    latitude, longitude, altitude = geodetic_of_enu(enu[::5], ORIGIN)
    return GpsFixes(
        stamps_ns=stamps[::5], latitude_deg=latitude, longitude_deg=longitude,
        altitude_m=altitude, sigma_m=np.full((len(latitude), 3), np.nan),
    )  # fmt: skip


@pytest.fixture(scope="module")
def placed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result folder of a run whose source had fixes."""
    folder = tmp_path_factory.mktemp("placed")
    stamps, enu = path()
    record(folder, list(gps_pieces(fixes_on(stamps, enu))))
    return folder


def record(
    folder: Path, fixes: list[Header], samples: Sequence[Header] = (), by_gyro: range = range(0),
    points_enu: F64 = NO_POINTS,
) -> None:  # fmt: skip
    """by_gyro: frames that no image supports, far from where they were.    points_enu: (N, 3)."""
    stamps, enu = path()
    enu[by_gyro] += 1000.0
    camera = "model: pinhole\nwidth: 160\nheight: 120\nfx: 100\nfy: 100\ncx: 79.5\ncy: 59.5\n"
    stream = CameraStream(
        frame=0, stamp_ns=0, frame_id="", source="", mode="lossless", frames=FRAMES,
        calibration=camera, width=160, height=120, fx=100.0, fy=100.0, cx=79.5, cy=59.5,
    )  # fmt: skip
    poses = np.zeros((FRAMES, 7))
    poses[:, :3], poses[:, 6] = enu @ TURN / SCALE, 1.0
    frames, none, points = np.arange(FRAMES), np.zeros(FRAMES, np.int32), len(points_enu)
    inliers = none + 400
    inliers[by_gyro] = BY_GYRO
    final = MapUpdate(
        frame=FRAMES - 1, stamp_ns=int(stamps[-1]), frame_id="", state=TRACKING, reason="",
        segment=0, inliers=400, pose_frames=frames, pose_segments=none, pose_keyframes=frames,
        poses_keyframe_camera=np.tile(np.eye(7)[6], (FRAMES, 1)), pose_inliers=inliers,
        keyframe_ids=frames, keyframe_frames=frames, keyframe_segments=none, keyframe_poses=poses,
        point_ids=np.arange(points), point_segments=none[:points],
        points_world=points_enu @ TURN / SCALE, point_keyframes=none[:points],
        point_colours=np.full((points, 3), (255, 128, 0), np.uint8),
        point_parallax_rad=np.zeros(points, np.float32), point_sigmas=np.zeros(points, np.float32),
        removed_point_ids=np.zeros(0, np.int64), point_hosts=np.zeros(points, np.int64),
    )  # fmt: skip
    tracks = [
        dataclasses.replace(EMPTY, frame=frame, stamp_ns=int(stamp))
        for frame, stamp in enumerate(stamps)
    ]
    nothing = {n: value[:0] for n, value in vars(final).items() if isinstance(value, np.ndarray)}
    updates = [
        dataclasses.replace(final, **nothing, frame=frame, stamp_ns=int(stamp))
        for frame, stamp in enumerate(stamps)
    ]
    told: dict[topics.Topic, list[Header]] = {
        topics.STREAM: [stream], topics.GPS: fixes, topics.IMU: list(samples),
        topics.EXTREMA: list(tracks),
        topics.MAP_UPDATE: updates,
        topics.MAP_FINAL: [final],
    }  # fmt: skip
    recorder.run(
        ReplayBus({t: m for t, m in told.items() if m}), Config(), folder / "recording.mcap", {}
    )


def test_scale_by_fixes(placed: Path) -> None:
    recording = MetricRecording(placed / "recording.mcap")
    found = from_gps(recording, read_run(recording.path))
    assert found.metres_per_unit == pytest.approx(SCALE, rel=1e-4)
    assert found.sigma < 1e-3
    assert "satellite fixes, error 0.0 m" in found.source


def test_a_run_with_fixes_is_in_metres(tmp_path: Path) -> None:
    stamps, enu = path()
    record(tmp_path, list(gps_pieces(fixes_on(stamps, enu))))
    report = write_rigid_results(tmp_path)
    assert report["scale_is_metric"]
    assert "satellite fixes" in report["scale"]["source"]
    found = read_tum(tmp_path / "trajectory.txt")
    scale, _, _ = align_umeyama(found.positions, enu, with_scale=True)
    assert scale == pytest.approx(1.0, rel=1e-4)


def test_refused_fixes_do_not_change_a_run(tmp_path: Path) -> None:
    stamps, enu = path()
    record(tmp_path, list(gps_pieces(fixes_on(stamps, 0.0 * enu))))
    report = write_rigid_results(tmp_path)
    assert not report["scale_is_metric"]
    assert report["gps_refusal"]
    assert any(line.startswith("satellite fixes not used: ") for line in summary(report))
    assert not (tmp_path / "scale.yaml").exists()


def still_samples() -> list[Header]:
    """Of a sensor that lies on a table."""
    stamps = path()[0][0] + 10_000_000 * np.arange(int(STEP_NS * FRAMES / 10_000_000))
    noise = 1e-3 * np.random.default_rng(0).normal(size=(len(stamps), 3))
    up = np.array([0.0, 0.0, 9.81])
    samples = ImuSamples(stamps_ns=stamps, gyro_rad_s=noise, accel_m_s2=noise + up)
    return list(imu_pieces(samples))


def test_the_refusal_of_one_sensor_is_reported_beside_the_scale_of_the_other(
    tmp_path: Path,
) -> None:
    record(tmp_path, list(gps_pieces(fixes_on(*path()))), still_samples())
    report = write_rigid_results(tmp_path)
    assert "satellite fixes" in report["scale"]["source"]
    assert report["inertial_refusal"]
    assert not report["gps_refusal"]
    lines = summary(report)
    assert any(line.startswith("in metres by") for line in lines)
    assert any(line.startswith("inertial samples not used: ") for line in lines)


def test_poses_by_the_gyro_alone_are_no_evidence_and_named(tmp_path: Path) -> None:
    """They would change the scale: here they are a kilometre off."""
    lost = range(40, 50)
    record(tmp_path, list(gps_pieces(fixes_on(*path()))), by_gyro=lost)
    report = write_rigid_results(tmp_path)
    assert report["scale"]["metres_per_unit"] == pytest.approx(SCALE, rel=1e-4)
    assert report["frames_by_gyro"] == list(lost)
    assert report["frames_with_pose"] == FRAMES - len(lost)
    assert "10 are placed by the gyro alone" in report["verdict_reason"]
    assert any("placed by the gyro between others: 40 to 49" in line for line in summary(report))
    assert len(read_tum(tmp_path / "trajectory.txt")) == FRAMES


def test_gpx_is_where_the_camera_was(placed: Path) -> None:
    file = export_result(placed, "gpx", None)
    found = read_gpx(file).gps
    stamps, enu = path()
    assert found.stamps_ns.tolist() == stamps.tolist()
    there = enu_of(found.latitude_deg, found.longitude_deg, found.altitude_m, ORIGIN)
    assert there == pytest.approx(enu, abs=0.01)
    assert ElementTree.parse(file).getroot().tag.endswith("gpx")


def test_geojson_has_the_place_of_the_map(placed: Path) -> None:
    feature = json.loads(export_result(placed, "geojson", None).read_text())
    assert feature["geometry"]["type"] == "LineString"
    longitude, latitude, altitude = np.array(feature["geometry"]["coordinates"]).T
    _, enu = path()
    assert enu_of(latitude, longitude, altitude, ORIGIN) == pytest.approx(enu, abs=0.01)
    told = feature["properties"]
    S = np.array(told["S_enu_world"])
    origin = EnuOrigin(**dict(zip(vars(ORIGIN), told["enu_origin"], strict=True)))
    ours = (enu @ TURN / SCALE) @ S[:3, :3].T + S[:3, 3]
    back = enu_of(*geodetic_of_enu(ours, origin), ORIGIN)
    assert back == pytest.approx(enu, abs=0.01)
    assert told["coordinateProperties"]["times"][0] == 1_700_000_000.0


def test_las_has_the_points_in_their_utm_zone(tmp_path: Path) -> None:
    there = np.array([[0.0, 0.0, 0.0], [100.0, 0.0, 5.0], [0.0, 100.0, -2.0]])
    record(tmp_path, list(gps_pieces(fixes_on(*path()))), points_enu=there)
    file = export_result(tmp_path, "las", None)
    found = laspy.read(file)
    system = found.header.parse_crs()
    assert system is not None
    assert system.to_epsg() == 32756  # 151.2 degrees east, south
    to_utm = pyproj.Transformer.from_crs(4326, 32756, always_xy=True)
    latitude, longitude, altitude = geodetic_of_enu(there, ORIGIN)
    expected = np.stack([*to_utm.transform(longitude, latitude), altitude], axis=1)
    assert found.xyz == pytest.approx(expected, abs=0.02)
    assert (found.red[0], found.green[0], found.blue[0]) == (65535, 128 * 257, 0)
    assert str(found.header.creation_date) == "2023-11-14"
    written = file.read_bytes()
    assert export_result(tmp_path, "las", None, force=True).read_bytes() == written


def test_las_beside_the_antimeridian(tmp_path: Path) -> None:
    """Longitudes of both signs are one place, whose mean is not in Africa; 2000 km are too far."""
    positions = {
        "latitude_deg": np.array([-17.0, -17.0]), "altitude_m": np.zeros(2),
        "colours": np.zeros((2, 3), np.uint8), "stamp_ns": 0,
    }  # fmt: skip
    write_las(tmp_path / "a.las", longitude_deg=np.array([179.9999, -179.9998]), **positions)
    system = laspy.read(tmp_path / "a.las").header.parse_crs()
    assert system is not None
    assert system.to_epsg() == 32701
    with pytest.raises(ResultError, match="too far apart"):
        write_las(tmp_path / "b.las", longitude_deg=np.array([150.0, 175.0]), **positions)


def test_las_without_a_map(placed: Path) -> None:
    with pytest.raises(ResultError, match="no map to export"):
        export_result(placed, "las", None)


@pytest.mark.parametrize("kind", ["gpx", "geojson", "las"])
def test_without_fixes_there_is_no_track(tmp_path: Path, kind: str) -> None:
    record(tmp_path, [])
    with pytest.raises(ResultError, match="had no satellite fixes"):
        export_result(tmp_path, kind, None)
    assert not list(tmp_path.glob(f"*.{kind}"))


def test_images_of_a_colmap_model_have_their_place_on_the_earth(tmp_path: Path) -> None:
    """A line for each image; no file where the source has no fixes."""
    stamps, enu = path()
    record(tmp_path, list(gps_pieces(fixes_on(stamps, enu))))
    recording = MetricRecording(tmp_path / "recording.mcap")
    run = read_run(recording.path)
    images = [
        PosedImage(frame, pose_to_matrix(pose)) for frame, (_, pose) in run.history.final().items()
    ]
    file = tmp_path / "geo_registration.txt"
    write_geo_registration(recording, run, file, images)
    rows = [line.split() for line in file.read_text().splitlines()]
    assert [row[0] for row in rows] == [image.name for image in images]
    latitude, longitude, altitude = np.array([row[1:] for row in rows], np.float64).T
    assert enu_of(latitude, longitude, altitude, ORIGIN) == pytest.approx(enu, abs=0.01)
    unplaced = tmp_path / "unplaced"
    unplaced.mkdir()
    record(unplaced, [])
    without = MetricRecording(unplaced / "recording.mcap")
    none = tmp_path / "none.txt"
    write_geo_registration(without, read_run(without.path), none, images)
    assert not none.exists()
