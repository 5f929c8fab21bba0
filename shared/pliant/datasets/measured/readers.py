"""Files of inertial samples or satellite fixes: which reader understands one."""

from collections.abc import Callable, Mapping
from pathlib import Path

from pliant.datasets.measured.base import Measurements
from pliant.datasets.measured.csv_log import read_csv
from pliant.datasets.measured.fix_files import read_fix_table, read_gpx, read_srt
from pliant.datasets.measured.gopro import read_gopro
from pliant.datasets.measured.gyroflow import read_gcsv
from pliant.datasets.measured.phone_log import is_phone_log, read_phone_log
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError

Reader = Callable[[Path], Measurements]
IMU_READERS: dict[str, Reader] = {
    ".csv": read_csv,
    ".txt": read_csv,
    ".gcsv": read_gcsv,
    ".mp4": read_gopro,
    ".mov": read_gopro,
}
"""By the ending of the file; each gives what it has on the file's own clock."""
GPS_READERS: dict[str, Reader] = {
    ".gpx": read_gpx,
    ".srt": read_srt,
    ".csv": read_fix_table,
    ".mp4": read_gopro,
    ".mov": read_gopro,
}
_BESIDE: tuple[tuple[str, Reader], ...] = (
    *((".gcsv", read_gcsv), (".srt", read_srt), (".SRT", read_srt), (".gpx", read_gpx)),
)
"""Files with the name of a video and another ending."""


def read_named(file: Path, readers: Mapping[str, Reader], option: str) -> Measurements:
    """The samples of a file that a user named by an option.  Raises DatasetError."""
    reader = readers.get(file.suffix.lower()) if file.is_file() else None  # a device has no end
    reader = read_phone_log if is_phone_log(file) else reader
    if not file.exists():
        raise DatasetError(f"{option} {file}: no such file")
    if reader is None:
        known = ", ".join(readers)
        raise DatasetError(
            f"{option} {file}: not a kind of file that is understood: use {known}, or a folder "
            "with Gyroscope.csv"
        )
    return reader(file)


def video_sensors(spec: SourceSpec) -> Measurements:
    """The samples inside a video, and in files of its name beside it.

    Raises DatasetError if the video cannot be read.
    """
    file = Path(spec.location)
    found = read_gopro(file)
    for ending, reader in _BESIDE:
        path = file.with_suffix(ending)
        if path.is_file():
            found = found.and_those_of(_read(path, reader))
    return found


def _read(path: Path, reader: Reader) -> Measurements:
    """The samples of a file; a note where it is damaged."""
    try:
        return reader(path)
    except DatasetError as error:
        return Measurements(imu_notes=(str(error),))
