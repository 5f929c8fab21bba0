"""From the bytes of a frame to the rectified image: a pure function of the frame and the camera.

A replay makes the same images again from what was recorded, so nothing here may depend on files,
time or earlier frames.
"""

from typing import cast

import cv2
import numpy as np

from pliant.algorithms.arrays import U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.image.decoding import decoded
from pliant.algorithms.image.masks import packed, scaled, unpacked
from pliant.algorithms.rectification import rectification_maps, rectified_camera, resample
from pliant.datasets.base import BrokenFrame, SourceFrame
from pliant.datasets.calibration import Calibration
from pliant.datasets.raw_pixels import RAW_BYTES, colours, is_deep, raw_rows
from pliant.messages.types import BROKEN, CAMERA_FRAME_ID, DROPPED, MASKED, Image


def decode(frame: SourceFrame) -> U8:
    """(H, W) grey or (H, W, 3) RGB pixels of a frame.

    More than 8 bits a channel are reduced to 8, transparency is dropped, and the orientation that
    a JPEG states is applied, all as ``cv2.imread`` does.

    Raises BrokenFrame, naming the frame, where the bytes are no whole image.
    """
    if frame.dropped:
        raise BrokenFrame(f"{frame.called}: it was dropped, there is nothing to decode")
    if frame.encoding in RAW_BYTES:
        return _decode_raw(frame)
    if not frame.data:
        why = frame.made_from or "empty: its file is gone, or the video is damaged"
        raise BrokenFrame(f"{frame.called}: {why}")
    if not _whole(frame):
        raise BrokenFrame(f"{frame.called}: the {frame.encoding} image is cut off")
    pixels = decoded(frame.data, cv2.IMREAD_ANYCOLOR)
    if pixels is None:
        kind = "image" if frame.encoding == "unknown" else f"{frame.encoding} image"
        raise BrokenFrame(f"{frame.called}: the {kind} does not decode")
    return _rgb(pixels) if pixels.ndim == 3 else pixels


class Rectifier:
    """Turns frames of one camera into the rectified images that all services process."""

    def __init__(self, calibration: Calibration) -> None:
        self._size = (calibration.width, calibration.height)
        lens = calibration.lens
        self._camera = rectified_camera(lens)  # Calibration has seen to it that there is one
        self._maps = rectification_maps(lens, self._camera) if lens.distorts else None
        self._last_mask = b"", (b"", False)

    @property
    def camera(self) -> PinholeCamera:
        """The camera of the rectified images."""
        return self._camera

    @property
    def changes_nothing(self) -> bool:
        """Whether rectified images are the source's."""
        return self._maps is None

    def rectify(self, frame: SourceFrame) -> tuple[U8, U8 | None]:
        """Grey (H, W), and RGB (H, W, 3) where the source has colour.

        Without distortion the pixels are untouched.  Raises BrokenFrame if the frame does not
        decode, or has another size than the calibration.
        """
        pixels = decode(frame)
        height, width = pixels.shape[:2]
        if (width, height) != self._size:
            raise BrokenFrame(
                f"{frame.called}: {width}x{height} px, but the camera has "
                f"{self._size[0]}x{self._size[1]}"
            )
        if self._maps is not None:
            pixels = resample(pixels, self._maps)
        if pixels.ndim == 2:
            return pixels, None
        return cast(U8, cv2.cvtColor(pixels, cv2.COLOR_RGB2GRAY)), pixels

    def mask(self, frame: SourceFrame) -> bytes:
        """The mask of the frame's rectified image, packed; b"" if all of it is used.

        A pixel is used where all that it is made of is.  Raises BrokenFrame for a mask that does
        not decode, or has another aspect.
        """
        return self._masking(frame)[0]

    def is_hidden(self, frame: SourceFrame) -> bool:
        """Whether its mask leaves nothing of the frame's rectified image.  Raises as ``mask``."""
        return self._masking(frame)[1]

    def _masking(self, frame: SourceFrame) -> tuple[bytes, bool]:
        """A mask that stays is unpacked once."""
        if frame.mask != self._last_mask[0]:
            self._last_mask = frame.mask, self._rectified_mask(frame)
        return self._last_mask[1]

    def _rectified_mask(self, frame: SourceFrame) -> tuple[bytes, bool]:
        if not frame.mask:
            return b"", False
        try:
            pixels = 255 * scaled(unpacked(frame.mask), self._size).astype(np.uint8)
        except ValueError as error:
            raise BrokenFrame(f"{frame.called}: its mask is {error}") from None
        if self._maps is not None:
            pixels = resample(pixels, self._maps)
        used = pixels == 255
        return b"" if used.all() else packed(used), not used.any()


def _decode_raw(frame: SourceFrame) -> U8:
    size, rows = RAW_BYTES[frame.encoding], raw_rows(frame.encoding, frame.height)
    what = f"no {frame.encoding} image of {frame.width}x{frame.height} px"
    if min(frame.width, frame.height) <= 0 or len(frame.data) != frame.width * rows * size:
        raise BrokenFrame(f"{frame.called}: {len(frame.data)} bytes are {what}")
    pixels = np.frombuffer(frame.data, np.uint8).reshape(rows, frame.width, size)
    if is_deep(frame.encoding):
        pixels = np.ascontiguousarray(pixels[:, :, 1::2])  # the upper bytes
    try:
        return colours(frame.encoding, pixels)
    except ValueError as error:
        raise BrokenFrame(f"{frame.called}: is {what}: it {error}") from None


def _rgb(bgr: U8) -> U8:
    return cast(U8, cv2.cvtColor(bgr, cv2.COLOR_BGR2RGB))


def _whole(frame: SourceFrame) -> bool:
    """Whether a file format's end marker is there.

    Decoders fill what an interrupted copy lacks with grey (which of them do depends on the
    version), and a tracker would lose its points there without a visible reason.
    """
    if frame.encoding == "jpeg":
        # A thumbnail inside has markers of its own: the end must follow the last scan.
        return frame.data.rfind(b"\xff\xd9") > frame.data.rfind(b"\xff\xda")
    if frame.encoding == "png":
        return frame.data.rfind(b"IEND") > 0
    return True


def rectified(
    source: SourceFrame,
    rectifier: Rectifier,
    *,
    unmapped: bool = False,
    unplaced: bool = False,
) -> Image:
    """The image that all services process: a pure function, so that a replay makes the same.

    unmapped, unplaced: as it was decided on and recorded.
    """
    if source.dropped:
        return _without_pixels(source, DROPPED)
    try:
        grey, colour = rectifier.rectify(source)
        mask, hidden = rectifier.mask(source), rectifier.is_hidden(source)
    except BrokenFrame as error:
        return _without_pixels(source, f"{BROKEN}{error}")
    if hidden:
        return _without_pixels(source, MASKED)
    return Image(
        frame=source.index,
        stamp_ns=source.stamp_ns,
        frame_id=CAMERA_FRAME_ID,
        grey=grey,
        colour=colour if colour is not None else np.zeros((0, 0, 3), np.uint8),
        unmapped=unmapped,
        unplaced=unplaced,
        mask=mask,
    )


def _without_pixels(source: SourceFrame, why: str) -> Image:
    return Image(
        frame=source.index,
        stamp_ns=source.stamp_ns,
        frame_id=CAMERA_FRAME_ID,
        grey=np.zeros((0, 0), np.uint8),
        colour=np.zeros((0, 0, 3), np.uint8),
        missing=why,
    )
