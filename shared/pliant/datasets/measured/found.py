"""Samples of other sensors of a source: from files that are named, or that come with it."""

from pathlib import Path

from pliant.algorithms.arrays import I64
from pliant.datasets import formats
from pliant.datasets.base import Dataset
from pliant.datasets.measured.base import HearsSensors, Measurements
from pliant.datasets.measured.readers import GPS_READERS, IMU_READERS, read_named
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError, PliantError

_FIRST_DATE_NS = 631_152_000 * 10**9
"""1990: earlier stamps count from elsewhere."""
_NEAR_DATES_NS, _NEAR_NS = 3_600 * 10**9, 10 * 10**9
"""Samples have the clock of the images if the first image is this near to one of them: two clocks
that both begin with zero, or with their device, are soon alike by chance."""


def measurements_of(spec: SourceSpec, dataset: Dataset) -> Measurements:
    """Samples of other sensors, on the clock of the images, or off it by an unknown constant.

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
    if hearing(dataset) is not None:
        return Measurements()
    found = Measurements()
    try:
        found = kind.sensors(spec.model_copy(update=dict.fromkeys(files, "")))
    except PliantError as error:
        if set(files) != {key for key, name in named.items() if name}:  # a topic was named
            raise
        found = Measurements(imu_notes=(str(error),))
    if "imu" in files:
        imu = read_named(Path(spec.imu), IMU_READERS, "--imu")
        found = imu.without_gps().and_those_of(found.without_imu())
    if "gps" in files:
        gps = read_named(Path(spec.gps), GPS_READERS, "--gps")
        found = gps.without_imu().and_those_of(found.without_gps())
    if spec.imu and not len(found.imu.stamps_ns):
        raise DatasetError(f"--imu {spec.imu}: has no inertial samples")
    if spec.gps and not len(found.gps.stamps_ns):
        raise DatasetError(f"--gps {spec.gps}: has no satellite fixes")
    gps = _on_clock(found.without_imu(), found.gps.stamps_ns, dataset)
    return _on_clock(found.without_gps(), found.imu.stamps_ns, dataset).and_those_of(gps)


def hearing(dataset: Dataset) -> HearsSensors | None:
    """The source, if it hears other sensors while its images come."""
    origin = _origin_of(dataset)
    return origin if isinstance(origin, HearsSensors) else None


def _origin_of(dataset: Dataset) -> Dataset:
    origin = dataset
    while (inner := getattr(origin, "source", None)) is not None:
        origin = inner
    return origin


def _on_clock(found: Measurements, stamps_ns: I64, dataset: Dataset) -> Measurements:
    """Samples of one sensor on the clock of the images.

    With a clock of their own, the first sample is at the first image.
    """
    image = next(iter(_origin_of(dataset)), None) if len(stamps_ns) else None
    if image is None:
        return found
    first, last = int(stamps_ns[0]), int(stamps_ns[-1])
    near_ns = _NEAR_DATES_NS if image.stamp_ns >= _FIRST_DATE_NS else _NEAR_NS
    near = first - near_ns <= image.stamp_ns <= last + near_ns
    return found if near else found.later(image.stamp_ns - first)
