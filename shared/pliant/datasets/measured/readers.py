"""Files of inertial samples or satellite fixes: which reader understands one."""

from collections.abc import Callable, Mapping
from pathlib import Path

from pliant.datasets.measured.base import NOTHING, Measurements
from pliant.datasets.measured.csv_log import read_csv
from pliant.datasets.measured.gopro import read_gopro
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError

Reader = Callable[[Path], Measurements]
IMU_READERS: dict[str, Reader] = {
    ".csv": read_csv,
    ".txt": read_csv,
    ".mp4": read_gopro,
    ".mov": read_gopro,
}
"""By the ending of the file; each gives what it has on the file's own clock."""
GPS_READERS: dict[str, Reader] = {".mp4": read_gopro, ".mov": read_gopro}


def read_named(file: Path, readers: Mapping[str, Reader], option: str) -> Measurements:
    """What a file has that a user named by an option.  Raises DatasetError."""
    reader = readers.get(file.suffix.lower())
    if not file.exists():
        raise DatasetError(f"{option} {file}: no such file")
    if reader is None:
        known = ", ".join(readers)
        raise DatasetError(f"{option} {file}: not a kind of file that is understood: use {known}")
    return reader(file)


def video_sensors(spec: SourceSpec) -> Measurements:
    """What is inside a video.  Raises DatasetError."""
    file = Path(spec.location)
    return read_gopro(file) if file.is_file() else NOTHING
