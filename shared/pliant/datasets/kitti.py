"""KITTI odometry sequences; the left grey camera is used, else the left colour camera.

sequences/00/image_0/*.png    (or image_2)
sequences/00/times.txt        seconds, one a line
sequences/00/calib.txt        P0 belongs to image_0, P2 to image_2
poses/00.txt                  true poses, of camera 0
"""

from pathlib import Path

from pliant.datasets.base import Dataset
from pliant.datasets.image_lists import data_lines, mended, stamps_of
from pliant.datasets.images import (
    ImageFiles,
    ListedImage,
    SourceOptions,
    choose_calibration,
    existing,
    image_files,
    image_size,
)
from pliant.errors import DatasetError

_CAMERAS = (0, 2)


def is_kitti(source: str) -> bool:
    """Whether it is a folder with images of one of the left cameras."""
    return _camera(Path(source)) is not None


def open_kitti(source: str, options: SourceOptions) -> Dataset:
    """A sequence of the benchmark.  Raises DatasetError and CalibrationError."""
    folder = Path(source)
    camera = _camera(folder)
    if camera is None:
        raise DatasetError(f"{source}: no folder image_0 or image_2")
    paths = image_files(folder / f"image_{camera}")
    if not paths:
        raise DatasetError(f"{folder / f'image_{camera}'}: no images in it")
    file = folder / "times.txt"
    numbered = list(data_lines(file))
    lines = [number for number, _ in numbered]
    stamps, notes = stamps_of(numbered, file, "seconds")
    if len(stamps) != len(paths):
        raise DatasetError(
            f"{file}: {len(stamps)} times for {len(paths)} images in image_{camera}; every image "
            "needs one"
        )
    listed = [ListedImage(stamp_ns=t, path=path) for t, path in zip(stamps, paths, strict=True)]
    images, told = mended(listed, lines, file)
    resolved = folder.resolve()
    return ImageFiles(
        name=f"kitti_{resolved.name}" if resolved.name.isdigit() else resolved.name,
        images=images,
        notes=[*notes, *told],
        calibration=choose_calibration(
            options,
            image_size(images),
            found=folder / "calib.txt",
            where=source,
            kitti_camera=camera,
        ),
        ground_truth_path=existing(
            folder / "poses.txt", resolved.parent.parent / "poses" / f"{resolved.name}.txt"
        ),
    )


def _camera(folder: Path) -> int | None:
    return next((n for n in _CAMERAS if (folder / f"image_{n}").is_dir()), None)
