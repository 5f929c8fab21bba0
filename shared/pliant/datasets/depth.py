"""Depth maps that come with a source: their list, and from their bytes to rectified metres.

    FOLDER/depth.txt    "seconds file" a line, as in rgb.txt: 16-bit images, in the units and of the
                        camera that the calibration's ``depth_...`` keys say; 0: nothing measured

or, without that list, the right images of a stereo pair: see ``pliant.datasets.stereo``.

A depth map belongs to an image if each is nearest in time to the other, within 20 ms (as in the TUM
benchmark's tools).
"""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from pliant.algorithms.arrays import F32, F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.image.decoding import decoded
from pliant.algorithms.rectification import rectified_camera
from pliant.datasets import stereo
from pliant.datasets.base import BrokenFrame
from pliant.datasets.calibration import Calibration, DepthImages
from pliant.datasets.image_lists import ImageList, read_list
from pliant.datasets.images import ListedImage
from pliant.datasets.source_spec import SourceSpec
from pliant.datasets.stereo import StereoPair
from pliant.errors import CalibrationError, DatasetError
from pliant.trajectory import associate

LIST_NAME = "depth.txt"
_MAX_DIFFERENCE_NS = 20_000_000


def with_depth(
    listed: ImageList, folder: Path, calibration: Calibration, spec: SourceSpec
) -> Sequence[ListedImage]:
    """The images with the depth maps that are wanted of them.

    Raises DatasetError if there is no list or nothing in it belongs to an image, and
    CalibrationError if the unit of the depth maps is not known.
    """
    images = listed.images
    if spec.depth == "none":
        return images
    if listed.others:
        _check_scale(folder, calibration)
        taken = listed.others[: 1 if spec.depth == "first" else None]
        depths = [*taken, *[None] * (len(images) - len(taken))]
        return [replace(image, depth=path) for image, path in zip(images, depths, strict=True)]
    file = folder / LIST_NAME
    is_stereo = not file.is_file() and (folder / stereo.LIST_NAME).is_file()
    if is_stereo:
        file = folder / stereo.LIST_NAME
        _check_stereo(folder, calibration)
    elif not file.is_file():
        raise DatasetError(
            f"{folder}: no {LIST_NAME}: surfels start from a depth map, listed there like the "
            f"images in rgb.txt, or from right images of a rectified pair in {stereo.LIST_NAME}; "
            "without either, use --depth map or --depth flat"
        )
    maps = [each for each in read_list(file, folder).images if not each.fault]
    _check_scale(folder, calibration)
    rows, of_maps = associate(_stamps(images), _stamps(maps), max_difference_ns=_MAX_DIFFERENCE_NS)
    if not len(rows):
        raise DatasetError(f"{file}: no depth map is within 20 ms of an image; correct the times")
    wanted = slice(1 if spec.depth == "first" else None)
    pairs = zip(rows[wanted].tolist(), of_maps[wanted].tolist(), strict=True)
    found: dict[int, Path | StereoPair] = {row: maps[of_map].path for row, of_map in pairs}
    if is_stereo:
        depth = calibration.depth
        assert depth is not None  # of a calibration with stereo_baseline
        found = {
            row: StereoPair(right, depth.camera.fx, depth.baseline_m, depth.scale_m)
            for row, right in found.items()
            if isinstance(right, Path)
        }
    return [replace(image, depth=found.get(row)) for row, image in enumerate(images)]


def _check_scale(folder: Path, calibration: Calibration) -> None:
    if calibration.depth is None:
        raise CalibrationError(
            f"{folder}: has depth maps, but its calibration has no depth_scale: add the metres per "
            "unit, e.g. depth_scale: 0.001"
        )


def _check_stereo(folder: Path, calibration: Calibration) -> None:
    if calibration.depth is None or calibration.depth.baseline_m == 0.0:
        raise CalibrationError(
            f"{folder}: has right images, but its calibration has no stereo_baseline: add the "
            "metres between the cameras, e.g. stereo_baseline: 0.0053"
        )
    if calibration.lens.distorts:
        raise CalibrationError(
            f"{folder}: has right images, but its calibration has distortion: rectify both images "
            "first (cv2.stereoRectify) and give the intrinsics of the rectified ones"
        )


class DepthRectifier:
    """Turns depth maps as they came into metres at the pixels of the rectified images."""

    def __init__(self, calibration: Calibration) -> None:
        self._depth = calibration.depth
        self._maps = None
        if calibration.depth is not None:
            camera = rectified_camera(calibration.lens)
            if camera != calibration.depth.camera:
                self._maps = _nearest_pixels(calibration.depth, camera)

    def rectify(self, frame: int, data: bytes) -> F64:
        """(H, W) metres along the optical axis, 0 where nothing was measured.

        Pixels are taken as they are, the nearest one: between two surfaces there is nothing.
        Raises BrokenFrame if the bytes are no depth map, or one of another size.
        """
        if self._depth is None:
            raise BrokenFrame(f"frame {frame}: a depth map without depth_scale in the calibration")
        camera = self._depth.camera
        units: Any = decoded(data, cv2.IMREAD_UNCHANGED)
        if units is None or units.dtype != np.uint16 or units.ndim != 2:
            raise BrokenFrame(f"frame {frame}: its depth map is no 16-bit image of one channel")
        if units.shape != (camera.height, camera.width):
            raise BrokenFrame(
                f"frame {frame}: its depth map has {units.shape[1]}x{units.shape[0]} px, expected "
                f"{camera.width}x{camera.height}"
            )
        if self._maps is not None:
            border: Any = cv2.BORDER_CONSTANT
            units = cv2.remap(units, *self._maps, cv2.INTER_NEAREST, borderMode=border)
        known = ~np.isin(units, (0, *self._depth.invalid))
        return np.where(known, units * self._depth.scale_m, 0.0)


def _nearest_pixels(depth: DepthImages, camera: PinholeCamera) -> tuple[F32, F32]:
    """The column and row of the depth map that each pixel of the rectified camera sees."""
    u, v = np.meshgrid(np.arange(camera.width, dtype=np.float64), np.arange(float(camera.height)))
    pixels = np.stack([u, v], axis=-1).reshape(-1, 2)
    rays = np.concatenate([camera.normalise(pixels), np.ones((len(pixels), 1))], axis=1)
    found = depth.camera.project(rays).reshape(camera.height, camera.width, 2).astype(np.float32)
    return np.ascontiguousarray(found[..., 0]), np.ascontiguousarray(found[..., 1])


def _stamps(images: Sequence[ListedImage]) -> I64:
    return np.array([image.stamp_ns for image in images], np.int64)
