"""EuRoC and other sequences in ASL format; the left camera is used.

    SEQUENCE/mav0/cam0/data.csv       "nanoseconds,file" a line; seconds are recognised
    SEQUENCE/mav0/cam0/data/*.png
    SEQUENCE/mav0/cam0/sensor.yaml    the calibration (or --calibration FILE, e.g. Kalibr's)
    SEQUENCE/mav0/imu0/data.csv       optional: inertial samples
    SEQUENCE/mav0/state_groundtruth_estimate0/data.csv

The source is SEQUENCE, SEQUENCE/mav0 or SEQUENCE/mav0/cam0 (or another camera's folder).
"""

from pathlib import Path

from pliant.datasets.base import Dataset
from pliant.datasets.image_lists import read_list
from pliant.datasets.images import (
    ImageFiles,
    choose_calibration,
    existing,
    image_size,
)
from pliant.datasets.measured.base import NOTHING, Measurements
from pliant.datasets.measured.csv_log import read_csv
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError


def is_euroc(source: str) -> bool:
    """Whether it is a sequence in ASL format, or one camera of it."""
    return _camera_folder(Path(source)) is not None


def open_euroc(spec: SourceSpec) -> Dataset:
    """A sequence in ASL format.  Raises DatasetError and CalibrationError."""
    camera = _camera_folder(Path(spec.location))
    if camera is None:
        raise DatasetError(f"{spec.location}: no mav0/cam0 with data.csv and data/")
    listed = read_list(camera / "data.csv", camera / "data", unit="nanoseconds")
    resolved = camera.resolve()
    sequence = resolved.parent.parent if resolved.parent.name == "mav0" else resolved.parent
    return ImageFiles(
        name=sequence.name if resolved.name == "cam0" else f"{sequence.name}_{resolved.name}",
        images=listed.images,
        notes=listed.notes,
        calibration=choose_calibration(
            spec, image_size(listed.images), found=camera / "sensor.yaml", where=str(camera)
        ),
        ground_truth_path=existing(
            camera.parent / "state_groundtruth_estimate0" / "data.csv",
            camera.parent / "mocap0" / "data.csv",
        ),
    )


def euroc_sensors(spec: SourceSpec) -> Measurements:
    """The inertial samples beside a camera.  Raises DatasetError."""
    camera = _camera_folder(Path(spec.location))
    file = None if camera is None else existing(camera.resolve().parent / "imu0" / "data.csv")
    return NOTHING if file is None else read_csv(file)


def _camera_folder(folder: Path) -> Path | None:
    for camera in (folder / "mav0" / "cam0", folder / "cam0", folder):
        if (camera / "data").is_dir() and ((camera / "data.csv").is_file() or camera != folder):
            return camera
    return None
