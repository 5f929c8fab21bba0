"""What the other sensors of a source measured: of the files that are named, or that lie with it."""

from pathlib import Path

from pliant.datasets import formats
from pliant.datasets.base import Dataset
from pliant.datasets.measured.base import Measurements
from pliant.datasets.measured.readers import GPS_READERS, IMU_READERS, read_named
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError, PliantError

_NEAR_NS = 3_600 * 10**9
"""A file that begins or ends within this of the first image has the clock of the images."""


def measurements_of(spec: SourceSpec, dataset: Dataset) -> Measurements:
    """What other sensors measured, on the clock of the images, or off it by an unknown constant.

    dataset: the source of ``spec``, opened.
    What a user named is read or refused.  What only lies with the source costs no run: a note says
    what is wrong with it.    Raises DatasetError.
    """
    kind = next(kind for kind in formats().values() if kind.recognises(spec.location))
    named = {"imu": spec.imu, "gps": spec.gps}
    topics = {key: kind.has_topics and not Path(name).exists() for key, name in named.items()}
    files = {key: name for key, name in named.items() if name and not topics[key]}
    if files and dataset.is_live:
        raise DatasetError(f"{spec.location}: is live: leave out --imu and --gps")
    found = Measurements()
    try:
        found = kind.sensors(spec)
    except PliantError as error:
        if any(named.values()):
            raise
        found = Measurements(imu_notes=(str(error),))
    if "imu" in files:
        imu = read_named(Path(spec.imu), IMU_READERS, "--imu")
        if not len(imu.imu.stamps_ns):
            raise DatasetError(f"--imu {spec.imu}: has no inertial samples")
        found = _on_clock(imu.without_gps(), dataset).and_those_of(found.without_imu())
    if "gps" in files:
        gps = read_named(Path(spec.gps), GPS_READERS, "--gps")
        if not len(gps.gps.stamps_ns):
            raise DatasetError(f"--gps {spec.gps}: has no satellite fixes")
        found = _on_clock(gps.without_imu(), dataset).and_those_of(found.without_gps())
    return found


def _on_clock(found: Measurements, dataset: Dataset) -> Measurements:
    """On the clock of the images; of a file with another clock, the first sample is at the first
    image."""
    origin = dataset
    while (inner := getattr(origin, "source", None)) is not None:
        origin = inner
    stamps = found.imu.stamps_ns if len(found.imu.stamps_ns) else found.gps.stamps_ns
    frame = next(iter(origin), None)
    if frame is None or not len(stamps):
        return found
    first, last = int(stamps[0]), int(stamps[-1])
    near = first - _NEAR_NS <= frame.stamp_ns <= last + _NEAR_NS
    return found if near else found.later(frame.stamp_ns - first)
