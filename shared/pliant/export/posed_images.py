"""Images of a run that fit its poses, for splats, NeRFs and stereo.

One for each keyframe: its own image, or a clearly sharper one (as ``--sharpest`` measures it) of
the frames that are nearer to it than to other keyframes; poses of keyframes are more accurate.
Each is the image of an ideal pinhole camera with a global shutter at its pose: the given and the
estimated distortion and the rolling shutter are removed, and pixels outside of the lens's image are
masked.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from pathlib import Path
from typing import cast

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, U8, BoolArray
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.image.duplicate_views import SHARPER
from pliant.algorithms.image.masks import mask_image
from pliant.algorithms.image.sharpness import sharpness
from pliant.algorithms.slam.calibration.corrected_view import corrected_view
from pliant.algorithms.slam.calibration.rolling_shutter import RolledFrame, motion_between
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
        poses = {**run.history.final(), **run.history.keyframe_poses()}
        self.poses = {f: pose_to_matrix(p) for f, (s, p) in poses.items() if s == self.segment}
        own = {k.frame: number for number, k in run.history.keyframes.items()}
        self.keyframes = {f: number for f, number in sorted(own.items()) if f in self.poses}
        if run.stream is None or not self.keyframes:
            raise ResultError("the run has no map to export")
        correction = run.correction_of(self.segment)
        self._readout = correction[3] if len(correction) > 3 else 0.0
        view = corrected_view(run.stream.camera, correction)
        self._whole, self._view = view, ShownView(view)
        self.camera = self._view.camera
        self._positions = run.history.points_in(self.segment).positions
        self._rolled = lru_cache(maxsize=1)(self._rolled_frame)

    def image(self, frame: int, pixels: U8) -> U8:
        """(h, w) or (h, w, 3) of the rectified image of a frame that has a pose."""
        return self._view.image(pixels, self._rolled(frame))

    def pixels(self, frame: int, points_px: F32) -> F32:
        """(N, 2) where ``image`` shows what the rectified image of the frame shows there."""
        return self._view.pixels(points_px, self._rolled(frame))

    def shows(self, points_px: F64) -> BoolArray:
        """(N,) which of the pixels (N, 2) lie in the image."""
        size = (self.camera.width - 0.5, self.camera.height - 0.5)
        return np.all((points_px > -0.5) & (points_px < size), axis=1)

    def _rolled_frame(self, frame: int) -> RolledFrame | None:
        """By the motion between the frames around it, at the median depth of what it sees."""
        near = [f for f in (frame - 1, frame, frame + 1) if f in self.poses]
        if not self._readout or len(near) < 2:
            return None
        T = self.poses[frame]
        first, last = self.poses[near[0]], self.poses[near[-1]]
        motion = motion_between(first, last, T) / (near[-1] - near[0])
        local = (self._positions - T[:3, 3]) @ T[:3, :3]
        local = local[local[:, 2] > 0.0]
        depths = local[self.shows(self.camera.project(local)), 2]
        inverse_depth = float(1.0 / np.median(depths)) if len(depths) else 0.0
        return RolledFrame(self._whole, self._readout, motion, inverse_depth)


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
