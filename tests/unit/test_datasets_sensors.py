"""Inertial samples and satellite fixes in bags and MCAP files."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from recorded_messages import (
    COUNT,
    START_NS,
    STEP_NS,
    Messages,
    Ros,
    imu,
    usual,
    write_ros1_bag,
    write_ros2_bag,
    write_ros_mcap,
)

from pliant.datasets import open_source
from pliant.datasets.measured.base import Measurements
from pliant.datasets.measured.found import measurements_of
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError

Write = Callable[[Path, Ros, Messages], None]
KINDS = [
    pytest.param("a.bag", 1, write_ros1_bag, id="ros1"),
    pytest.param("a", 2, write_ros2_bag, id="ros2"),
    pytest.param("a.mcap", 2, write_ros_mcap, id="mcap"),
]


def fix(ros: Ros, index: int, status: int = 0) -> Any:
    return ros.types["sensor_msgs/msg/NavSatFix"](
        header=ros.header(index),
        status=ros.types["sensor_msgs/msg/NavSatStatus"](status=status, service=1),
        latitude=47.0 + index,
        longitude=8.5,
        altitude=412.0,
        position_covariance=np.diag([4.0, 9.0, 16.0]).reshape(-1),
        position_covariance_type=2,
    )


def found_in(place: Path, **options: str) -> Measurements:
    spec = SourceSpec(location=str(place), **options)  # type: ignore[arg-type]
    return measurements_of(spec, open_source(spec))


@pytest.mark.parametrize(("name", "release", "write"), KINDS)
def test_the_only_topics_are_read(tmp_path: Path, name: str, release: int, write: Write) -> None:
    ros = Ros(release)
    sensors = {
        "/imu/data": [imu(ros, i) for i in range(8)],
        "/fix": [fix(ros, 0), fix(ros, 1, status=-1), fix(ros, 2)],
    }
    write(tmp_path / name, ros, usual(ros) | sensors)
    found = found_in(tmp_path / name)
    assert found.imu.stamps_ns.tolist() == [START_NS + i * STEP_NS for i in range(8)]
    assert found.imu.gyro_rad_s[3].tolist() == [0.75, 0.5, 0.0]
    assert found.imu.accel_m_s2[3].tolist() == [0.0, 9.5, 1.0]
    assert found.gps.latitude_deg.tolist() == [47.0, 49.0]
    assert found.gps.sigma_m[0].tolist() == [2.0, 3.0, 4.0]


def test_several_topics_are_named_and_one_is_chosen(tmp_path: Path) -> None:
    ros = Ros(2)
    two = {
        "/imu/a": [imu(ros, i) for i in range(8)],
        "/imu/b": [imu(ros, i, 0.125) for i in range(8)],
    }
    write_ros_mcap(tmp_path / "a.mcap", ros, usual(ros) | two)
    found = found_in(tmp_path / "a.mcap")
    assert not len(found.imu.stamps_ns)
    assert "choose one with --imu: /imu/a, /imu/b" in found.notes[0]
    assert found_in(tmp_path / "a.mcap", imu="/imu/b").imu.gyro_rad_s[0, 1] == 0.125
    with pytest.raises(DatasetError, match="--imu /imu/c: neither a file nor a topic"):
        found_in(tmp_path / "a.mcap", imu="/imu/c")


def test_gyro_and_accelerometer_in_topics_of_their_own(tmp_path: Path) -> None:
    ros = Ros(2)
    apart = {
        "/camera/gyro/sample": [imu(ros, i) for i in range(16)],
        "/camera/accel/sample": [imu(ros, 2 * i, 99.0) for i in range(8)],
    }
    write_ros_mcap(tmp_path / "a.mcap", ros, usual(ros) | apart)
    found = found_in(tmp_path / "a.mcap").imu
    assert found.gyro_rad_s[:, 1].tolist() == [0.5] * 16
    assert found.accel_m_s2[:, 1].tolist() == [9.5] * 16


def test_without_sensors_there_is_no_note(tmp_path: Path) -> None:
    ros = Ros(2)
    write_ros_mcap(tmp_path / "a.mcap", ros, usual(ros))
    assert not found_in(tmp_path / "a.mcap").notes
    assert len(list(open_source(str(tmp_path / "a.mcap")))) == COUNT
