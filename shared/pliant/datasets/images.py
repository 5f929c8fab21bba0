"""Sources made of image files: the data set itself, and the lists that say what belongs to it."""

import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import Literal

from pliant.datasets.base import BrokenFrame, SourceFrame, encoding_of
from pliant.datasets.calibration import Calibration, calibration_from_fov
from pliant.datasets.calibration_files import check_size, read_calibration
from pliant.datasets.rectifier import decode
from pliant.datasets.stereo import StereoPair
from pliant.errors import CalibrationError, DatasetError

SUFFIXES = (".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".webp", ".pgm", ".ppm", ".pnm")
_MAX_STAMP_NS = (1 << 63) - 1
_TRIED_FOR_SIZE = 20
_LIST_LINE = re.compile(r"([^\s,;]+)[\s,;]+(\S.*)")


@dataclass(frozen=True, kw_only=True)
class SourceOptions:
    """What the user says about the camera.  Either wins over what comes with the source.

    topic: which images of a file with several are meant; "" where there is but one.
    depth: which depth maps are wanted: none, the first one, or those of all frames.
    """

    calibration: Path | None = None
    fov_deg: float | None = None
    topic: str = ""
    depth: Literal["none", "first", "all"] = "none"

    def __post_init__(self) -> None:
        if self.calibration is not None and self.fov_deg is not None:
            raise CalibrationError("--calibration and --fov contradict each other: give one")


@dataclass(frozen=True, kw_only=True)
class ListedImage:
    """An image file and its capture time.  depth: a depth map, or what one is made from."""

    stamp_ns: int
    path: Path
    depth: Path | StereoPair | None = None


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
    ) -> None:
        self.name = name
        self.calibration = calibration
        self.ground_truth_path = ground_truth_path
        self._images = images

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
            yield _read(index, image)


def _read(index: int, image: ListedImage) -> SourceFrame:
    try:
        data = image.path.read_bytes()
    except OSError:
        data = b""  # broken like an empty file: the run goes on without it
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
    """(width, height) of the first image that decodes.

    Raises DatasetError where none of the first twenty does.
    """
    for index, image in enumerate(images[:_TRIED_FOR_SIZE]):
        try:
            height, width = decode(_read(index, image)).shape[:2]
        except BrokenFrame:
            continue
        return width, height
    count = min(len(images), _TRIED_FOR_SIZE)
    which = "the only image does not" if count == 1 else f"none of the first {count} images does"
    raise DatasetError(f"{images[0].path}: {which} decode; are these image files?")


def choose_calibration(
    options: SourceOptions,
    size: tuple[int, int],
    *,
    found: Path | Calibration | None,
    where: str,
    kitti_camera: int = 0,
) -> Calibration:
    """The user's calibration or field of view, else what was found with the source.

    Where there is none, a guess.  Raises CalibrationError where it is broken, or for other images.
    """
    if options.fov_deg is not None:
        return calibration_from_fov(*size, options.fov_deg)
    if options.calibration is not None:
        return read_calibration(options.calibration, size, kitti_camera=kitti_camera)
    if isinstance(found, Calibration):
        check_size(found, size, f"{where}: its known calibration")
        return found
    if found is not None and found.is_file():
        return read_calibration(found, size, kitti_camera=kitti_camera)
    return calibration_from_fov(*size)


def existing(*candidates: Path) -> Path | None:
    """The first of the files that exists."""
    return next((path for path in candidates if path.is_file()), None)


def data_lines(file: Path) -> Iterator[tuple[int, str]]:
    """(number from 1, text) of the lines of a list that are neither empty nor comments."""
    try:
        text = file.read_text(encoding="utf-8-sig")
    except FileNotFoundError:
        raise DatasetError(f"{file}: missing; every image needs its time stamp there") from None
    except UnicodeDecodeError:
        raise DatasetError(f"{file}: is not a text file") from None
    except OSError as error:
        raise DatasetError(f"{file}: cannot be read: {error.strerror}") from None
    for number, line in enumerate(text.splitlines(), start=1):
        line = line.strip()
        if line and not line.startswith("#"):
            yield number, line


def read_list(file: Path, folder: Path, *, seconds: bool = True) -> list[ListedImage]:
    """Read a list of "time file" or "time,file" lines; files are relative to ``folder``.

    seconds: times are in seconds, else in whole nanoseconds.
    Raises DatasetError, with the number of the line, for times that do not increase, files that
    are not there or not in the folder, and lines that are something else.
    """
    images: list[ListedImage] = []
    lines: list[int] = []
    missing: list[tuple[int, str]] = []
    for number, line in data_lines(file):
        where = f"{file}: line {number}"
        match = _LIST_LINE.fullmatch(line)
        if match is None:
            raise DatasetError(f'{where}: expected "time file", got {line[:60]!r}')
        name = match.group(2).strip().strip('"')
        path = inside(folder, name, where)
        if not path.is_file():
            missing.append((number, name))
        images.append(
            ListedImage(stamp_ns=parse_stamp(match.group(1), where, seconds=seconds), path=path)
        )
        lines.append(number)
    if not images:
        raise DatasetError(f"{file}: lists no images")
    if missing:
        number, name = missing[0]
        raise DatasetError(
            f"{file}: line {number}: no file {name} in {folder} ({len(missing)} of {len(images)} "
            "listed images are missing); bring them back or remove their lines"
        )
    check_increasing([image.stamp_ns for image in images], lines, file)
    return images


def inside(folder: Path, name: str, where: str) -> Path:
    """The path of a listed file.  Raises DatasetError where it would leave the folder."""
    normal = os.path.normpath(name)
    if "\0" in name or os.path.isabs(name) or normal.split(os.sep)[0] == "..":
        raise DatasetError(f"{where}: {name!r} is outside of {folder}; list files inside it")
    return folder / normal


def parse_stamp(text: str, where: str, *, seconds: bool = True) -> int:
    """Nanoseconds of a time in seconds (or nanoseconds), exact: a float would lose digits."""
    try:
        value = Decimal(text)
    except InvalidOperation:
        raise DatasetError(f"{where}: {text[:40]!r} is not a time") from None
    if not value.is_finite() or value < 0:
        raise DatasetError(f"{where}: the time {text[:40]} is not finite and positive")
    if value > (Decimal(_MAX_STAMP_NS) / 10**9 if seconds else _MAX_STAMP_NS):
        unit = "seconds, not nanoseconds" if seconds else "nanoseconds"
        raise DatasetError(f"{where}: the time {text[:40]} is too large; it is given in {unit}")
    return int((value * (10**9 if seconds else 1)).to_integral_value())


def check_increasing(stamps_ns: Sequence[int], lines: Sequence[int], file: Path) -> None:
    """Raise DatasetError at the first time that repeats or runs backwards."""
    for i in range(1, len(stamps_ns)):
        if stamps_ns[i] <= stamps_ns[i - 1]:
            what = "repeats" if stamps_ns[i] == stamps_ns[i - 1] else "runs backwards from"
            before, here = _seconds(stamps_ns[i - 1]), _seconds(stamps_ns[i])
            raise DatasetError(
                f"{file}: line {lines[i]}: the time {here} s {what} that of line {lines[i - 1]} "
                f"({before} s); sort the list, remove doubles"
            )


def _seconds(stamp_ns: int) -> str:
    return f"{stamp_ns // 10**9}.{stamp_ns % 10**9:09d}"


def image_files(folder: Path) -> list[Path]:
    """The images directly in a folder, in natural order: 2 before 10."""
    try:
        paths = [
            path
            for path in folder.iterdir()
            if path.suffix.lower() in SUFFIXES and not path.name.startswith(".") and path.is_file()
        ]
    except OSError as error:
        raise DatasetError(f"{folder}: cannot be read: {error.strerror}") from None
    return sorted(paths, key=_natural_key)


def _natural_key(path: Path) -> tuple[list[str | int], str]:
    parts = re.split(r"([0-9]+)", path.name)
    return [int(part) if i % 2 else part for i, part in enumerate(parts)], path.name
