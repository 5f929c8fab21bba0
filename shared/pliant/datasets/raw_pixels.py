"""Raw pixels as cameras and ROS give them: how many bytes they take, and what colours they are."""

from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.arrays import U8

_BAYER = {
    "bayer_rggb": cv2.COLOR_BayerRGGB2RGB,
    "bayer_bggr": cv2.COLOR_BayerBGGR2RGB,
    "bayer_gbrg": cv2.COLOR_BayerGBRG2RGB,
    "bayer_grbg": cv2.COLOR_BayerGRBG2RGB,
}
_CHANNELS = {"mono": 1, "bgr": 3, "rgb": 3, "bgra": 4, "rgba": 4, **dict.fromkeys(_BAYER, 1)}
_YUV = {
    "uyvy": cv2.COLOR_YUV2RGB_UYVY,
    "yuyv": cv2.COLOR_YUV2RGB_YUYV,
    "nv12": cv2.COLOR_YUV2RGB_NV12,
    "nv21": cv2.COLOR_YUV2RGB_NV21,
}
_HALF_HEIGHT = ("nv12", "nv21")
"""Below the brightness, rows of both colours at half the resolution."""

RAW_BYTES: dict[str, int] = {
    **{f"{name}8": count for name, count in _CHANNELS.items()},
    **{f"{name}16": 2 * count for name, count in _CHANNELS.items()},
    **{name: 1 if name in _HALF_HEIGHT else 2 for name in _YUV},
}
"""Bytes of a pixel in a row of each raw encoding; 16 bits are little-endian."""

OTHER_NAMES = {
    "8UC1": "mono8",
    "8UC3": "bgr8",
    "8UC4": "bgra8",
    "16UC1": "mono16",
    "16UC3": "bgr16",
    "16UC4": "bgra16",
    "yuv422": "uyvy",
    "yuv422_uyvy": "uyvy",
    "yuv422_yuy2": "yuyv",
    "yuy2": "yuyv",
    "mono": "mono8",
    "bgr": "bgr8",
    "rgb": "rgb8",
    "gray8": "mono8",
    "gray16": "mono16",
}
"""Their names elsewhere: OpenCV's, which ROS uses, too, and those of drivers."""


def raw_rows(encoding: str, height: int) -> int:
    """Rows of bytes in an image of that many rows of pixels."""
    return height + (height + 1) // 2 if encoding in _HALF_HEIGHT else height


def is_deep(encoding: str) -> bool:
    """Whether there are 16 bits a channel."""
    return encoding.endswith("16") and encoding in RAW_BYTES


def deep_pixels(encoding: str, data: bytes, width: int, height: int) -> NDArray[np.uint16]:
    """(H, W) or (H, W, C) values of 16 bits, in the order of the encoding; see ``is_deep``."""
    pixels = np.frombuffer(data, "<u2").reshape(height, width, -1)
    return pixels[:, :, 0] if pixels.shape[2] == 1 else pixels


def colours(encoding: str, pixels: U8) -> U8:
    """(H, W) grey or (H, W, 3) RGB of rows (H', W, C) of a raw encoding reduced to 8 bits.

    Raises ValueError for a size that the encoding cannot have.
    """
    if encoding in _YUV:
        try:
            rows = pixels[:, :, 0] if encoding in _HALF_HEIGHT else pixels
            return cast(U8, cv2.cvtColor(np.ascontiguousarray(rows), _YUV[encoding]))
        except cv2.error:
            raise ValueError("has an odd number of rows or columns") from None
    match encoding.rstrip("0123456789"):
        case "mono":
            return pixels[:, :, 0]
        case "rgb":
            return pixels
        case "bgr":
            return cast(U8, cv2.cvtColor(pixels, cv2.COLOR_BGR2RGB))
        case "rgba":
            return np.ascontiguousarray(pixels[:, :, :3])
        case "bgra":
            return np.ascontiguousarray(pixels[:, :, 2::-1])
        case bayer:
            return cast(U8, cv2.cvtColor(pixels[:, :, 0], _BAYER[bayer]))
