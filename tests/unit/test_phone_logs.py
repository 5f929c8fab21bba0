"""Logs of phones, cameras and drones beside a video: Gyroflow, Sensor Logger, GPX, DJI."""

from pathlib import Path

import numpy as np
import pytest

from pliant.datasets.measured.csv_log import read_csv
from pliant.datasets.measured.fix_files import read_fix_table, read_gpx, read_srt
from pliant.datasets.measured.gyroflow import read_gcsv
from pliant.datasets.measured.phone_log import is_phone_log, read_phone_log
from pliant.datasets.measured.readers import Reader, video_sensors
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError

GCSV = """GYROFLOW IMU LOG
version,1.3
id,a_camera
orientation,YxZ
tscale,0.001
gscale,0.00122173047
ascale,0.00048828125
t,gx,gy,gz,ax,ay,az
0,39,86,183,-1137,-15689,-2986
5,39,86,183,-1137,-15689,-2986
10,39,86,x,-1137,-15689,-2986
15,39,86,183,-1137,-15689,-2986
"""
GPX = """<?xml version="1.0"?>
<gpx version="1.1" xmlns="http://www.topografix.com/GPX/1/1"><trk><trkseg>
<trkpt lat="47.1" lon="8.5"><ele>412.5</ele><time>2024-05-01T10:00:00Z</time></trkpt>
<trkpt lat="47.2" lon="8.6"><time>2024-05-01T12:00:01.500+02:00</time></trkpt>
<trkpt lat="47.3" lon="8.7"><ele>413</ele></trkpt>
<trkpt lat="95" lon="8.7"><ele>413</ele><time>2024-05-01T10:00:03Z</time></trkpt>
</trkseg></trk></gpx>
"""
SRT = """1
00:00:00,000 --> 00:00:00,033
<font size="28">SrtCnt : 1, DiffTime : 33ms
2023-05-06 10:11:12.123
[iso : 100] [latitude: 47.10001] [longitude: 8.50001] [rel_alt: 1.3 abs_alt: 400.5] </font>

2
00:00:00,033 --> 00:00:00,066
[latitude: 47.10001] [longitude: 8.50001] [rel_alt: 1.3 abs_alt: 400.5] </font>

3
00:00:00,066 --> 00:00:00,100
[latitude : 47.10002] [longtitude : 8.50001] [altitude: 401.5]

4
00:01:02.100 --> 00:01:03,100
GPS(8.6000,47.2000,19) BAROMETER:1.5
"""


def test_gyroflow(tmp_path: Path) -> None:
    file = tmp_path / "a.gcsv"
    file.write_text(GCSV)
    found = read_gcsv(file)
    assert found.imu.stamps_ns.tolist() == [0, 5_000_000, 15_000_000]
    turned = 0.00122173047 * np.array([-86.0, 39.0, 183.0])  # Y, -X, Z
    assert found.imu.gyro_rad_s[0] == pytest.approx(turned)
    assert np.linalg.norm(found.imu.accel_m_s2[0]) == pytest.approx(76.67, abs=0.01)
    assert "1 damaged one " in found.notes[0]


@pytest.mark.parametrize(
    ("what", "instead", "why"),
    [("GYROFLOW", "OTHER", "no Gyroflow log"), ("ax,ay,az", "mx,my,mz", "without the columns ax"),
     ("0.001\n", "zero\n", "tscale is no positive number")],
)  # fmt: skip
def test_gyroflow_that_is_none(tmp_path: Path, what: str, instead: str, why: str) -> None:
    file = tmp_path / "a.gcsv"
    file.write_text(GCSV.replace(what, instead))
    with pytest.raises(DatasetError, match=why):
        read_gcsv(file)


def sensor_logger(folder: Path, *, total: bool, gravity: bool) -> Path:
    begin, lines = 1_700_000_000_000_000_000, {}
    header = "time,seconds_elapsed,z,y,x"
    for name, row, step in (
        ("Gyroscope", "0.3,0.2,0.1", 10_000_000),
        ("Accelerometer", "0.03,0.02,0.01", 10_000_000),
        ("Gravity", "0,9.81,0", 16_000_000),
        ("TotalAcceleration", "0.03,9.83,0.01", 10_000_000),
    ):
        times = range(0, 10**9, step)
        lines[name] = [header, *(f"{begin + t},{t * 1e-9:.6f},{row}" for t in times)]
    unwanted = ["TotalAcceleration"] * (not total) + ["Gravity"] * (not gravity)
    for name in lines.keys() - set(unwanted):
        (folder / f"{name}.csv").write_text("\n".join(lines[name]))
    (folder / "Location.csv").write_text(
        "time,seconds_elapsed,verticalAccuracy,horizontalAccuracy,altitude,longitude,latitude\n"
        f"{begin},0,3.0,4.53,412.5,8.5,47.1\n{begin + 10**9},1,3.0,4.53,412.5,8.6,47.2\n"
    )
    return folder


@pytest.mark.parametrize(("total", "gravity"), [(True, True), (False, True), (True, False)])
def test_sensor_logger(tmp_path: Path, total: bool, gravity: bool) -> None:
    folder = sensor_logger(tmp_path, total=total, gravity=gravity)
    assert is_phone_log(folder)
    found = read_phone_log(folder)
    assert len(found.imu.stamps_ns) == 100
    assert found.imu.stamps_ns[0] == 1_700_000_000_000_000_000
    assert found.imu.gyro_rad_s[5] == pytest.approx([0.1, 0.2, 0.3])
    assert found.imu.accel_m_s2[5] == pytest.approx([0.01, 9.83, 0.03])
    assert found.gps.latitude_deg.tolist() == [47.1, 47.2]
    assert found.gps.sigma_m[0] == pytest.approx([3.0, 3.0, 3.0])


def test_sensor_logger_without_gravity_is_refused(tmp_path: Path) -> None:
    folder = sensor_logger(tmp_path, total=False, gravity=False)
    with pytest.raises(DatasetError, match=r"Accelerometer\.csv: its accelerations are without"):
        read_phone_log(folder)


def test_gpx(tmp_path: Path) -> None:
    file = tmp_path / "a.gpx"
    file.write_text(GPX)
    found = read_gpx(file)
    assert found.gps.stamps_ns.tolist() == [1714557600 * 10**9, 1714557601_500_000_000]
    assert found.gps.altitude_m.tolist() == [412.5, 0.0]
    assert np.isinf(found.gps.sigma_m[1, 2])
    assert "2 damaged ones" in found.notes[0]


def test_entities_of_xml_are_refused(tmp_path: Path) -> None:
    file = tmp_path / "a.gpx"
    for text in ('<!DOCTYPE a [<!ENTITY b "c">]><gpx/>', "<gpx>", "", "\x00"):
        file.write_text(text)
        with pytest.raises(DatasetError, match=r"a\.gpx"):
            read_gpx(file)


def test_subtitles_of_drones(tmp_path: Path) -> None:
    file = tmp_path / "a.srt"
    file.write_text(SRT)
    found = read_srt(file).gps
    assert found.stamps_ns.tolist() == [0, 66_000_000, 62_100_000_000]
    assert found.latitude_deg.tolist() == [47.10001, 47.10002, 47.2]
    assert found.longitude_deg.tolist() == [8.50001, 8.50001, 8.6]
    assert found.altitude_m.tolist() == [400.5, 401.5, 19.0]


def test_table_of_fixes_needs_its_columns(tmp_path: Path) -> None:
    file = tmp_path / "a.csv"
    file.write_text("time,lat,height,x\n0,1,2,3\n")
    with pytest.raises(DatasetError, match="no columns of longitude"):
        read_fix_table(file)


def test_subtitles_of_other_cameras_are_none(tmp_path: Path) -> None:
    file = tmp_path / "a.srt"
    file.write_text("1\n00:00:00,000 --> 00:00:01,000\nHello.\n")
    assert not read_srt(file).notes


def test_files_beside_a_video(tmp_path: Path) -> None:
    (tmp_path / "a.mp4").write_bytes(b"")
    (tmp_path / "a.gcsv").write_text("nonsense")
    (tmp_path / "a.SRT").write_text(SRT)
    (tmp_path / "a.gpx").write_text(GPX)
    found = video_sensors(SourceSpec(location=str(tmp_path / "a.mp4")))
    assert len(found.gps.stamps_ns) == 3  # the subtitles: they have the clock of the video
    assert "is no Gyroflow log" in found.imu_notes[0]


_TOKENS = [
    "nan",
    "inf",
    "1e999",
    "1e308",
    "-",
    "",
    '"',
    ",",
    ";",
    "\n",
    "\0",
    "9" * 40,
    "(",
    "<",
    "x",
]


@pytest.mark.parametrize(
    ("name", "text", "reader"),
    [("a.gcsv", GCSV, read_gcsv), ("a.gpx", GPX, read_gpx), ("a.srt", SRT, read_srt),
     ("a.csv", "time,gx,gy,gz,ax,ay,az\n" + "0.01,1,2,3,0,9.8,0\n" * 9, read_csv),
     ("b.csv", "time,lat,lon,alt,accuracy\n" + "1,47,8,400,3\n" * 9, read_fix_table)],
)  # fmt: skip
def test_mutated_files_are_read_or_refused(
    tmp_path: Path, name: str, text: str, reader: Reader
) -> None:
    rng = np.random.default_rng(0)
    for _ in range(400):
        made = text
        for _ in range(int(rng.integers(1, 6))):
            begin = int(rng.integers(len(made)))
            made = made[:begin] + str(rng.choice(_TOKENS)) + made[begin + int(rng.integers(4)) :]
        (tmp_path / name).write_text(made)
        try:
            found = reader(tmp_path / name)
        except DatasetError:
            continue
        for stamps in (found.imu.stamps_ns, found.gps.stamps_ns):
            assert np.all(np.diff(stamps) > 0)
        for values in (found.imu.gyro_rad_s, found.imu.accel_m_s2, found.gps.altitude_m):
            assert np.isfinite(values).all()
