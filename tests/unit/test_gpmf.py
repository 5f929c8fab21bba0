"""GoPro's metadata: what a camera has written is read whole, and nothing else is believed."""

import struct
from pathlib import Path

import numpy as np
import pytest
from gpmf_writer import entry, mp4, nested, stream

from pliant.algorithms.geometry import so3_exp
from pliant.datasets.measured.gopro import read_gopro
from pliant.datasets.measured.gpmf import Payload, read_gpmf

SCALE = 100
SAMPLES = Path(__file__).parents[3] / "shared" / "data" / "casual"


def camera(gyro: np.ndarray, accel: np.ndarray, *about: bytes) -> bytes:
    """A payload of one camera; samples (N, 3) in units of the sensor."""
    rows = [np.rint(each * SCALE).astype(int).tolist() for each in (gyro, accel)]
    streams = (stream("GYRO", rows[0], SCALE, *about), stream("ACCL", rows[1], SCALE, *about))
    return nested("DEVC", entry("DVNM", "c", 1, b"Camera"), *streams)


def jittering(payloads: int, rate_hz: float) -> tuple[list[bytes], np.ndarray]:
    """Payloads of 1.001 s with the samples that were measured by then, and all times, in ns."""
    rng = np.random.default_rng(0)
    ends = 1.001 * np.arange(1, payloads + 1) + rng.uniform(0.0, 0.02, payloads)
    times = np.arange(int(rate_hz * ends[-1])) / rate_hz
    made: list[bytes] = []
    begin = 0
    for end in ends:
        last = int(np.searchsorted(times, end))
        gyro = np.stack([times, 0.0 * times, 1.0 + 0.0 * times], axis=1)[begin:last]
        accel = np.tile([0.0, 0.0, 9.81], (last - begin, 1))
        made.append(camera(gyro, accel, entry("TSMP", "L", 1, [[last]])))
        begin = last
    return made, 1e9 * times


def test_jitter_of_the_payloads_does_not_reach_the_times(tmp_path: Path) -> None:
    payloads, times = jittering(60, rate_hz=197.3)
    file = tmp_path / "video.mp4"
    file.write_bytes(mp4(payloads))
    found = read_gopro(file)
    assert len(found.imu.stamps_ns) == len(times)
    off = found.imu.stamps_ns - times
    assert np.ptp(off) < 8e6  # a payload's edge is up to 20 ms late
    assert np.abs(np.mean(off)) < 20e6
    assert found.imu.accel_m_s2 == pytest.approx(np.tile([0.0, 9.81, 0.0], (len(times), 1)))
    assert found.imu_notes == (f"video.mp4 (GPMF): {len(times)} inertial samples, 197 Hz",)


def test_cut_payload_between_others_costs_its_samples_alone() -> None:
    payloads, times = jittering(8, rate_hz=200.0)
    payloads[3] = payloads[3][: len(payloads[3]) // 3]
    stamps = [(1_001_000_000 * n, 1_001_000_000 * (n + 1)) for n in range(8)]
    read = [Payload(data, *span) for data, span in zip(payloads, stamps, strict=True)]
    found = read_gpmf(read, "a").imu
    assert 6.5 / 8 * len(times) < len(found.stamps_ns) < 7.5 / 8 * len(times)
    # The first number of a sample is its own time: those behind the cut keep theirs.
    own = 1e9 * found.gyro_rad_s[:, 2]
    assert np.ptp(found.stamps_ns - own) < 20e6


@pytest.mark.parametrize(
    ("orin", "expected"),
    [("XYZ", [1.0, 2.0, 3.0]), ("XzY", [1.0, 3.0, -2.0]), ("", [2.0, 3.0, 1.0])],
)
def test_axes_are_those_of_the_camera(orin: str, expected: list[float]) -> None:
    about = [entry("ORIN", "c", 1, orin.encode())] if orin else []
    rows = np.tile([1.0, 2.0, 3.0], (100, 1))
    found = read_gpmf([Payload(camera(rows, rows, *about), 0, 10**9)], "a").imu
    assert found.gyro_rad_s[0] == pytest.approx(expected)
    assert found.accel_m_s2[0] == pytest.approx(expected)


def test_matrix_without_an_order_of_the_sensor() -> None:
    turn = entry("MTRX", "f", 9, [[0, -1, 0, 1, 0, 0, 0, 0, 1]])
    about = [turn, entry("ORIO", "c", 1, b"ZXY")]
    rows = np.tile([1.0, 2.0, 3.0], (100, 1))
    found = read_gpmf([Payload(camera(rows, rows, *about), 0, 10**9)], "a").imu
    assert found.gyro_rad_s[0] == pytest.approx([1.0, 3.0, -2.0])


def test_fixes_without_a_fix_are_left_out() -> None:
    scale = entry("SCAL", "l", 5, [[10**7, 10**7, 1000, 1000, 100]])
    row = [474_000_000, 85_000_000, 412_500, 0, 0]
    payloads = [
        nested(
            "DEVC",
            nested(
                "STRM", entry("GPSF", "L", 1, [[fix]]), scale, entry("GPS5", "l", 5, [row] * 18)
            ),
        )
        for fix in (0, 2, 3, 3)
    ]
    read = [Payload(data, n * 10**9, (n + 1) * 10**9) for n, data in enumerate(payloads)]
    found = read_gpmf(read, "a").gps
    assert len(found.stamps_ns) == 36
    assert (found.latitude_deg[0], found.longitude_deg[0]) == pytest.approx((47.4, 8.5))
    assert found.altitude_m[0] == pytest.approx(412.5)
    assert np.isnan(found.sigma_m).all()


def test_newer_fixes_have_types_of_their_own() -> None:
    scales = [[10**7], [10**7], [1000], [1000], [100], [1], [1000], [100], [1]]
    row = struct.pack(">lllllllHH", 474_000_000, 85_000_000, 412_500, 0, 0, 9000, 5000, 150, 3)
    bad = struct.pack(">lllllllHH", 474_000_000, 85_000_000, 412_500, 0, 0, 9000, 5000, 150, 0)
    gps9 = b"GPS9?" + bytes([len(row)]) + struct.pack(">H", 3) + row + bad + row
    about = [entry("TYPE", "c", 1, b"lllllllSS"), entry("SCAL", "l", 1, scales)]
    data = nested("DEVC", nested("STRM", *about, gps9))
    found = read_gpmf([Payload(data, 0, 10**9)], "a").gps
    assert len(found.stamps_ns) == 2
    assert found.latitude_deg == pytest.approx([47.4, 47.4])


def test_crafted_counts_take_no_memory() -> None:
    huge = b"GYROs\xff\xff\xff" + bytes(64)
    deep = b"".join(b"DEVC\0\x01\xff\xff" for _ in range(1000))
    for data in (huge, nested("DEVC", nested("STRM", huge)), deep, b"DEVC", bytes(1 << 16)):
        assert not len(read_gpmf([Payload(data, 0, 10**9)], "a").imu.stamps_ns)


def test_every_mutation_is_read_or_passed_over(tmp_path: Path) -> None:
    whole = mp4(jittering(3, rate_hz=50.0)[0])
    rng = np.random.default_rng(1)
    file = tmp_path / "video.mp4"
    for _ in range(300):
        data = bytearray(whole)
        for place in rng.integers(0, len(data), 8):
            data[place] = rng.integers(256)
        file.write_bytes(data[: rng.integers(len(data))] if rng.integers(2) else data)
        found = read_gopro(file)
        assert np.all(np.diff(found.imu.stamps_ns) > 0)
        assert np.isfinite(found.imu.gyro_rad_s).all()


@pytest.mark.parametrize(
    ("name", "samples", "rate_hz", "fixes"),
    [("gopro_walk", 2082, 197.5, 191), ("gopro_karma", 4795, 397.3, 0)],
)
def test_public_samples_are_read_whole(name: str, samples: int, rate_hz: float, fixes: int) -> None:
    file = SAMPLES / name / "video.mp4"
    if not file.is_file():
        pytest.skip("no public sample files of GoPro here")
    found = read_gopro(file)
    steps = np.diff(found.imu.stamps_ns)
    assert (len(steps) + 1, len(found.gps.stamps_ns)) == (samples, fixes)
    assert 1e9 / steps.mean() == pytest.approx(rate_hz, abs=0.1)
    lengths = np.linalg.norm(found.imu.accel_m_s2, axis=1)
    assert lengths.mean() == pytest.approx(9.81, abs=0.1)


def test_gyro_and_accelerometer_of_a_public_sample_have_the_same_axes() -> None:
    """Gravity turned by the gyro stays where it is, and by no mirrored gyro as well."""
    file = SAMPLES / "gopro_walk" / "video.mp4"
    if not file.is_file():
        pytest.skip("no public sample files of GoPro here")
    imu = read_gopro(file).imu
    steps = so3_exp(imu.gyro_rad_s[:-1] * 1e-9 * np.diff(imu.stamps_ns)[:, None])

    def spread(mirror: np.ndarray) -> float:
        R, directions = np.eye(3), list[np.ndarray]()
        for step, accel in zip(steps, imu.accel_m_s2[:-1] @ mirror, strict=True):
            directions.append(R @ accel)
            R = R @ step
        means = np.array([np.mean(directions[n : n + 200], axis=0) for n in range(0, 2000, 200)])
        means /= np.linalg.norm(means, axis=1, keepdims=True)
        return float(np.degrees(np.linalg.norm(means - means.mean(axis=0), axis=1).mean()))

    there = spread(np.eye(3))
    assert there < 1.3
    for axis in range(3):
        mirror = np.eye(3)
        mirror[axis, axis] = -1.0
        assert spread(mirror) > 1.2 * there
