"""How large the images of a source are, where not all of them are of one size."""

from collections import Counter
from collections.abc import Sequence

import cv2

from pliant.algorithms.image.decoding import decoded
from pliant.datasets.base import SourceFrame
from pliant.datasets.jpeg import jpeg_size
from pliant.datasets.rectifier import decode

LOOKED_AT = 9
"""Images whose size is read; the most frequent size is the source's."""


def most_frequent(sizes: Sequence[tuple[int, int]]) -> tuple[int, int]:
    """The size that most have; of those that as many have, the first."""
    return Counter(sizes).most_common(1)[0][0]


def size_of(frame: SourceFrame) -> tuple[int, int]:
    """(width, height) of the image as it is decoded.  Raises BrokenFrame if it does not."""
    stated = jpeg_size(frame.data) if frame.encoding == "jpeg" else None
    small = _small_shape(frame.data) if stated is not None else None
    if stated is None or small is None:
        height, width = decode(frame).shape[:2]
        return width, height
    turned = (small[0] > small[1]) != (stated[1] > stated[0])  # as the file states
    return (stated[1], stated[0]) if turned else stated


def _small_shape(data: bytes) -> tuple[int, ...] | None:
    """(height, width) of an eighth of a JPEG, which is quick to decode."""
    small = decoded(data, cv2.IMREAD_REDUCED_GRAYSCALE_8)
    return None if small is None else small.shape
