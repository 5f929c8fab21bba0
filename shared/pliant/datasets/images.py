"""Sources of image files: the data set, and checks of its images."""

import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from pliant.datasets.base import BrokenFrame, SourceFrame, encoding_of
from pliant.datasets.bit_depth import bits_used, eight_bits, note_on
from pliant.datasets.calibration import Calibration, calibration_from_fov
from pliant.datasets.calibration_files import check_size, read_calibration
from pliant.datasets.image_sizes import LOOKED_AT, most_frequent, size_of
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.stereo import StereoPair
from pliant.errors import DatasetError

SUFFIXES = (
    *(".png", ".jpg", ".jpeg", ".jpe", ".jfif", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm"),
    *(".pnm", ".jp2"),
)
_TRIED_FOR_SIZE = 20
_HIDDEN = re.compile(r"\.(?![0-9]+\.[A-Za-z]+$)")
"""Names of hidden files; .25.png is a time."""


@dataclass(frozen=True, kw_only=True)
class ListedImage:
    """An image file and its capture time.

    depth: a depth map, or what one is made from.   fault: why it cannot be used; "" where it can.
    """

    stamp_ns: int
    path: Path
    depth: Path | StereoPair | None = None
    fault: str = ""


class ImageFiles:
    """A data set of image files, read lazily, in order, as they are."""

    is_live = False

    def __init__(
        self,
        *,
        name: str,
        images: Sequence[ListedImage],
        calibration: Calibration,
        ground_truth_path: Path | None = None,
        notes: Sequence[str] = (),
    ) -> None:
        """notes: what a user should know of how it is read, in lines."""
        self.name = name
        self.notes = list(notes)
        self.calibration = calibration
        self.ground_truth_path = ground_truth_path
        self._images = images
        self._bits = bits_used(_read(row, images[row]) for row in _spread(len(images)))
        self.notes += note_on(self._bits)

    @property
    def frame_count(self) -> int | None:
        """The number of images."""
        return len(self._images)

    @property
    def length_s(self) -> float:
        """From the first image to the last."""
        return 1e-9 * (self._images[-1].stamp_ns - self._images[0].stamp_ns)

    @property
    def names(self) -> list[str]:
        """Of the files."""
        return [image.path.name for image in self._images]

    def __len__(self) -> int:
        return len(self._images)

    def __iter__(self) -> Iterator[SourceFrame]:
        for index, image in enumerate(self._images):
            yield eight_bits(_read(index, image), self._bits)


def _read(index: int, image: ListedImage) -> SourceFrame:
    if image.fault:
        frame = SourceFrame(index=index, stamp_ns=image.stamp_ns, encoding="unknown", data=b"")
        return replace(frame.broken(image.fault), name=image.path.name)
    try:
        data = image.path.read_bytes()
    except OSError:
        data = b""  # broken like an empty file: the run continues without it
    try:
        if isinstance(image.depth, StereoPair):
            depth = image.depth.depth(data)
        else:
            depth = image.depth.read_bytes() if image.depth is not None else b""
    except OSError:
        depth = b""  # a frame like those that have none
    return SourceFrame(
        index=index,
        stamp_ns=image.stamp_ns,
        encoding=encoding_of(data),
        data=data,
        depth=depth,
        name=image.path.name,
    )


def image_size(images: Sequence[ListedImage]) -> tuple[int, int]:
    """(width, height) of most of the images, as some of them from all over the list tell.

    Raises DatasetError if none of the first twenty, nor of these, decodes.
    """
    count, spread = len(images), _spread(len(images))
    sizes: list[tuple[int, int]] = []
    for index in [*spread, *range(min(count, _TRIED_FOR_SIZE))]:
        if len(sizes) >= len(spread) or (sizes and index not in spread):
            break
        try:
            sizes.append(size_of(_read(index, images[index])))
        except BrokenFrame:
            continue
    if sizes:
        return most_frequent(sizes)
    tried = min(count, _TRIED_FOR_SIZE)
    which = "the only image does not" if tried == 1 else f"none of the first {tried} images does"
    raise DatasetError(f"{images[0].path}: {which} decode; check that these are image files")


def _spread(count: int) -> list[int]:
    """Some images from the first to the last."""
    last = max(1, LOOKED_AT - 1)
    return sorted({round(i * (count - 1) / last) for i in range(LOOKED_AT)}) if count else []


def choose_calibration(
    spec: SourceSpec,
    size: tuple[int, int],
    *,
    found: Path | Calibration | None,
    where: str,
    kitti_camera: int = 0,
    pixel_aspect: float = 1.0,
) -> Calibration:
    """The user's calibration or field of view, or else that of the source.

    Without any, a guess.  pixel_aspect: width over height of a pixel.
    Raises CalibrationError if it is broken, or for other images.
    """
    if spec.fov_deg is not None:
        return calibration_from_fov(*size, spec.fov_deg, pixel_aspect=pixel_aspect)
    source = where.rpartition(": ")[2] if ": /" in where else Path(where).name
    if spec.calibration is not None:
        return read_calibration(spec.calibration, size, kitti_camera=kitti_camera, source=source)
    if isinstance(found, Calibration):
        check_size(found, size, f"{where}: its built-in calibration")
        return found
    if found is not None and found.is_file():
        return read_calibration(found, size, kitti_camera=kitti_camera, source=source)
    return calibration_from_fov(*size, pixel_aspect=pixel_aspect)


def existing(*candidates: Path) -> Path | None:
    """The first of the files that exists."""
    return next((path for path in candidates if path.is_file()), None)


def image_files(folder: Path) -> list[Path]:
    """The images directly in a folder, in natural order: 2 before 10."""
    try:
        paths = [
            path
            for path in folder.iterdir()
            if path.suffix.lower() in SUFFIXES and not _HIDDEN.match(path.name) and path.is_file()
        ]
    except OSError as error:
        raise DatasetError(f"{folder}: cannot be read: {error.strerror}") from None
    return sorted(paths, key=_natural_key)


def _natural_key(path: Path) -> tuple[list[str | int], str]:
    parts = re.split(r"([0-9]+)", path.name)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name
