"""Inertial samples in text files, with and without a source: what is read, refused and counted."""

from pathlib import Path

import cv2
import numpy as np
import pytest

from pliant.datasets import open_source
from pliant.datasets.measured.base import Measurements, Series, imu_measurements
from pliant.datasets.measured.csv_log import read_csv
from pliant.datasets.measured.found import measurements_of
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError

ASL = (
    "#timestamp [ns],w_RS_S_x [rad s^-1],w_RS_S_y [rad s^-1],w_RS_S_z [rad s^-1],"
    "a_RS_S_x [m s^-2],a_RS_S_y [m s^-2],a_RS_S_z [m s^-2]"
)
BEGIN_NS = 1403636579758555392
GYRO, ACCEL = [0.5, -0.25, 0.125], [0.5, 9.75, -1.0]


def write(file: Path, header: str, rows: list[list[object]], separator: str = ",") -> Path:
    lines = [header] * bool(header) + [separator.join(map(str, row)) for row in rows]
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text("\n".join(lines) + "\n")
    return file


def rows(count: int = 50, step: float = 5_000_000, begin: float = BEGIN_NS) -> list[list[object]]:
    return [[begin + n * step, *GYRO, *ACCEL] for n in range(count)]


@pytest.mark.parametrize("header", [ASL, ""])
def test_asl_is_exact(tmp_path: Path, header: str) -> None:
    found = read_csv(write(tmp_path / "data.csv", header, rows()))
    assert found.imu.stamps_ns.tolist() == [row[0] for row in rows()]
    assert found.imu.gyro_rad_s.tolist() == [GYRO] * 50
    assert found.imu.accel_m_s2.tolist() == [ACCEL] * 50
    assert found.notes == ("data.csv: 50 inertial samples, 200 Hz",)


@pytest.mark.parametrize(
    ("header", "unit_s", "gyro", "accel"),
    [
        ("time,gyro_x,gyro_y,gyro_z,accel_x,accel_y,accel_z", 1.0, 1.0, 1.0),
        ("t_ms,gx,gy,gz,ax,ay,az", 1e-3, 1.0, 1.0),
        ("timestamp (us),wx [deg/s],wy [deg/s],wz [deg/s],ax [g],ay [g],az [g]", 1e-6, 57.29578,
         1 / 9.80665),
        ("Time (s);GyroX (deg/s);GyroY (deg/s);GyroZ (deg/s);AccX (m/s2);AccY (m/s2);AccZ (m/s2)",
         1.0, 57.29578, 1.0),
        ("timestamp,angular_velocity.x,angular_velocity.y,angular_velocity.z,"
         "linear_acceleration.x,linear_acceleration.y,linear_acceleration.z", 1e-9, 1.0, 1.0),
        ("%time,field.angular_velocity.x,field.angular_velocity.y,field.angular_velocity.z,"
         "field.linear_acceleration.x,field.linear_acceleration.y,field.linear_acceleration.z",
         1e-9, 1.0, 1.0),
    ],
)  # fmt: skip
def test_names_and_units_of_the_header(
    tmp_path: Path, header: str, unit_s: float, gyro: float, accel: float
) -> None:
    made = [
        [round(0.01 * n / unit_s, 9), *(gyro * x for x in GYRO), *(accel * x for x in ACCEL)]
        for n in range(100)
    ]
    found = read_csv(write(tmp_path / "a.csv", header, made, ";" if ";" in header else ",")).imu
    assert found.stamps_ns == pytest.approx(1e7 * np.arange(100), abs=1)
    assert found.gyro_rad_s[3] == pytest.approx(GYRO, rel=1e-6)
    assert found.accel_m_s2[3] == pytest.approx(ACCEL, rel=1e-6)


def test_a_table_in_utf_16(tmp_path: Path) -> None:
    file = write(tmp_path / "a.csv", "t,gx,gy,gz,ax,ay,az", rows())
    plain = read_csv(file).imu
    file.write_text(file.read_text(), encoding="utf-16")
    np.testing.assert_array_equal(read_csv(file).imu.stamps_ns, plain.stamps_ns)


def test_decimal_commas(tmp_path: Path) -> None:
    header = "Time (s);wx (rad/s);wy (rad/s);wz (rad/s);ax (m/s^2);ay (m/s^2);az (m/s^2)"
    made: list[list[object]] = [
        [str(x).replace(".", ",") for x in (0.01 * n, *GYRO, *ACCEL)] for n in range(100)
    ]
    found = read_csv(write(tmp_path / "a.csv", header, made, ";")).imu
    assert found.stamps_ns == pytest.approx(1e7 * np.arange(100), abs=1)
    assert found.gyro_rad_s.tolist() == [GYRO] * 100
    assert found.accel_m_s2.tolist() == [ACCEL] * 100


def test_dates_are_times(tmp_path: Path) -> None:
    made: list[list[object]] = [
        [f"2024-05-01T10:00:{0.01 * n:06.3f}Z", *GYRO, *ACCEL] for n in range(1, 101)
    ]
    made[50][0] = "yesterday"
    found = read_csv(write(tmp_path / "a.csv", "timestamp,gx,gy,gz,ax,ay,az", made))
    first_ns = 1_714_557_600_010_000_000
    kept = [n for n in range(100) if n != 50]
    assert found.imu.stamps_ns.tolist() == [first_ns + 10_000_000 * n for n in kept]
    assert "1 damaged" in found.notes[0]


def test_unit_of_accelerations_by_their_length(tmp_path: Path) -> None:
    made = [[0.01 * n, *GYRO, 0.0, 0.0, 1.01] for n in range(100)]
    found = read_csv(write(tmp_path / "a.csv", "t,gx,gy,gz,ax,ay,az", made))
    assert found.imu.accel_m_s2[0] == pytest.approx([0.0, 0.0, 1.01 * 9.80665])
    assert "taken as g" in found.notes[1]


def test_accelerations_without_gravity_are_refused(tmp_path: Path) -> None:
    made = [[0.01 * n, *GYRO, 0.1, 0.2, 0.1] for n in range(100)]
    with pytest.raises(DatasetError, match="without gravity"):
        read_csv(write(tmp_path / "a.csv", "t,gx,gy,gz,ax,ay,az", made))


@pytest.mark.parametrize("value", ["nan", "inf", "1e300"])
def test_accelerations_that_are_no_numbers_are_not_without_gravity(
    tmp_path: Path, value: str
) -> None:
    made = [[0.01 * n, *GYRO, *[value] * 3] for n in range(10)]
    with pytest.raises(DatasetError, match="none of its accelerations is a number"):
        read_csv(write(tmp_path / "a.csv", "t,gx,gy,gz,ax,ay,az", made))


def test_the_accelerations_with_gravity_are_chosen(tmp_path: Path) -> None:
    linear = [f"Linear Acceleration {axis} (m/s^2)" for axis in "xyz"]
    header = ",".join(["t,gx,gy,gz", *linear, "ax,ay,az"])
    made = [[0.01 * n, *GYRO, 0.1, 0.2, 0.1, *ACCEL] for n in range(100)]
    found = read_csv(write(tmp_path / "a.csv", header, made))
    assert found.imu.accel_m_s2[0].tolist() == ACCEL
    with pytest.raises(DatasetError, match="without gravity"):
        read_csv(write(tmp_path / "a.csv", ",".join(["t,gx,gy,gz", *linear]), made))


def test_a_column_that_is_missing_is_named(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match="no columns of accelerometer in its header"):
        read_csv(write(tmp_path / "a.csv", "t,gx,gy,gz", [[0.0, *GYRO]]))


def test_each_bad_sample_costs_itself(tmp_path: Path) -> None:
    made = rows()
    made[5][1] = "nan"  # no number
    made[6] = made[6][:4]  # cut off
    made[7][0] = made[8][0]  # doubled
    made[9][0] = BEGIN_NS - 10**9  # set back
    made[10][0] = BEGIN_NS + 10**12  # far ahead
    made[11][2] = "1e999"
    made[12][0] = "x"
    found = read_csv(write(tmp_path / "data.csv", ASL, made))
    assert len(found.imu.stamps_ns) == 43
    assert np.all(np.diff(found.imu.stamps_ns) > 0)
    assert "7 damaged ones" in found.notes[0]


@pytest.mark.parametrize("content", ["", "\n", "\x00\x01", "a,b,c\n1,2,3\n", "1,2\n3,4\n", ASL])
def test_files_that_are_none(tmp_path: Path, content: str) -> None:
    file = tmp_path / "a.csv"
    file.write_text(content)
    with pytest.raises(DatasetError, match=r"a\.csv"):
        read_csv(file)


def test_sensors_at_times_of_their_own() -> None:
    times = np.arange(0, 10**10, 5_000_000)
    slow = np.arange(1_234_567, 10**10, 16_000_000)
    slow = slow[(slow < 4 * 10**9) | (slow > 5 * 10**9)]  # a second is missing
    gyro = Series(times, np.tile(GYRO, (len(times), 1)))
    accel = Series(slow, np.stack([1e-9 * slow, 0.0 * slow, 9.81 + 0.0 * slow], axis=1))
    found = imu_measurements(gyro, accel, "a")
    stamps = found.imu.stamps_ns
    assert found.imu.accel_m_s2[:, 0] == pytest.approx(1e-9 * stamps, abs=0.0165)
    inside = (stamps > slow[0]) & (stamps < slow[-1]) & (abs(stamps - 4.5e9) > 0.52e9)
    assert found.imu.accel_m_s2[inside, 0] == pytest.approx(1e-9 * stamps[inside], abs=1e-9)
    assert not np.any((stamps > 4.02e9) & (stamps < 4.98e9))
    assert "without an accelerometer sample near" in found.notes[0]


def test_without_an_accelerometer_there_is_nothing() -> None:
    gyro = Series(np.arange(100) * 10**7, np.zeros((100, 3)))
    none = Series(np.empty(0, np.int64), np.empty((0, 3)))
    assert not len(imu_measurements(gyro, none, "a").imu.stamps_ns)
    assert not len(imu_measurements(none, none, "a").imu.stamps_ns)


def sequence(folder: Path) -> Path:
    """A sequence in ASL format of one image a second."""
    camera = folder / "mav0" / "cam0"
    (camera / "data").mkdir(parents=True)
    stamps = [BEGIN_NS + n * 10**9 for n in range(3)]
    for stamp in stamps:
        cv2.imwrite(str(camera / "data" / f"{stamp}.png"), np.zeros((48, 64), np.uint8))
    lines = ["#timestamp [ns],filename", *(f"{stamp},{stamp}.png" for stamp in stamps)]
    (camera / "data.csv").write_text("\n".join(lines))
    return folder


def found_of(folder: Path, **options: str) -> Measurements:
    spec = SourceSpec(location=str(folder), fov_deg=60.0, **options)  # type: ignore[arg-type]
    return measurements_of(spec, open_source(spec))


def test_samples_beside_the_camera_are_found(tmp_path: Path) -> None:
    folder = sequence(tmp_path)
    assert not found_of(folder).notes
    write(folder / "mav0" / "imu0" / "data.csv", ASL, rows(600))
    for place in (folder, folder / "mav0", folder / "mav0" / "cam0"):
        assert found_of(place).imu.stamps_ns[0] == BEGIN_NS


def test_damaged_samples_beside_the_camera_cost_no_run(tmp_path: Path) -> None:
    folder = sequence(tmp_path)
    write(folder / "mav0" / "imu0" / "data.csv", "t,gx,gy,gz", [[0.0, *GYRO]])
    found = found_of(folder)
    assert not len(found.imu.stamps_ns)
    assert "no columns of accelerometer" in found.notes[0]


def test_a_named_file_replaces_them_or_is_refused(tmp_path: Path) -> None:
    folder = sequence(tmp_path)
    write(folder / "mav0" / "imu0" / "data.csv", ASL, rows(600))
    own = write(tmp_path / "own.csv", ASL, rows(100, begin=7 * 10**12))
    found = found_of(folder, imu=str(own))
    assert len(found.imu.stamps_ns) == 100
    assert found.imu.stamps_ns[0] == BEGIN_NS  # another clock: it begins with the images
    own = write(tmp_path / "own.csv", ASL, rows(100, begin=BEGIN_NS + 60 * 10**9))
    assert found_of(folder, imu=str(own)).imu.stamps_ns[0] == BEGIN_NS + 60 * 10**9
    for name, why in (("none.csv", "no such file"), ("mav0/cam0/data.csv", "no columns of")):
        with pytest.raises(DatasetError, match=why):
            found_of(folder, imu=str(folder / name))
    (tmp_path / "a.xyz").write_text("")
    with pytest.raises(DatasetError, match="not a kind of file that is understood"):
        found_of(folder, imu=str(tmp_path / "a.xyz"))
    with pytest.raises(DatasetError, match="no columns of latitude"):
        found_of(folder, gps=str(own))


def test_a_device_is_no_table(tmp_path: Path) -> None:
    endless = tmp_path / "a.csv"
    endless.symlink_to("/dev/null")  # /dev/zero would fill the memory where this fails
    source = SourceSpec(location="built-in:tiny", imu=str(endless))
    with pytest.raises(DatasetError, match="not a kind of file that is understood"):
        measurements_of(source, open_source(SourceSpec(location="built-in:tiny")))
