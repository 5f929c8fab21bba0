"""Folders of images, with or without a list.

    FOLDER/rgb.txt          "seconds file" a line, # for comments, or the same with commas
    FOLDER/calib.yaml       see pliant.datasets.calibration
    FOLDER/images/...       the files that rgb.txt names, anywhere inside
    FOLDER/groundtruth.txt  optional: true poses, TUM format
    FOLDER/depth.txt        optional: depth maps, listed like the images; see pliant.datasets.depth
    FOLDER/right.txt        optional: right images of a stereo pair; see pliant.datasets.stereo

or a bare folder of images in the order of their names, 2 before 10, with ``--calibration FILE``
or ``--fov DEGREES`` where it holds no calib.yaml.  Their times are made up: ``fps`` of the
calibration, 30 frames a second if it does not say.
"""

from pathlib import Path

from pliant.datasets.base import Dataset
from pliant.datasets.depth import with_depth
from pliant.datasets.images import (
    ImageFiles,
    ListedImage,
    SourceOptions,
    choose_calibration,
    existing,
    image_files,
    image_size,
    read_list,
)

LIST_NAME = "rgb.txt"
CALIBRATION_NAME = "calib.yaml"
GROUND_TRUTH_NAME = "groundtruth.txt"
DEFAULT_FPS = 30.0


def is_listed_folder(source: str) -> bool:
    """Whether it is a folder with a list."""
    return (Path(source) / LIST_NAME).is_file()


def open_listed_folder(source: str, options: SourceOptions, *, name: str = "") -> Dataset:
    """A folder with rgb.txt, under another name if one is given.

    Raises DatasetError and CalibrationError.
    """
    folder = Path(source)
    images = read_list(folder / LIST_NAME, folder)
    calibration = choose_calibration(
        options, image_size(images), found=folder / CALIBRATION_NAME, where=source
    )
    return ImageFiles(
        name=name or folder.resolve().name,
        images=with_depth(images, folder, calibration, options),
        calibration=calibration,
        ground_truth_path=existing(folder / GROUND_TRUTH_NAME),
    )


def is_bare_folder(source: str) -> bool:
    """Whether it is a folder with images and no list."""
    return Path(source).is_dir() and bool(image_files(Path(source)))


def open_bare_folder(source: str, options: SourceOptions) -> Dataset:
    """A folder of images without a list.  Raises DatasetError and CalibrationError."""
    folder = Path(source)
    paths = image_files(folder)
    untimed = [ListedImage(stamp_ns=0, path=path) for path in paths]
    calibration = choose_calibration(
        options, image_size(untimed), found=folder / CALIBRATION_NAME, where=source
    )
    fps = calibration.fps or DEFAULT_FPS
    return ImageFiles(
        name=folder.resolve().name,
        images=[
            ListedImage(stamp_ns=round(i * 1e9 / fps), path=path) for i, path in enumerate(paths)
        ],
        calibration=calibration,
        ground_truth_path=existing(folder / GROUND_TRUTH_NAME),
    )
