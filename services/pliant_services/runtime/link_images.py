"""How images are sent (``bus.link_images``), and the reader's side of it.

raw: grey as it is; of a JPEG the colours stay in it, which few frames need.     lossless: packed,
the same pixels; of a camera that gives JPEGs those themselves.     jpeg: the source's images become
JPEGs before anything else sees them, so that what is recorded is what was worked on.

Of a JPEG every reader makes the rectified image itself, as a replay does: it is a tenth of the
pixels.
"""

from collections.abc import Iterator
from dataclasses import replace
from functools import lru_cache

import cv2
import numpy as np

from pliant.algorithms.arrays import F32
from pliant.algorithms.image.masks import clearance_in
from pliant.bus.base import Bus, receive
from pliant.config import BusParameters
from pliant.datasets.base import BrokenFrame, SourceFrame
from pliant.datasets.calibration import Calibration, calibration_from_yaml, calibration_yaml
from pliant.datasets.jpeg import jpeg_size
from pliant.datasets.rectifier import Rectifier, decode
from pliant.errors import MessageError, PliantError
from pliant.messages import topics
from pliant.messages.types import Image

_NO_PIXELS = np.zeros((0, 0), np.uint8)


class Sender:
    """The sender's side."""

    def __init__(self, bus: BusParameters, calibration: Calibration) -> None:
        self._how = bus.link_images
        self._quality = bus.jpeg_quality
        self._calibration = calibration_yaml(calibration)

    def source(self, frame: SourceFrame) -> SourceFrame:
        """The frame that all services process."""
        if self._how != "jpeg" or frame.dropped or frame.encoding == "jpeg":
            return frame
        try:
            pixels = decode(frame)
        except BrokenFrame:
            return frame  # reported when it is rectified
        bgr = cv2.cvtColor(pixels, cv2.COLOR_RGB2BGR) if pixels.ndim == 3 else pixels
        data = cv2.imencode(".jpg", bgr, [cv2.IMWRITE_JPEG_QUALITY, self._quality])[1].tobytes()
        made_from = f"{frame.made_from or frame.encoding}, quality {self._quality}"
        return replace(frame, encoding="jpeg", data=data, width=0, height=0, made_from=made_from)

    def image(self, image: Image, frame: SourceFrame) -> Image:
        """The message that crosses."""
        is_raw = self._how == "raw"
        if image.missing or frame.encoding != "jpeg" or (is_raw and not image.colour.size):
            return image
        return replace(
            image,
            grey=image.grey if is_raw else _NO_PIXELS,
            colour=image.colour[:0, :0],
            jpeg=frame.data,
            calibration=self._calibration,
        )


def receive_images(bus: Bus, *, mapped_only: bool = False) -> Iterator[Image]:
    """Every ``camera/image`` with its grey pixels, in whatever form it was sent.

    mapped_only: images that bundle adjustment skips stay as sent, perhaps without pixels.
    Raises MessageError for one that no sender of ours makes.
    """
    for image in receive(bus, topics.IMAGE, Image):
        unused = mapped_only and image.unmapped
        yield image if image.grey.size or unused else whole(image)


def whole(image: Image) -> Image:
    """The image with colours, too.  Raises MessageError if its JPEG gives none."""
    if not image.jpeg:
        return image
    where = f"{topics.IMAGE.key}: frame {image.frame}"
    try:
        calibration, rectifier = _rectifier(image.calibration)
        size = (calibration.width, calibration.height)
        if jpeg_size(image.jpeg) not in (size, size[::-1]):  # it may state an orientation
            raise MessageError(f"{where}: a JPEG of another size than its camera's")
        frame = SourceFrame(
            index=image.frame, stamp_ns=image.stamp_ns, encoding="jpeg", data=image.jpeg
        )
        grey, colour = rectifier.rectify(frame)
    except MessageError:
        raise
    except PliantError as error:
        raise MessageError(f"{where}: {error}") from None
    none = np.zeros((0, 0, 3), np.uint8)
    return replace(
        image, grey=grey, colour=none if colour is None else colour, jpeg=b"", calibration=""
    )


def clearance(image: Image) -> F32 | None:
    """Clearance of the mask of an image with pixels.  Raises MessageError if its size differs."""
    where = f"{topics.IMAGE.key}: frame {image.frame}"
    try:
        found = clearance_in(image.mask)
    except ValueError as error:
        raise MessageError(f"{where}: {error}") from None
    if found is not None and found.shape != image.grey.shape:
        raise MessageError(f"{where}: a mask of another size than the image")
    return found


@lru_cache(maxsize=2)
def _rectifier(calibration: str) -> tuple[Calibration, Rectifier]:
    camera = calibration_from_yaml(calibration)
    return camera, Rectifier(camera)
