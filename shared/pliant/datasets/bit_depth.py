"""Images with values of 9 to 15 bits in 16: the lowest of these that are used become 8.

Cameras write 10, 12 or 14 bits into 16; the upper byte alone would be nearly black.  All frames of
a source are treated alike, by the largest value of some of them.
"""

import re
from collections.abc import Iterable
from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.image.decoding import decoded
from pliant.datasets.base import SourceFrame
from pliant.datasets.raw_pixels import RAW_BYTES, colours, deep_pixels, is_deep

_ALL = 16
_PNM = re.compile(rb"P[56]\s(?:\s*#[^\n]*\n)*\s*[0-9]+\s+[0-9]+\s+([0-9]+)\s")
_PNG_DEPTH_AT = 24


def bits_used(frames: Iterable[SourceFrame]) -> int:
    """How many bits the values of frames with 16 have; 16 where it is all, or they have 8."""
    largest = -1
    for frame in frames:
        pixels = _deep(frame) if _may_be_deep(frame) else None
        largest = max(largest, int(pixels.max()) if pixels is not None and pixels.size else -1)
    return _ALL if largest < 0 else max(8, largest.bit_length())


def eight_bits(frame: SourceFrame, bits: int) -> SourceFrame:
    """A frame of 16 bits of which that many are used, as raw pixels of 8; others as they are."""
    if bits >= _ALL or not _may_be_deep(frame):
        return frame
    pixels = _deep(frame)
    if pixels is None:
        return frame
    small = np.minimum(pixels >> (bits - 8), 255).astype(np.uint8)
    if is_deep(frame.encoding):
        small = colours(frame.encoding, small if small.ndim == 3 else small[:, :, None])
    elif small.ndim == 3:
        small = np.ascontiguousarray(small[:, :, ::-1])
    return replace(
        frame,
        encoding="mono8" if small.ndim == 2 else "rgb8",
        data=small.tobytes(),
        width=small.shape[1],
        height=small.shape[0],
        made_from=f"{frame.encoding} of {bits} bits",
    )


def note_on(bits: int) -> list[str]:
    """A note for the user."""
    if bits >= _ALL:
        return []
    return [f"16-bit images use {bits} bits: these are scaled to 8 bits, in all images alike"]


def _may_be_deep(frame: SourceFrame) -> bool:
    """By the encoding or the header, without decoding."""
    if frame.encoding in RAW_BYTES:
        return is_deep(frame.encoding)
    if frame.encoding == "png":
        return frame.data[_PNG_DEPTH_AT : _PNG_DEPTH_AT + 1] == b"\x10"
    if frame.encoding == "pnm":
        header = _PNM.match(frame.data)
        return header is not None and int(header[1][:6]) > 255
    return frame.encoding in ("tiff", "unknown") and bool(frame.data)


def _deep(frame: SourceFrame) -> NDArray[np.uint16] | None:
    """Pixels of 16 bits, BGR where a file has colour; None if it has others, or none."""
    if is_deep(frame.encoding):
        size = RAW_BYTES[frame.encoding] * frame.width * frame.height
        if not size or len(frame.data) != size:
            return None
        return deep_pixels(frame.encoding, frame.data, frame.width, frame.height)
    pixels = decoded(frame.data, cv2.IMREAD_ANYCOLOR | cv2.IMREAD_ANYDEPTH)
    return pixels if pixels is not None and pixels.dtype == np.uint16 else None
