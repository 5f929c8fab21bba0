"""Scale, vertical and sensor from inertial samples, of true motions with noise and of runs.

The samples are exact but for the noise and the walking biases of a sensor: derivatives of splines
through the true poses, at any rotation, lever arm and offset in time.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from inertial_motion import ADIS16448, PHONE, Motion, Sensor, samples_of

from benchmarks.drone_flights import flights
from benchmarks.in_process import process
from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import align_umeyama, so3_exp, so3_log
from pliant.algorithms.inertial.alignment import InertialAlignment, Refusal, align_inertial
from pliant.algorithms.inertial.samples import ImuSamples
from pliant.config import load_config
from pliant.datasets import open_source
from pliant.datasets.base import Dataset
from pliant.datasets.builtin import builtin_folder
from pliant.formats.trajectory_files import read_trajectory
from pliant.map_history import MapHistory
from pliant.trajectory import Trajectory, associate

SENSORS = {"ADIS16448": ADIS16448, "phone": PHONE}
_NOISE_M, _NOISE_DEG = 0.002, 0.1
"""Of poses: half of the variance is white, the other half correlated over a second."""
_MOST_OFFSET_S = 3.0
_LEVER_M = 0.04


@dataclass(frozen=True, kw_only=True)
class Case:
    """Estimated poses, in a unit and a world of their own, and the true motion."""

    name: str
    poses: Trajectory
    truth: Trajectory
    kind: str


def true_motions(folder: Path, only: Sequence[str]) -> Iterator[tuple[str, Trajectory]]:
    """The motions of a folder of TUM files, by name."""
    for file in sorted(folder.glob("*.txt")):
        if not only or file.stem in only:
            yield file.stem, read_trajectory(file)


def measure(
    motions: Path | None, *, only: Sequence[str], runs: Sequence[str], frames: int, seeds: int
) -> Iterator[str]:
    """The worst of all seeds, a row for each motion and sensor; then what wrong samples come to.

    runs: built-in sources and flights whose trajectory is what Pliant estimates.
    """
    names = ("motion", "poses", "s", "sensor", "scale", "its +-", "vertical", "offset", "rotation")
    yield markdown_header(names)
    for case in _cases(motions, only, runs, frames):
        for sensor in SENSORS:
            yield markdown_row(_row(case, sensor, seeds))
    yield ""
    yield markdown_header(("samples", "outcome"))
    name = "tabletop"
    truth = read_trajectory(builtin_folder(f"built-in:{name}") / "groundtruth.txt")
    for row in wrong(truth):
        yield markdown_row(row)


def _cases(
    motions: Path | None, only: Sequence[str], runs: Sequence[str], frames: int
) -> Iterator[Case]:
    known = [] if motions is None else list(true_motions(motions, only))
    for name in ("room", "tabletop", "corridor", "court"):
        file = builtin_folder(f"built-in:{name}") / "groundtruth.txt"
        if not only or name in only:
            known.append((name, read_trajectory(file)))
    for name, truth in known:
        yield Case(name=name, poses=truth, truth=truth, kind="true, with noise")
    for name in runs:
        dataset = source_of(name, motions, frames)
        truth_file = dataset.ground_truth_path
        assert truth_file is not None
        history = MapHistory()
        for _ in process(dataset, load_config(None, []), history):
            pass
        found = history.trajectory_in(history.longest_segment(), history.final())
        yield Case(name=name, poses=found, truth=read_trajectory(truth_file), kind="estimated")


def source_of(name: str, motions: Path | None, frames: int) -> Dataset:
    """A flight along one of the motions, or a built-in scene."""
    if motions is None or not (motions / f"{name}.txt").exists():
        return open_source(name if name.startswith("built-in:") else f"built-in:{name}")
    return next(flights(motions, [name], frames))


def _row(case: Case, sensor: str, seeds: int) -> list[str]:
    worst, sigma = np.zeros(4), 0.0
    for seed in range(seeds):
        errors, found = _errors(case, SENSORS[sensor], seed)
        if isinstance(found, Refusal):
            return [case.name, case.kind, "", sensor, found.reason, "", "", "", ""]
        worst, sigma = np.maximum(worst, np.abs(errors)), max(sigma, found.scale_sigma)
    seconds = 1e-9 * float(case.poses.stamps_ns[-1] - case.poses.stamps_ns[0])
    scale, vertical, offset, rotation = worst.tolist()
    return [
        *(case.name, case.kind, f"{seconds:.0f}", sensor, f"{scale:.2%}", f"{sigma:.2%}"),
        *(f"{vertical:.2f} deg", f"{1e3 * offset:.2f} ms", f"{rotation:.2f} deg"),
    ]


def _errors(case: Case, sensor: Sensor, seed: int) -> tuple[F64, InertialAlignment | Refusal]:
    """Of the scale as a share, of the vertical in degrees, of the offset in seconds, and of the
    rotation in degrees."""
    rng = np.random.default_rng(seed)
    motion = Motion(case.truth.stamps_ns, case.truth.T_world_camera)
    R_camera_imu, lever = so3_exp(2.0 * rng.normal(size=3)), _LEVER_M * rng.normal(size=3)
    offset_s = rng.uniform(-_MOST_OFFSET_S, _MOST_OFFSET_S)
    samples = samples_of(
        motion, sensor, rng, R_camera_imu=R_camera_imu, p_camera_imu=lever, offset_s=offset_s
    )
    poses = case.poses.T_world_camera
    if case.kind != "estimated":
        poses = _as_if_estimated(case.poses, rng)
    found = align_inertial(case.poses.stamps_ns, poses, samples)
    if isinstance(found, Refusal):
        return np.zeros(4), found
    rows, true_rows = associate(case.poses.stamps_ns, case.truth.stamps_ns)
    scale, R, _ = align_umeyama(
        poses[rows, :3, 3], case.truth.positions[true_rows], with_scale=True
    )
    up = float(np.clip((R @ found.up)[2], -1.0, 1.0))
    turned = np.linalg.norm(so3_log(found.R_camera_imu.T @ R_camera_imu))
    errors = [found.metres_per_unit / scale - 1.0, np.degrees(np.arccos(up))]
    return np.array([*errors, found.time_offset_s - offset_s, np.degrees(turned)]), found


def _as_if_estimated(truth: Trajectory, rng: np.random.Generator) -> F64:
    """Poses with noise, in any unit and world."""
    T = truth.T_world_camera.copy()
    times = 1e-9 * (truth.stamps_ns - truth.stamps_ns[0])
    T[:, :3, :3] = T[:, :3, :3] @ so3_exp(np.radians(_NOISE_DEG) * _noise(times, rng))
    T[:, :3, 3] += _NOISE_M * _noise(times, rng)
    world, unit = so3_exp(2.0 * rng.normal(size=3)), float(np.exp(rng.normal()))
    T[:, :3, :3] = world @ T[:, :3, :3]
    T[:, :3, 3] = T[:, :3, 3] @ world.T / unit
    return T


def _noise(times_s: F64, rng: np.random.Generator) -> F64:
    """(N, 3) of unit variance."""
    white, slow = rng.normal(size=(2, len(times_s), 3))
    kept = np.exp(-np.diff(times_s))
    for row in range(1, len(slow)):
        share = kept[row - 1]
        slow[row] = share * slow[row - 1] + np.sqrt(1.0 - share**2) * slow[row]
    return np.sqrt(0.5) * (white + slow)


def wrong(truth: Trajectory) -> Iterator[list[str]]:
    """Samples that are not those of the video, and what is said."""
    rng = np.random.default_rng(0)
    motion = Motion(truth.stamps_ns, truth.T_world_camera)
    still = truth.T_world_camera.copy()
    still[:] = truth.T_world_camera[0]
    line = truth.T_world_camera.copy()
    line[:, :3, 3] = still[0, :3, 3] + np.outer(motion.times_s, [0.2, 0.1, 0.0])
    turned = truth.T_world_camera[::-1].copy()

    def samples(T: F64) -> ImuSamples:
        return samples_of(
            Motion(truth.stamps_ns, T), PHONE, rng, R_camera_imu=so3_exp(np.array([1.0, 2.0, 0.5])),
            p_camera_imu=np.array([0.02, 0.03, -0.01]), offset_s=0.1,
        )  # fmt: skip

    def poses(T: F64) -> F64:
        return _as_if_estimated(Trajectory(stamps_ns=truth.stamps_ns, T_world_camera=T), rng)

    own, own_poses = samples(truth.T_world_camera), poses(truth.T_world_camera)
    gaps = (np.arange(len(own.stamps_ns)) % 130) > 40
    swapped = [1, 0, 2]
    cases = (
        ("its own", own_poses, own),
        ("of another video (backwards)", own_poses, samples(turned)),
        (
            "axes swapped, left-handed",
            own_poses,
            replace(
                own, gyro_rad_s=own.gyro_rad_s[:, swapped], accel_m_s2=own.accel_m_s2[:, swapped]
            ),
        ),
        (
            "axes of the accelerometer alone swapped",
            own_poses,
            replace(own, accel_m_s2=own.accel_m_s2[:, swapped]),
        ),
        ("still camera, moving sensor", poses(still), own),
        ("constant velocity", poses(line), samples(line)),
        (
            "a third missing, in gaps of 0.4 s",
            own_poses,
            ImuSamples(**{name: values[gaps] for name, values in vars(own).items()}),
        ),
    )
    for name, T, given in cases:
        found = align_inertial(truth.stamps_ns, T, given)
        told = "refused: " + found.reason if isinstance(found, Refusal) else _accepted(found)
        yield [name, told]


def _accepted(found: InertialAlignment) -> str:
    return f"accepted: scale +- {found.scale_sigma:.1%}"
