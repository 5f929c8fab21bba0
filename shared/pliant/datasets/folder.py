"""Folders of images, with or without a list.

    FOLDER/rgb.txt          "seconds file" a line, # for comments, or the same with commas
    FOLDER/calib.yaml       see pliant.datasets.calibration
    FOLDER/images/...       the files that rgb.txt names, anywhere inside
    FOLDER/groundtruth.txt  optional: true poses, TUM format
    FOLDER/depth.txt        optional: depth maps, listed like the images; see pliant.datasets.depth
    FOLDER/imu.csv          optional: inertial samples; see pliant.datasets.measured.csv_log
    FOLDER/right.txt        optional: right images of a stereo pair; see pliant.datasets.stereo

or ``associations.txt`` ("seconds file seconds file") instead of rgb.txt, or a bare folder of images
(directly, or in rgb/, color/, images/ and the like), with ``--calibration FILE`` or ``--fov
DEGREES`` where it holds no calib.yaml.  Times are those that the names of the images tell.  Where
they tell none, images are in the order of their names, 2 before 10, and ``fps`` of the calibration
apart, 30 a second if it has none.
"""

from collections.abc import Sequence
from pathlib import Path

from pliant.datasets.base import Dataset
from pliant.datasets.calibration_files import NAMES
from pliant.datasets.depth import with_depth
from pliant.datasets.image_kinds import folder_of_images, images_of_one_kind
from pliant.datasets.image_lists import read_list
from pliant.datasets.images import (
    ImageFiles,
    ListedImage,
    choose_calibration,
    existing,
    image_size,
)
from pliant.datasets.measured.base import NOTHING, Measurements
from pliant.datasets.measured.csv_log import read_csv
from pliant.datasets.named_times import times_in_names
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.times import rate

LIST_NAME = "rgb.txt"
CALIBRATION_NAME = "calib.yaml"
IMU_NAME = "imu.csv"
GROUND_TRUTH_NAME = "groundtruth.txt"
DEFAULT_FPS = 30.0


_ASSOCIATIONS = (
    *("associations.txt", "associate.txt", "association.txt", "associated.txt", "assoc.txt"),
    "rgb_depth.txt",
)


def list_of(folder: Path) -> Path | None:
    """The list of the images in a folder."""
    return existing(folder / LIST_NAME, *(folder / name for name in _ASSOCIATIONS))


def is_listed_folder(source: str) -> bool:
    """Whether it is a folder with a list."""
    return list_of(Path(source)) is not None


def open_listed_folder(spec: SourceSpec, *, name: str = "") -> Dataset:
    """A folder with rgb.txt, under another name if one is given.

    Raises DatasetError and CalibrationError.
    """
    folder = Path(spec.location)
    listed = read_list(list_of(folder) or folder / LIST_NAME, folder)
    calibration = choose_calibration(
        spec, image_size(listed.images), found=calibration_in(folder), where=spec.location
    )
    return ImageFiles(
        name=name or folder.resolve().name,
        images=with_depth(listed, folder, calibration, spec),
        calibration=calibration,
        ground_truth_path=existing(folder / GROUND_TRUTH_NAME),
        notes=listed.notes,
    )


def folder_sensors(spec: SourceSpec) -> Measurements:
    """The inertial samples in a folder.  Raises DatasetError."""
    file = existing(Path(spec.location) / IMU_NAME)
    return NOTHING if file is None else read_csv(file)


def is_bare_folder(source: str) -> bool:
    """Whether it is a folder with images and no list."""
    return folder_of_images(Path(source)) is not None


def open_bare_folder(spec: SourceSpec) -> Dataset:
    """A folder of images without a list.  Raises DatasetError and CalibrationError."""
    folder = Path(spec.location)
    inner = folder_of_images(folder) or folder
    paths, notes = images_of_one_kind(inner)
    if inner != folder:
        notes.append(f"the images are those in {inner.name}/")
    untimed = [ListedImage(stamp_ns=0, path=path) for path in paths]
    calibration = choose_calibration(
        spec, image_size(untimed), found=calibration_in(folder, inner), where=spec.location
    )
    images, more_notes = _timed(paths, calibration.fps)
    return ImageFiles(
        name=folder.resolve().name,
        images=images,
        calibration=calibration,
        ground_truth_path=existing(folder / GROUND_TRUTH_NAME),
        notes=[*notes, *more_notes],
    )


def calibration_in(*folders: Path) -> Path | None:
    """The calibration that lies beside the images."""
    return existing(*(folder / name for folder in folders for name in NAMES))


def _timed(paths: Sequence[Path], fps: float | None) -> tuple[list[ListedImage], list[str]]:
    """The images with the times that their names tell, else at a rate, and a note on it."""
    named = times_in_names([path.stem for path in paths])
    if named is not None:
        ordered = [paths[row] for row in named.order]
        images = [
            ListedImage(stamp_ns=t, path=p) for t, p in zip(named.stamps_ns, ordered, strict=True)
        ]
        return images, [f"times: from the file names, in {named.unit}: {rate(named.stamps_ns)}"]
    images = [
        ListedImage(stamp_ns=round(i * 1e9 / (fps or DEFAULT_FPS)), path=path)
        for i, path in enumerate(paths)
    ]
    if fps is not None or len(images) == 1:
        return images, []
    return images, [
        (
            f"times: none in the file names, assuming {DEFAULT_FPS:.0f} images/s (or set fps in "
            f"{CALIBRATION_NAME}, or times in {LIST_NAME})"
        )
    ]
