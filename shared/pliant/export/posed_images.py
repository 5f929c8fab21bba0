"""Images of a run that fit its poses, for splats, NeRFs and stereo.

One for each keyframe: its own image, or a clearly sharper one (as ``--sharpest`` measures it) of
the frames that are nearer to it than to other keyframes; poses of keyframes are more accurate.
Each is the image of an ideal pinhole camera with a global shutter at its pose: the given and the
estimated distortion and the rolling shutter are removed, and pixels outside of the lens's image are
masked.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, U8, BoolArray
from pliant.algorithms.image.duplicate_views import SHARPER
from pliant.algorithms.image.masks import mask_image
from pliant.algorithms.image.sharpness import sharpness
from pliant.errors import ResultError
from pliant.export.images import (
    RectifiedImage,
    ShownView,
    image_name,
    make_folder,
    rectified_images,
    write_png,
)
from pliant.messages.types import CameraStream
from pliant.recording.reader import Recording
from pliant.results.run import Run
from pliant.results.still_frames import StillFrames

INLIER_PX = 1.5
"""The mapper's limit."""


@dataclass(frozen=True)
class PosedImage:
    """A frame whose image was written.

    T_world_camera: (4, 4).    masked: so was its mask.    sharpness: of the image.
    """

    frame: int
    T_world_camera: F64
    masked: bool = False
    sharpness: float = 0.0

    @property
    def name(self) -> str:
        """Its file in the folder ``images``."""
        return image_name(self.frame)


class IdealCamera:
    """Sees the frames of the longest segment of a run as one pinhole camera at their poses.

    camera: that one.    segment: of the map.    keyframes: ids of them by their frames.
    poses: T_world_camera (4, 4) of each frame that has one.
    """

    def __init__(self, run: Run) -> None:
        """Raises ResultError if there is no map."""
        self.segment = run.history.longest_segment()
        if run.stream is None:
            raise ResultError("the run has no map to export")
        self._still = StillFrames(run, run.stream.camera, self.segment)
        self.poses = self._still.poses
        own = {k.frame: number for number, k in run.history.keyframes.items()}
        self.keyframes = {f: number for f, number in sorted(own.items()) if f in self.poses}
        if not self.keyframes:
            raise ResultError("the run has no map to export")
        self._view = ShownView(self._still.view)
        self.camera = self._view.camera

    def image(self, frame: int, pixels: U8) -> U8:
        """(h, w) or (h, w, 3) of the rectified image of a frame that has a pose."""
        return self._view.image(pixels, self._still.rolled(frame))

    def pixels(self, frame: int, points_px: F32) -> F32:
        """(N, 2) where ``image`` shows what the rectified image of the frame shows there."""
        return self._view.pixels(points_px, self._still.rolled(frame))

    def shows(self, points_px: F64) -> BoolArray:
        """(N,) which of the pixels (N, 2) lie in the image."""
        size = (self.camera.width - 0.5, self.camera.height - 0.5)
        return np.all((points_px > -0.5) & (points_px < size), axis=1)


def write_posed_images(
    recording: Recording,
    stream: CameraStream,
    ideal: IdealCamera,
    folder: Path,
    mask_name: Callable[[str], str] = str,
) -> list[PosedImage]:
    """Write the sharpest image around each keyframe into a folder, and where any has a mask those
    of all into ``masks`` beside it: black where it is ignored, white of those that have none, as
    nerfstudio takes masks of all images or of none.

    mask_name: of its file, by the name of the image.    Raises ResultError if there are no
    images, and where the disk fails.
    """
    make_folder(folder)
    masks = folder.with_name("masks")
    written: list[PosedImage] = []
    for frame, _, pixels, used in _sharpest(recording, stream, ideal):
        shown = ideal.image(frame, pixels)
        image = PosedImage(frame, ideal.poses[frame], used is not None, sharpness(_grey(shown)))
        write_png(folder / image.name, shown)
        if used is not None:
            make_folder(masks)
            mask = mask_image(used, partial(ideal.image, frame))
            write_png(masks / mask_name(image.name), mask)
        written.append(image)
    if not any(image.masked for image in written):
        return written
    white = np.full((ideal.camera.height, ideal.camera.width), 255, np.uint8)
    for image in written:
        if not image.masked:
            write_png(masks / mask_name(image.name), white)
    return [replace(image, masked=True) for image in written]


def _sharpest(
    recording: Recording, stream: CameraStream, ideal: IdealCamera
) -> Iterator[RectifiedImage]:
    """Yield the images of the chosen frames."""
    keyframes = np.array(list(ideal.keyframes))
    between = 0.5 * (keyframes[1:] + keyframes[:-1])
    group, best, chosen = -1, 0.0, None
    for image in rectified_images(recording, stream, ideal.poses):
        frame = image.number
        here = int(np.searchsorted(between, frame))
        if here != group and chosen is not None:
            yield chosen
            chosen = None
        found = sharpness(_grey(image.pixels)) * (SHARPER if frame in ideal.keyframes else 1.0)
        if chosen is None or found > best:
            group, best, chosen = here, found, image
    if chosen is not None:
        yield chosen


def _grey(pixels: U8) -> U8:
    return pixels if pixels.ndim == 2 else cast(U8, cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY))
