"""Compares a result with ground truth, like ``pliant eval``."""

from pathlib import Path

from pliant.api.result import Result
from pliant.datasets.base import is_builtin
from pliant.evaluation.run_evaluation import (
    Evaluation,
    evaluate_result,
    evaluate_trajectory,
)
from pliant.evaluation.time_offset import better_offset, offset_ns, shifted
from pliant.formats import trajectory_files
from pliant.trajectory import Trajectory


def evaluate(
    result: Result | Trajectory | str | Path,
    groundtruth: Trajectory | str | Path,
    *,
    times: str | Path | None = None,
    frames: int | None = None,
    offset: float | str = 0.0,
) -> Evaluation:
    """Compare a trajectory with ground truth, after an alignment with scale::

        evaluation = pliant.evaluate("results/clip", "sequence/groundtruth.txt")
        evaluation.final.ate_m.rmse, evaluation.final.success_rate, evaluation.online
        evaluation.better  # a time offset that fits ground truth far better, or None

    result: a ``Result``, its folder, a trajectory file or a ``Trajectory``.    groundtruth: a file
    for ``read_trajectory``, its folder, ``built-in:NAME`` or a ``Trajectory``.    times: file with
    the times of KITTI's poses.    frames: number of frames of the sequence, if there is no
    report.json.    offset: added to the times of the poses, in seconds, or in frames ("3f").

    Raises ResultError.
    """
    truth = (
        groundtruth
        if isinstance(groundtruth, Trajectory)
        else read_trajectory(groundtruth, times=times)
    )
    if isinstance(result, Trajectory):
        by_ns = offset_ns(str(offset), result)
        moved = shifted(result, by_ns)
        return Evaluation(
            result="given poses",
            groundtruth=str(groundtruth) if isinstance(groundtruth, str | Path) else "given poses",
            initialisation_retries=None,
            final=evaluate_trajectory(moved, truth, frames=frames),
            online=None,
            offset_s=1e-9 * by_ns,
            better=better_offset(moved, truth),
        )
    return evaluate_result(
        result.path if isinstance(result, Result) else Path(result),
        groundtruth=truth,
        times=None if times is None else Path(times),
        frames=frames,
        offset=str(offset),
    )


def read_trajectory(path: str | Path, *, times: str | Path | None = None) -> Trajectory:
    """Read a TUM, EuRoC or KITTI trajectory; the first line determines the format::

        truth = pliant.read_trajectory("sequence/groundtruth.txt")
        truth.stamps_ns, truth.positions, truth.T_world_camera

    path: the file, the folder of a sequence that has one, or ``built-in:NAME``.    times: file with
    the times of KITTI's poses.  Raises ResultError.
    """
    if is_builtin(str(path)):
        from pliant.datasets.builtin import builtin_folder  # which may render it

        path = builtin_folder(str(path))
    return trajectory_files.read_trajectory(
        Path(path), times=None if times is None else Path(times)
    )
