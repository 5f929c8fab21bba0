"""KITTI odometry sequences; the left grey camera is used, else the left colour camera.

sequences/00/image_0/*.png    (or image_2)
sequences/00/times.txt        seconds, one a line
sequences/00/calib.txt        P0 belongs to image_0, P2 to image_2
poses/00.txt                  true poses, of camera 0

and the raw drives, synchronised and rectified:

2011_09_26/2011_09_26_drive_0001_sync/image_00/data/*.png    (or image_02)
2011_09_26/2011_09_26_drive_0001_sync/image_00/timestamps.txt    dates, one a line
2011_09_26/calib_cam_to_cam.txt                              P_rect_00, P_rect_02
"""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pliant.datasets.base import Dataset
from pliant.datasets.image_lists import data_lines, mended, stamps_of
from pliant.datasets.images import (
    ImageFiles,
    ListedImage,
    choose_calibration,
    existing,
    image_files,
    image_size,
)
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError
from pliant.wording import shown

_CAMERAS = (0, 2)


@dataclass(frozen=True)
class _Layout:
    """Where things of a sequence are.   camera: 0 or 2.   dated: times are dates."""

    camera: int
    images: Path
    times: Path
    calibration: Path
    dated: bool = False


def is_kitti(source: str) -> bool:
    """Whether it is a folder with images of one of the left cameras."""
    return _layout(Path(source)) is not None


def open_kitti(spec: SourceSpec) -> Dataset:
    """A sequence of the benchmark.  Raises DatasetError and CalibrationError."""
    folder = Path(spec.location)
    layout = _layout(folder)
    if layout is None:
        raise DatasetError(f"{spec.location}: no folder image_0 or image_2")
    paths = image_files(layout.images)
    if not paths:
        raise DatasetError(f"{layout.images}: no images in it")
    file = layout.times
    numbered = list(data_lines(file))
    lines = [number for number, _ in numbered]
    if layout.dated:
        stamps, notes = _dates(numbered, file), list[str]()
    else:
        stamps, notes = stamps_of(numbered, file, "seconds")
    if len(stamps) != len(paths):
        raise DatasetError(
            f"{file}: {len(stamps)} times for {len(paths)} images in {layout.images.name}; every "
            "image needs one"
        )
    listed = [ListedImage(stamp_ns=t, path=path) for t, path in zip(stamps, paths, strict=True)]
    images, more_notes = mended(listed, lines, file)
    resolved = folder.resolve()
    return ImageFiles(
        name=f"kitti_{resolved.name}" if resolved.name.isdigit() else resolved.name,
        images=images,
        notes=[*notes, *more_notes],
        calibration=choose_calibration(
            spec,
            image_size(images),
            found=layout.calibration,
            where=spec.location,
            kitti_camera=layout.camera,
        ),
        ground_truth_path=existing(
            folder / "poses.txt", resolved.parent.parent / "poses" / f"{resolved.name}.txt"
        ),
    )


def _layout(folder: Path) -> _Layout | None:
    for camera in _CAMERAS:
        images, raw = folder / f"image_{camera}", folder / f"image_{camera:02d}"
        if images.is_dir():
            return _Layout(camera, images, folder / "times.txt", folder / "calib.txt")
        if (raw / "data").is_dir() and (raw / "timestamps.txt").is_file():
            calibration = folder.resolve().parent / "calib_cam_to_cam.txt"
            return _Layout(camera, raw / "data", raw / "timestamps.txt", calibration, dated=True)
    return None


def _dates(lines: Sequence[tuple[int, str]], file: Path) -> list[int]:
    """Nanoseconds of dates as in "2011-09-26 13:02:25.594360375".  Raises DatasetError."""
    stamps: list[int] = []
    for number, text in lines:
        try:
            stamps.append(int(np.datetime64(text, "ns").astype(np.int64)))
        except ValueError:
            raise DatasetError(f"{file}: line {number}: {shown(text)} is not a date") from None
    return stamps
