"""A source with inertial samples: its result is in metres and level, or as it was."""

import json
import re
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from inertial_motion import PHONE, Motion, samples_of
from running import NO_MESH, assert_one_line, digests, in_this_process
from sample_files import write_imu_csv

from pliant.algorithms.geometry import align_umeyama, so3_exp
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.algorithms.slam.adjust.inertial_adjustment import CouplingOutcome
from pliant.config import load_config
from pliant.datasets.builtin import builtin_folder
from pliant.formats.ply import read_ply
from pliant.formats.tum import read_tum
from pliant.messages import topics
from pliant.messages.topics import Topic
from pliant.messages.types import CameraStream, Header, Status
from pliant.recording.map_file import MapFile
from pliant.recording.summary import summarise
from pliant.results.folder import CONFIG_NAME, RECORDING_NAME
from pliant_services.processes import BY_NAME
from pliant_services.replay.services import Replay, run_on

pytestmark = pytest.mark.system

SOURCE = "built-in:tabletop?width=320"
QUARTER = (SOURCE, "--every", "4", *NO_MESH)
"""Every fourth frame is enough for all that is tested."""


@pytest.fixture(scope="module")
def samples() -> ImuSamples:
    truth = read_tum(builtin_folder(SOURCE) / "groundtruth.txt")
    motion = Motion(truth.stamps_ns, truth.T_world_camera)
    return samples_of(
        motion, PHONE, np.random.default_rng(1), R_camera_imu=so3_exp(np.array([0.4, 1.0, 2.0])),
        p_camera_imu=np.array([0.02, -0.01, 0.03]), offset_s=0.08,
    )  # fmt: skip


@pytest.fixture(scope="module")
def metric(samples: ImuSamples, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("metric")
    imu = write_imu_csv(folder / "imu.csv", samples)
    done = in_this_process("run", *QUARTER, "--imu", imu, "--output", folder / "result")
    assert done.returncode == 0, done.stderr
    assert "in metres by inertial samples of 7 s" in done.stdout
    assert re.search(r"inertial samples moved \d+ keyframes by [0-9.e-]+ mm", done.stdout)
    return folder / "result"


@pytest.fixture(scope="module")
def refused(samples: ImuSamples, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """With axes that are not those of a sensor."""
    folder = tmp_path_factory.mktemp("refused")
    mirrored = ImuSamples(
        stamps_ns=samples.stamps_ns,
        gyro_rad_s=samples.gyro_rad_s[:, [1, 0, 2]],
        accel_m_s2=samples.accel_m_s2[:, [1, 0, 2]],
    )
    imu = write_imu_csv(folder / "imu.csv", mirrored)
    done = in_this_process("run", *QUARTER, "--imu", imu, "--output", folder / "result")
    assert done.returncode == 0, done.stderr
    assert "inertial samples not used: the axes of the gyro are left-handed" in done.stdout
    assert "the keyframes" not in done.stdout  # one refusal is enough
    return folder / "result"


def test_the_result_is_in_metres_and_level(metric: Path) -> None:
    report = json.loads((metric / "report.json").read_text())
    assert report["scale_is_metric"]
    assert report["z_is_up"]
    assert report["coupling"]["keyframes"] == report["keyframes"]
    assert 0.0 < report["coupling"]["moved_mm"] < 10.0
    assert report["coupling"]["refusal"] == ""
    found, truth = (
        read_tum(metric / "trajectory.txt"),
        read_tum(builtin_folder(SOURCE) / "groundtruth.txt"),
    )
    rows = np.searchsorted(truth.stamps_ns, found.stamps_ns)
    scale, R, t = align_umeyama(found.positions, truth.positions[rows], with_scale=True)
    assert abs(scale - 1.0) < 3.0 * report["scale"]["sigma"] < 0.04
    assert np.degrees(np.arccos(R[2, 2])) < 0.3
    turned = R @ found.T_world_camera[:, :3, :3]
    assert np.abs(turned - truth.T_world_camera[rows, :3, :3]).max() < 0.01
    points = scale * read_ply(metric / "points.ply").points @ R.T + t
    surface = read_ply(builtin_folder(SOURCE) / "surface.ply").points
    low, high = np.percentile(points, (2.0, 98.0), axis=0)
    assert (low > surface.min(axis=0) - 0.1).all()
    assert (high < surface.max(axis=0) + 0.1).all()
    assert MapFile(metric).header.level
    assert "<th>vertical</th><td>z is up</td>" in (metric / "report.html").read_text()
    assert "in metres: scale +- " in (metric / "calibration.yaml").read_text()


def test_a_refusal_leaves_the_result_as_it_is(refused: Path, tmp_path: Path) -> None:
    report = json.loads((refused / "report.json").read_text())
    assert not report["scale_is_metric"]
    assert report["scale"] is None
    assert report["inertial_refusal"].startswith("the axes of the gyro are left-handed")
    assert report["coupling"]["refusal"] == "they do not fit the keyframes"
    assert report["coupling"]["moved_mm"] == 0.0
    assert not (refused / "scale.yaml").exists()
    done = in_this_process("run", *QUARTER, "--output", tmp_path / "without")
    assert done.returncode == 0, done.stderr
    assert digests(refused) == digests(tmp_path / "without")
    assert json.loads((tmp_path / "without" / "report.json").read_text())["coupling"] is None


def test_samples_after_the_last_frame_move_the_keyframes(metric: Path) -> None:
    """As in recordings of live sources by earlier releases: frames are mapped without the gyro."""
    path, service = metric / RECORDING_NAME, BY_NAME["bundle_adjustment"]
    recorded = Replay(path, summarise(path), [service], load_config(metric / CONFIG_NAME))
    inputs = {topic: recorded.messages(topic) for topic in (*service.inputs, topics.IMU)}
    (stream,) = recorded.messages(topics.STREAM)
    assert isinstance(stream, CameraStream)
    inputs[topics.STREAM] = iter([replace(stream, sensors_last=True)])
    counters = dict[str, float]()

    def take(_: Topic, message: Header) -> None:
        if isinstance(message, Status):
            counters.update(zip(message.counters, message.values.tolist(), strict=True))

    run_on(service, inputs, load_config(metric / CONFIG_NAME), take)
    assert counters["gyro_frames"] == 0
    assert counters["coupling_outcome"] == CouplingOutcome.MOVED
    assert 0.0 < counters["coupling_moved_m"] < 0.01


def test_samples_of_a_file_come_later(refused: Path, metric: Path) -> None:
    before = digests(refused)
    done = in_this_process("scale", refused, "--imu", "recorded")
    assert_one_line(done, "the axes of the gyro are left-handed")
    assert digests(refused) == before
    done = in_this_process("scale", refused, "--imu", metric.parent / "imu.csv")
    assert done.returncode == 0, done.stderr
    assert "and z is up" in done.stdout
    after, during = (read_tum(folder / "trajectory.txt") for folder in (refused, metric))
    np.testing.assert_allclose(after.T_world_camera, during.T_world_camera, atol=2e-3)


def test_more_samples_than_fit_in_the_window_of_the_bus(tmp_path: Path) -> None:
    """Hours of them, of a sender that waits for its readers: each takes them in its order."""
    truth = read_tum(builtin_folder("built-in:tiny?frames=12") / "groundtruth.txt")
    rng, count = np.random.default_rng(0), 10_000
    many = ImuSamples(
        stamps_ns=np.linspace(truth.stamps_ns[0], truth.stamps_ns[-1], count).astype(np.int64),
        gyro_rad_s=0.1 * rng.standard_normal((count, 3)),
        accel_m_s2=rng.normal((0.0, 0.0, 9.81), 1.0, (count, 3)),
    )
    imu = write_imu_csv(tmp_path / "imu.csv", many)
    done = in_this_process(
        "run", "built-in:tiny?frames=12", "--imu", imu, *NO_MESH, "--set", "bus.window=1",
        "--output", tmp_path / "result",
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert read_tum(tmp_path / "result" / "trajectory.txt").stamps_ns.size > 0
