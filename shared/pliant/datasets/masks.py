"""Masks of a source's images: which part of them shows the scene.

    one image     for all frames: a bonnet, an instrument, a logo, the rim of an endoscope
    a folder      with one for each frame, or for some: things that move by themselves

Black is ignored and the rest is used, as in COLMAP.  In a folder a mask has the name of its image,
with (COLMAP's way) or without the image's ending before its own: frame.jpg.png or frame.png.  If
images have no names, or no mask has the name of an image, the last number in the name of a mask is
the frame number, from 0; from 1, if that is as many as there are frames.
"""

import re
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np

from pliant.algorithms.arrays import BoolArray
from pliant.algorithms.image.decoding import decoded
from pliant.algorithms.image.masks import packed, scaled
from pliant.datasets.base import Dataset, SourceFrame, encoding_of
from pliant.datasets.images import ImageFiles, image_files
from pliant.errors import DatasetError

_LOSSY = ("jpeg", "webp")
_UNREADABLE = b"?"
"""Marks a mask file that cannot be read: its frame is broken."""


class Masked:
    """A source whose frames bring a mask along.  A frame that has none in the folder is used as a
    whole: nothing that is to be ignored is in it."""

    def __init__(self, source: Dataset, path: Path) -> None:
        """path: of the image, or of the folder.

        Raises DatasetError for what is no mask of these images: an image that cannot be read, of
        another aspect or black all over, a folder with none for any frame.
        """
        self.source = source
        self.calibration = source.calibration
        self.name = source.name
        self.is_live = source.is_live
        self.frame_count = source.frame_count
        self.ground_truth_path: Path | None = source.ground_truth_path
        self._names: dict[str, Path] = {}
        self._numbers: dict[int, Path] = {}
        self._fixed = b""
        if path.is_dir():
            self.note = self._take_folder(path)
        else:
            used = self._fitting(path)
            if not used.any():
                raise DatasetError(f"--mask {path}: is completely black, and would mask everything")
            self._fixed = _kept(used)
            share = 100.0 * (1.0 - used.mean())
            self.note = f"masked: {share:.0f} % of each image are ignored ({path.name})"

    def __iter__(self) -> Iterator[SourceFrame]:
        for frame in self.source:
            yield frame if frame.dropped else replace(frame, mask=self._mask_of(frame))

    def _mask_of(self, frame: SourceFrame) -> bytes:
        path = self._numbers.get(frame.index)
        if self._names:
            path = self._names.get(frame.name) or self._names.get(Path(frame.name).stem)
        if path is None:
            return self._fixed
        try:
            return _kept(_read(path))
        except DatasetError:
            return _UNREADABLE

    def _fitting(self, path: Path) -> BoolArray:
        """Raises DatasetError for a file that is no mask of these images."""
        used = _read(path)
        try:
            scaled(used, (self.calibration.width, self.calibration.height))
        except ValueError as error:
            raise DatasetError(f"--mask {path}: is {error}: use one of these sizes") from None
        return used

    def _take_folder(self, folder: Path) -> str:
        """Assign the masks to frames, and make a note of it."""
        if self.is_live:
            raise DatasetError(f"--mask {folder}: a camera needs a single mask image, not a folder")
        files = image_files(folder)
        if not files:
            raise DatasetError(f"--mask {folder}: contains no images: pass a folder of PNG files")
        self._fitting(files[0])
        images = self.source.names if isinstance(self.source, ImageFiles) else []
        named = {file.stem: file for file in reversed(files)}
        found = sum(name in named or Path(name).stem in named for name in images)
        if found:
            self._names = named
        else:
            self._numbers = _numbered(folder, files, self.frame_count)
            count = self.frame_count
            found = sum(count is None or number < count for number in self._numbers)
        if not found:
            wanted = f"{Path(images[0]).stem}.png" if images else "000000.png"
            raise DatasetError(
                f"--mask {folder}: has no mask for any frame: the first should be {wanted}, but "
                f"is {files[0].name}"
            )
        of = "the" if self.frame_count is None else f"{self.frame_count}"
        rest = "" if found == self.frame_count else ", the others are used completely"
        return f"masked: {found} of {of} frames have a mask{rest}"


def _read(path: Path) -> BoolArray:
    """Raises DatasetError for a file that is no image."""
    try:
        data = path.read_bytes()
    except OSError as error:
        raise DatasetError(f"--mask {path}: cannot be read: {error.strerror}") from None
    flags = cv2.IMREAD_GRAYSCALE | cv2.IMREAD_ANYDEPTH
    pixels = decoded(data, flags)
    if pixels is None:
        raise DatasetError(
            f"--mask {path}: OpenCV cannot read this image, or it exceeds a gigapixel: pass a PNG "
            "of the images' size"
        )
    # Lossy compression leaves no exact black.
    least = 128 if encoding_of(data) in _LOSSY else 1
    return np.asarray(pixels) >= least


def _numbered(folder: Path, files: list[Path], frames: int | None) -> dict[int, Path]:
    """Masks by the number of their frame.  Raises DatasetError if two have the same."""
    found: dict[int, Path] = {}
    for file in files:
        digits = re.findall(r"[0-9]+", file.stem)
        number = int(digits[-1]) if digits else -1
        if number in found:
            other = found[number].name
            raise DatasetError(
                f"--mask {folder}: {other} and {file.name} are masks of the same frame: remove one"
            )
        if digits:
            found[number] = file
    from_one = frames is not None and sorted(found) == list(range(1, frames + 1))
    return {number - from_one: file for number, file in found.items()}


def _kept(used: BoolArray) -> bytes:
    return b"" if used.all() else packed(used)
