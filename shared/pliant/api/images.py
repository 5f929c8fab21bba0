"""Images and cameras as a caller has them, made into what the pipeline takes."""

import numpy as np

from pliant.algorithms.arrays import U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.image.masks import packed
from pliant.datasets.base import SourceFrame
from pliant.datasets.calibration import Calibration
from pliant.errors import DatasetError


def calibration_of(camera: Calibration | PinholeCamera) -> Calibration:
    """A camera without distortion is a calibration, too."""
    if isinstance(camera, PinholeCamera):
        return Calibration(model="pinhole", **vars(camera))
    return camera


def source_frame(
    image: U8,
    camera: Calibration | None,
    *,
    number: int = 0,
    stamp_ns: int = 0,
    mask: U8 | BoolArray | None = None,
) -> SourceFrame:
    """An image (H, W) grey or (H, W, 3) RGB, uint8, as a frame of a source.

    camera: of the image; None if unknown.  mask: (H, W), 0 where it is ignored.  Raises
    DatasetError if it cannot be its.
    """
    image = np.asarray(image)
    colour = image.ndim == 3 and image.shape[2] == 3
    if image.dtype != np.uint8 or not (image.ndim == 2 or colour) or 0 in image.shape:
        raise DatasetError(
            f"image {number}: expected an array (H, W) or (H, W, 3) of uint8, "
            f"got {image.shape} of {image.dtype}"
        )
    height, width = image.shape[:2]
    if camera is not None and (width, height) != (camera.width, camera.height):
        raise DatasetError(
            f"image {number}: {width}x{height} px, but the camera has "
            f"{camera.width}x{camera.height}"
        )
    if mask is not None and np.shape(mask) != image.shape[:2]:
        raise DatasetError(
            f"image {number}: its mask has the shape {np.shape(mask)}, expected {image.shape[:2]}"
        )
    return SourceFrame(
        index=number, stamp_ns=stamp_ns, encoding="rgb8" if colour else "mono8",
        data=np.ascontiguousarray(image).tobytes(), width=width, height=height,
        mask=b"" if mask is None else packed(np.asarray(mask) != 0),
    )  # fmt: skip
