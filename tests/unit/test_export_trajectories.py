"""Trajectory files: what is read is checked line by line, what is written is exact."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from pliant.algorithms.geometry import so3_exp
from pliant.errors import ResultError
from pliant.formats.euroc import read_euroc, write_euroc
from pliant.formats.kitti import read_kitti, read_kitti_times, write_kitti
from pliant.formats.text import format_seconds, parse_nanoseconds, parse_seconds
from pliant.formats.trajectory_files import read_trajectory
from pliant.formats.tum import read_tum, write_tum
from pliant.trajectory import Trajectory

GOOD = "1.0 0 0 0 0 0 0 1\n"


def random_trajectory(count: int = 20, seed: int = 0) -> Trajectory:
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, :3] = so3_exp(rng.normal(size=(count, 3)))
    T[:, :3, 3] = rng.normal(size=(count, 3)) * 10
    stamps = 1403715274312143104 + np.cumsum(rng.integers(1, 10**8, count))
    return Trajectory(stamps_ns=stamps.astype(np.int64), T_world_camera=T)


@given(st.integers(-9 * 10**18, 9 * 10**18))
def test_seconds_are_exact_both_ways(stamp_ns: int) -> None:
    assert parse_seconds(format_seconds(stamp_ns)) == stamp_ns


@pytest.mark.parametrize(
    ("text", "stamp_ns"),
    [
        ("1403715274.312143104", 1403715274312143104),
        ("1.5e-3", 1500000),
        ("0.0333333333", 33333333),
    ],
)
def test_seconds_of_other_writers(text: str, stamp_ns: int) -> None:
    assert parse_seconds(text) == stamp_ns


@pytest.mark.parametrize("text", ["nan", "inf", "1e999999999", "1_0", "0x10", "", "-1e400", "1e10"])
def test_seconds_that_are_none(text: str) -> None:
    with pytest.raises(ValueError, match="not a time"):
        parse_seconds(text)


@pytest.mark.parametrize("text", ["1.0", "", "-", "1e9", "9" * 19, "9" * 30, "²"])
def test_nanoseconds_that_are_none(text: str) -> None:
    with pytest.raises(ValueError, match="not a time"):
        parse_nanoseconds(text)


def test_tum_and_euroc_round_trip_and_are_deterministic(tmp_path: Path) -> None:
    trajectory = random_trajectory()
    for read, write in ((read_tum, write_tum), (read_euroc, write_euroc)):
        first, second = tmp_path / "a", tmp_path / "b"
        write(first, trajectory)
        again = read(first)
        assert np.array_equal(again.stamps_ns, trajectory.stamps_ns)
        assert np.allclose(again.T_world_camera, trajectory.T_world_camera, atol=1e-8)
        write(second, again)
        assert first.read_bytes() == second.read_bytes()


def test_kitti_round_trip(tmp_path: Path) -> None:
    trajectory = random_trajectory()
    poses, times = tmp_path / "poses.txt", tmp_path / "times.txt"
    write_kitti(poses, trajectory)
    times.write_text("".join(f"{ns // 10**9}.{ns % 10**9:09d}\n" for ns in trajectory.stamps_ns))
    again = read_kitti(poses, read_kitti_times(times))
    assert np.array_equal(again.stamps_ns, trajectory.stamps_ns)
    assert np.allclose(again.T_world_camera, trajectory.T_world_camera, atol=1e-7)
    assert len(read_trajectory(poses)) == len(trajectory)
    times.unlink()
    with pytest.raises(ResultError, match="have no times"):
        read_trajectory(poses)


def test_tum_bytes(tmp_path: Path) -> None:
    T = np.eye(4)[None].copy()
    T[0, :3, 3] = (-1e-12, 1.5, -2)
    write_tum(tmp_path / "t", Trajectory(stamps_ns=np.array([33333333]), T_world_camera=T))
    expected = "0.033333333 0.000000000 1.500000000 -2.000000000"
    expected += " 0.000000000 0.000000000 0.000000000 1.000000000\n"
    assert (tmp_path / "t").read_text() == expected


@pytest.mark.parametrize(
    ("line", "message"),
    [
        ("2.0 0 0 0 0 0 1", r":3: 7 fields, expected 8"),
        ("2.0 0 0 0 0 0 0 1 9", r":3: 9 fields, expected 8"),
        ("2.0 nan 0 0 0 0 0 1", r":3: 'nan' is not a finite number"),
        ("2.0 0 0 x 0 0 0 1", r":3: 'x' is not a number"),
        ("2.0 0 0 0 0 0 0 0.5", r":3: the quaternion has length 0.5"),
        ("2.0 0 0 0 0 0 0 0", r":3: the quaternion has length 0"),
        ("1.0 0 0 0 0 0 0 1", r":3: the time 1.000000000 s repeats"),
        ("0.5 0 0 0 0 0 0 1", r":3: the time 0.500000000 s is earlier than"),
        ("later 0 0 0 0 0 0 1", r":3: 'later' is not a time"),
        ("2.0 " + "9" * 500, r":3: 2 fields"),
    ],
)
def test_bad_tum_line_is_named(tmp_path: Path, line: str, message: str) -> None:
    file = tmp_path / "bad.txt"
    file.write_text("# comment\n" + GOOD + line + "\n" + "3.0 0 0 0 0 0 0 1\n")
    with pytest.raises(ResultError, match="bad.txt" + message) as caught:
        read_trajectory(file)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("1,0,0,0,1,0,0\n", "1: 7 fields"),
        ("1.5,0,0,0,1,0,0,0\n", "1: '1.5' is not a time"),
        ("#t\n5,0,0,0,2,0,0,0\n", "2: the quaternion"),
    ],
)
def test_bad_euroc_line_is_named(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "bad.csv"
    file.write_text(text)
    with pytest.raises(ResultError, match=message):
        read_trajectory(file)


def test_kitti_needs_rotations_and_as_many_times(tmp_path: Path) -> None:
    file = tmp_path / "poses.txt"
    file.write_text("2 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(ResultError, match="1: the left 3x3 block is not a rotation"):
        read_kitti(file, np.array([0]))
    file.write_text("1 0 0 0 0 1 0 0 0 0 1 0\n")
    with pytest.raises(ResultError, match="1 poses for 2 times"):
        read_kitti(file, np.array([0, 1]))


def test_files_that_are_no_trajectories(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="no such file"):
        read_tum(tmp_path / "absent")
    with pytest.raises(ResultError, match="folder"):
        read_tum(tmp_path)
    binary = tmp_path / "binary"
    for data in (b"\x80\x81\x00\x01", b"\xff\xfe\x00"):  # the second begins like UTF-16
        binary.write_bytes(data)
        with pytest.raises(ResultError, match="not a text file"):
            read_tum(binary)
    empty = tmp_path / "empty"
    empty.write_text("# nothing\n")
    with pytest.raises(ResultError, match="holds no poses"):
        read_tum(empty)
    assert len(read_tum(empty, allow_empty=True)) == 0
    with pytest.raises(ResultError, match="cannot be written"):
        write_tum(tmp_path / "no" / "folder", random_trajectory(3))


@settings(max_examples=200)
@given(data=st.binary(max_size=200))
def test_any_bytes_give_a_trajectory_or_one_clear_line(
    data: bytes, tmp_path_factory: pytest.TempPathFactory
) -> None:
    file = tmp_path_factory.getbasetemp() / "fuzz"
    file.write_bytes(data)
    message = ""
    try:
        read_trajectory(file, allow_empty=True)
    except ResultError as error:
        message = str(error)
    assert "\n" not in message
