"""Behind ``pliant scale``: a result in metres."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

from pliant.datasets.measured.readers import IMU_READERS, read_named
from pliant.errors import ResultError
from pliant.export.export import exports_in
from pliant.recording import parts
from pliant.recording.measured import imu_of
from pliant.results.folder import RECORDING_NAME, check_free, settle_killed, written
from pliant.results.inertial import by_samples
from pliant.results.known_scale import MetricRecording, Scale
from pliant.results.run import Run, read_run
from pliant.results.surfel_frames import has_surfels
from pliant.results.write import write_rigid_results
from pliant.scale.gps import from_gps
from pliant.scale.lengths import from_depth, from_points
from pliant.scale.marker import from_marker

_RECORDED = "recorded"
_WITHOUT_LENGTHS = ("images", "overlay", "picture", "overview")
"""Kinds of export that are the same in any unit."""


@dataclass(frozen=True, kw_only=True)
class Known:
    """A known length in the scene; exactly one is given.

    points: two points of the map, and the metres between them.   marker: side of the markers.
    depth: a source with depth maps.   gps: the satellite fixes of the run's source.
    imu: a file of inertial samples, or "recorded": those of the recording.
    """

    points: tuple[Sequence[float], Sequence[float], float] | None = None
    marker: float | None = None
    depth: str | None = None
    gps: bool = False
    imu: str | None = None


def scale_result(result: Path, known: Known) -> Iterator[str]:
    """Measure the scale and write the files of a result folder in metres; return the length of a
    unit, and the exports in the folder that are not in metres.

    An earlier scale is replaced.  Raises PliantError, and then has written nothing.
    """
    given = [known.points, known.marker, known.depth, known.imu]
    if sum(each is not None for each in given) + known.gps != 1:
        options = "--points, --marker, --depth, --gps, --imu"
        raise ResultError(f"no known length given: pass one of {options}")
    settle_killed(result)
    if not parts.exists(result / RECORDING_NAME):
        raise ResultError(f"{result}: not a result folder with a recording")
    if has_surfels(result / RECORDING_NAME):
        raise ResultError(
            f"{result}: a deforming scene: only results of rigid scenes can be scaled"
        )
    check_free(result, elsewhere=False)
    with written(result, force=True):
        recording = MetricRecording(result / RECORDING_NAME)
        run = read_run(recording.path)
        if run.history.longest_segment() < 0:
            raise ResultError(f"{result}: the run has no map to scale")
        found = _measure(recording, run, known)
        before = recording.scale
        write_rigid_results(result, found if before is None else before.times(found))
    sure = f", +- {found.sigma:.1%}" if found.sigma >= 0.001 else ""
    unit = "a unit of the map" if before is None else "a metre so far"
    level = found.level
    up = "" if level is None else f", and z is up (+- {level.sigma_deg:.2f} degrees)"
    yield (
        f"{unit} is {found.metres_per_unit:.4g} m ({found.source}{sure}): {result}/ is in "
        f"metres{up}"
    )
    exports = exports_in(result, but=_WITHOUT_LENGTHS)
    if exports:
        yield f"exports in the old unit: {', '.join(exports)}: export again with --force"


def _measure(recording: MetricRecording, run: Run, known: Known) -> Scale:
    if known.points is not None:
        return from_points(run, *known.points)
    if known.marker is not None:
        return from_marker(recording, run, known.marker)
    if known.gps:
        return from_gps(recording, run)
    if known.imu is not None:
        return _from_imu(recording, run, known.imu)
    assert known.depth is not None
    return from_depth(recording, run, known.depth)


def _from_imu(recording: MetricRecording, run: Run, file: str) -> Scale:
    """Raises PliantError."""
    recorded = file == _RECORDED
    where = str(recording.path) if recorded else file
    samples = imu_of(recording) if recorded else read_named(Path(file), IMU_READERS, "--imu").imu
    if not len(samples.stamps_ns):
        raise ResultError(f"{where}: has no inertial samples: pass a file of them, --imu FILE")
    found = by_samples(run.history, samples)
    if isinstance(found, str):
        raise ResultError(f"{where}: {found}")
    return found
