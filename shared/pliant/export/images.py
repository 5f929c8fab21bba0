"""The images of a recording, made again from their source bytes, and as a folder."""

from collections.abc import Container, Iterator
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, U8, U16, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.image.masks import mask_image, unpacked
from pliant.algorithms.slam.calibration.corrected_view import CorrectedView, corrected_view
from pliant.algorithms.slam.calibration.rolling_shutter import RolledFrame
from pliant.datasets.base import BrokenFrame
from pliant.datasets.calibration import (
    Calibration,
    DepthImages,
    calibration_from_yaml,
    calibration_yaml,
)
from pliant.datasets.own_recording import recorded_frame
from pliant.datasets.recorded_images import RecordedImages
from pliant.datasets.rectifier import Rectifier
from pliant.errors import ResultError
from pliant.formats.text import format_seconds, write_bytes, write_lines
from pliant.messages import topics
from pliant.messages.types import CameraStream, MapUpdate, SourceImage
from pliant.recording.reader import Recording


class ShownView:
    """The part of a corrected view's images that the lens has shown, without extrapolated borders.

    camera: that of the images.
    """

    def __init__(self, view: CorrectedView) -> None:
        self._view = view
        rows, columns = self._shown = _all_shown(view.shows)
        self.camera = replace(
            view.camera,
            width=columns.stop - columns.start,
            height=rows.stop - rows.start,
            cx=view.camera.cx - columns.start,
            cy=view.camera.cy - rows.start,
        )

    def image(self, pixels: U8, rolled: RolledFrame | None = None) -> U8:
        """(h, w) or (h, w, 3) of a rectified image.  rolled: taken as if it had been at once."""
        return (self._view if rolled is None else rolled).image(pixels)[self._shown]

    def pixels(self, points_px: F32, rolled: RolledFrame | None = None) -> F32:
        """(N, 2) where ``image`` shows what the rectified image shows there."""
        ideal = self._view.pixels(points_px)
        ideal = ideal if rolled is None else ideal - rolled.shifts(ideal)
        return ideal - np.array([each.start for each in self._shown[::-1]], np.float32)


def _all_shown(shows: BoolArray) -> tuple[slice, slice]:
    """Rows and columns that hold nothing else."""
    top, bottom, left, right = 0, shows.shape[0], 0, shows.shape[1]
    while not (inside := shows[top:bottom, left:right]).all():
        sides = (inside[0], inside[-1], inside[:, 0], inside[:, -1])
        worst = int(np.argmin([side.mean() for side in sides]))
        top, bottom = top + (worst == 0), bottom - (worst == 1)
        left, right = left + (worst == 2), right - (worst == 3)
    return slice(top, bottom), slice(left, right)


def images(recording: Recording, path: Path, folder: Path | None) -> None:
    """A folder that ``pliant run`` opens: rectified PNG, ``rgb.txt`` and ``calib.yaml``, and where
    there are masks ``masks`` for its ``--mask``.

    As the camera sees that the last adjustment found, if there was one.
    """
    stream = camera_of(recording)
    view = ShownView(corrected_view(stream.camera, _correction(recording)))
    make_folder(path / "images")
    names: dict[int, str] = {}
    for frame, stamp_ns, pixels, used in rectified_images(recording, stream):
        write_png(path / "images" / image_name(frame), view.image(pixels))
        if used is not None:
            make_folder(path / "masks")
            write_png(path / "masks" / image_name(frame), mask_image(used, view.image))
        names[stamp_ns] = image_name(frame)
    write_bytes(path / "calib.yaml", pinhole_yaml(view.camera).encode())
    write_list(path / "rgb.txt", "images", names)


def _correction(recording: Recording) -> tuple[float, ...]:
    for final in recording.decoded(topics.MAP_FINAL):
        assert isinstance(final, MapUpdate)
        return final.calibration_correction
    return ()


def camera_of(recording: Recording) -> CameraStream:
    """The camera of a recording.  Raises ResultError if it stopped before its first frame."""
    for message in recording.decoded(topics.STREAM):
        assert isinstance(message, CameraStream)
        return message
    raise ResultError("the recording has no camera: it stopped before its first frame")


class RectifiedImage(NamedTuple):
    """number: of its frame.    pixels: (H, W) or (H, W, 3) RGB.    used: (H, W); None: all."""

    number: int
    stamp_ns: int
    pixels: U8
    used: BoolArray | None


def rectified_images(
    recording: Recording, stream: CameraStream, wanted: Container[int] | None = None
) -> Iterator[RectifiedImage]:
    """Yield the images of all frames with pixels.

    wanted: the numbers of those that are; None: all.
    Raises ResultError if the recording has no images.
    """
    rectifier = Rectifier(calibration_from_yaml(stream.calibration))
    found = False
    recorded = RecordedImages(recording)
    for source in recording.decoded(topics.SOURCE):
        assert isinstance(source, SourceImage)
        found = True
        if wanted is not None and source.frame not in wanted:
            continue
        frame = recorded_frame(recorded.whole(source))
        try:
            grey, colour = rectifier.rectify(frame)
            mask = rectifier.mask(frame)
        except BrokenFrame:
            continue
        used = unpacked(mask) if mask else None
        pixels = grey if colour is None else colour
        yield RectifiedImage(source.frame, source.stamp_ns, pixels, used)
    if not found:
        raise ResultError("the recording has no images (--no-images): run its source again")


def pinhole_yaml(camera: PinholeCamera, depth: DepthImages | None = None) -> str:
    """The ``calib.yaml`` of images that were written."""
    return calibration_yaml(Calibration(model="pinhole", depth=depth, **vars(camera)))


def write_list(path: Path, folder: str, names: dict[int, str]) -> None:
    """The times and files of images.  names: by their stamps, ns."""
    lines = (f"{format_seconds(stamp)} {folder}/{name}" for stamp, name in names.items())
    write_lines(path, ["# seconds file", *lines])


def image_name(frame: int) -> str:
    """The file of a frame."""
    return f"{frame:06d}.png"


def make_folder(folder: Path) -> None:
    """Make a folder and those above it.  Raises ResultError."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ResultError(f"{folder}: cannot be created ({error.strerror})") from None


def write_png(path: Path, pixels: U8 | U16) -> None:
    """Write (H, W) of one channel or (H, W, 3) RGB, losslessly."""
    bgr = pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[:, :, ::-1])
    _, data = cv2.imencode(".png", bgr, [cv2.IMWRITE_PNG_COMPRESSION, 1])
    write_bytes(path, data.tobytes())
