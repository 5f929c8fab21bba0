"""Evaluate a run: its final and its online trajectory by the criteria of VITAMIN-E section 5.2."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.errors import ResultError
from pliant.evaluation.criteria import (
    MIN_POSES,
    ErrorStatistics,
    RelativeErrors,
    Similarity,
    absolute_errors,
    align,
    frame_pairs,
    path_length,
    relative_errors,
    second_pairs,
)
from pliant.evaluation.run_report import RunReport, read_run_report
from pliant.evaluation.time_offset import TimeOffset, better_offset, offset_ns, shifted
from pliant.formats.trajectory_files import read_trajectory
from pliant.formats.tum import read_tum
from pliant.results.folder import ONLINE_NAME
from pliant.trajectory import (
    MAX_DIFFERENCE_NS,
    Trajectory,
    associate,
)

MIN_SUCCESS = 0.9
"""Below this share of localised frames a trial is a failure and gets no accuracy (section 5.2)."""
MIN_COMPARED = 0.9
"""Where a smaller share of the poses has a true pose, ground truth may be of another recording."""
MAX_SHARE = 0.5
"""With an error above this share of the spread of the true positions it may be, too."""

FINAL_NAME = "trajectory.txt"


@dataclass(frozen=True, kw_only=True)
class TrajectoryEvaluation:
    """One trajectory against ground truth.

    To align each map segment by itself would flatter a run that was lost: only the longest is
    evaluated (it is what trajectory.txt holds), and the frames of those that were never joined to
    it count as not localised.  Online poses stay in the segment of their time.

    kind: "final" (after all corrections) or "online" (each pose as known when its frame was done).
    frames: of the whole sequence; None if unknown, without a success rate.
    localised: frames with a pose in the longest segment.      other_segments: poses left out.
    success: True, False, or None (unknown).     reason: why there is no accuracy, else "".
    matched: localised frames that have a true pose within the time limit: the others have no error.
    ate_m: of all matched frames, after alignment.      path_m: length of their true path.
    spread_m: RMS distance of their true positions from the mean of them.
    rpe_frame, rpe_second: from one frame to the next, and over one second.
    times_s, errors_m: (M,) error over time (Fig. 4), seconds since the first pose; also there for
        a failure, as in the paper's figure, and empty where no alignment exists.
    """

    kind: str
    frames: int | None
    localised: int
    other_segments: int
    segments: int
    success_rate: float | None
    success: bool | None
    matched: int
    reason: str
    ate_m: ErrorStatistics | None
    path_m: float | None
    spread_m: float | None
    rpe_frame: RelativeErrors | None
    rpe_second: RelativeErrors | None
    alignment: Similarity | None
    times_s: F64
    errors_m: F64

    @property
    def ate_percent_of_path(self) -> float | None:
        """ATE RMSE in percent of the length of the true path."""
        if self.ate_m is None or not self.path_m:
            return None
        return 100.0 * self.ate_m.rmse / self.path_m

    @property
    def unlike(self) -> bool:
        """Whether the error is of the size of the motion, as with another recording's ground truth.

        What is aligned with poses that have nothing to do with it shrinks to a point.
        """
        return bool(self.ate_m and self.spread_m and self.ate_m.rmse > MAX_SHARE * self.spread_m)

    @property
    def apart(self) -> bool:
        """Whether there is no accuracy only because poses and ground truth do not overlap in time.

        A failure has none in any case, and fewer than three poses cannot be aligned.
        """
        return self.matched < MIN_POSES <= self.localised and self.success is not False

    @property
    def partly_compared(self) -> bool:
        """Whether too many poses lack a true pose: the user should check the ground truth."""
        few = self.matched < MIN_COMPARED * self.localised
        return few and self.localised >= MIN_POSES and not self.apart


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """One run: both trajectories, and how often a start of its map failed before.

    offset_s: was added to the times of the poses.   better: a further offset with which the final
    ones fit ground truth far better.
    """

    result: str
    groundtruth: str
    initialisation_retries: int | None
    final: TrajectoryEvaluation
    online: TrajectoryEvaluation | None
    better: TimeOffset | None = None
    offset_s: float = 0.0


def evaluate_trajectory(
    estimate: Trajectory,
    truth: Trajectory,
    *,
    kind: str = "final",
    frames: int | None = None,
    other_segments: Sequence[int] = (),
    origin_ns: int | None = None,
) -> TrajectoryEvaluation:
    """Compare an estimate with ground truth; see TrajectoryEvaluation for what counts.

    frames: of the whole sequence.      other_segments: poses in each map segment but this one,
    which is the longest.       origin_ns: time 0 of times_s; the first pose where None.
    Raises ResultError when there are more poses than frames.
    """
    poses = len(estimate) + sum(other_segments)
    if frames is not None and poses > frames:
        raise ResultError(f"{poses} poses for a sequence of {frames} frames")
    part = estimate
    a, b = associate(part.stamps_ns, truth.stamps_ns)
    matched, true_part = part.select(a), truth.select(b)

    alignment, errors, reason = None, np.zeros(0), ""
    try:
        alignment = align(matched.T_world_camera, true_part.T_world_camera)
        aligned = alignment.apply_poses(matched.T_world_camera)
        errors = absolute_errors(aligned, true_part.T_world_camera)
    except ValueError as error:
        aligned = matched.T_world_camera
        reason = _no_alignment(str(error), part, len(a))
    rate = None if not frames else len(part) / frames
    success = None if rate is None else rate >= MIN_SUCCESS
    if rate is not None and not success and len(part):
        reason = f"success rate {100.0 * rate:.1f} % is below {100.0 * MIN_SUCCESS:.0f} %"
    accuracy = _Accuracy()
    if not reason:
        accuracy = _Accuracy.of(matched.stamps_ns, aligned, true_part.T_world_camera)
    if origin_ns is None and len(estimate):
        origin_ns = int(estimate.stamps_ns[0])
    return TrajectoryEvaluation(
        kind=kind,
        frames=frames,
        localised=len(part),
        other_segments=sum(other_segments),
        segments=len(other_segments) + min(len(part), 1),
        success_rate=rate,
        success=success,
        matched=len(a),
        reason=reason,
        ate_m=accuracy.ate_m,
        path_m=accuracy.path_m,
        spread_m=accuracy.spread_m,
        rpe_frame=accuracy.rpe_frame,
        rpe_second=accuracy.rpe_second,
        alignment=alignment,
        times_s=(matched.stamps_ns - (origin_ns or 0))[: len(errors)] / 1e9,
        errors_m=errors,
    )


def _no_alignment(why: str, part: Trajectory, matched: int) -> str:
    if not len(part):
        return "no frame was localised"
    if matched < MIN_POSES:
        limit = MAX_DIFFERENCE_NS / 1e9
        return f"only {matched} of {len(part)} poses have a ground-truth pose within {limit:g} s"
    return why


@dataclass(frozen=True)
class _Accuracy:
    ate_m: ErrorStatistics | None = None
    path_m: float | None = None
    spread_m: float | None = None
    rpe_frame: RelativeErrors | None = None
    rpe_second: RelativeErrors | None = None

    @staticmethod
    def of(stamps_ns: I64, aligned: F64, truth: F64) -> "_Accuracy":
        return _Accuracy(
            ErrorStatistics.of(absolute_errors(aligned, truth)),
            path_length(truth),
            float(np.linalg.norm(truth[:, :3, 3].std(axis=0))),
            relative_errors(aligned, truth, frame_pairs(stamps_ns), step="frame"),
            relative_errors(aligned, truth, second_pairs(stamps_ns), step="1 s"),
        )


def _other_segments(trajectory: Trajectory, report: RunReport, path: Path) -> list[int]:
    """Poses in each segment of report.json but the longest, which is the trajectory.

    Raises ResultError if the trajectory is not the longest of them.
    """
    counts = sorted(segment.frames for segment in report.segments or () if segment.frames)
    if report.segments is not None and len(trajectory) != (counts[-1] if counts else 0):
        raise ResultError(
            f"{path}: holds {len(trajectory)} poses, but the longest segment of report.json holds "
            f"{(counts[-1] if counts else 0)}: the two belong to different runs"
        )
    return counts[:-1]


def evaluate_result(
    result: Path,
    *,
    groundtruth: Path | Trajectory,
    times: Path | None = None,
    frames: int | None = None,
    offset: str = "",
) -> Evaluation:
    """Evaluate a result folder (or one trajectory file) against a ground truth.

    result: a folder with trajectory.txt, and where it has them trajectory_online.txt and
        report.json; or a trajectory file of any known format.
    groundtruth: a trajectory, a file of any known format, or a folder with groundtruth.txt.
        times: the times of a KITTI ground truth.
    frames: of the sequence, where report.json has no number.
    offset: is added to the times of the poses: seconds ("0.1"), or frames ("3f").
    Raises ResultError with one line where a file is missing or not what it should be.
    """
    truth = (
        groundtruth
        if isinstance(groundtruth, Trajectory)
        else read_trajectory(groundtruth, times=times)
    )
    true_name = "given poses" if isinstance(groundtruth, Trajectory) else str(groundtruth)
    if not result.is_dir():
        estimate = read_trajectory(result, times=times, allow_empty=True)
        by_ns = offset_ns(offset or "0", estimate)
        estimate = shifted(estimate, by_ns)
        final = evaluate_trajectory(estimate, truth, frames=frames)
        return Evaluation(
            result=str(result),
            groundtruth=true_name,
            initialisation_retries=None,
            final=final,
            online=None,
            better=better_offset(estimate, truth),
            offset_s=1e-9 * by_ns,
        )
    report = read_run_report(result)
    estimate = read_tum(result / FINAL_NAME, allow_empty=True)
    by_ns = offset_ns(offset or "0", estimate)
    estimate = shifted(estimate, by_ns)
    others = _other_segments(estimate, report, result / FINAL_NAME)
    evaluations: dict[str, TrajectoryEvaluation] = {}
    for kind, path in (("final", result / FINAL_NAME), ("online", result / ONLINE_NAME)):
        if path.exists():
            evaluations[kind] = evaluate_trajectory(
                estimate if kind == "final" else shifted(read_tum(path, allow_empty=True), by_ns),
                truth,
                kind=kind,
                frames=report.frames if frames is None else frames,
                other_segments=others,
                origin_ns=int(estimate.stamps_ns[0]) if len(estimate) else None,
            )
    return Evaluation(
        result=str(result),
        groundtruth=true_name,
        initialisation_retries=report.initialisation_retries,
        final=evaluations["final"],
        online=evaluations.get("online"),
        better=better_offset(estimate, truth),
        offset_s=1e-9 * by_ns,
    )
