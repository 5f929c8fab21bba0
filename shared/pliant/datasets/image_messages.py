"""Images and calibrations as ROS and Foxglove messages carry them, whatever file they come from.

Images: sensor_msgs Image and CompressedImage, foxglove RawImage and CompressedImage.
Calibrations: sensor_msgs CameraInfo, foxglove CameraCalibration.

Compressed bytes stay as they are; rows of raw pixels lose their padding and nothing else.
"""

from dataclasses import dataclass
from typing import Any, cast

import numpy as np

from pliant.datasets.base import BrokenFrame, SourceFrame, encoding_of
from pliant.datasets.calibration import Calibration
from pliant.datasets.calibration_files import calibration_from_camera_info
from pliant.datasets.raw_pixels import OTHER_NAMES, RAW_BYTES, is_deep, raw_rows
from pliant.errors import CalibrationError
from pliant.wording import shortened, shown

IMAGE_TYPES = (
    "sensor_msgs/Image",
    "sensor_msgs/CompressedImage",
    "foxglove/RawImage",
    "foxglove/CompressedImage",
)
CALIBRATION_TYPES = ("sensor_msgs/CameraInfo", "foxglove/CameraCalibration")
_RAW_TYPES = (IMAGE_TYPES[0], IMAGE_TYPES[2])


@dataclass(frozen=True)
class RecordedImage:
    """An image message: when it was recorded, and the fields of its type.

    fault: why there are none; "" where there are.
    """

    log_time_ns: int
    message: Any
    fault: str = ""


def plain_type(name: str) -> str:
    """One name for a type that ROS 1, ROS 2 and Foxglove write in different ways."""
    name = name.replace("/msg/", "/")
    for prefix in ("foxglove.", "foxglove_msgs/"):
        name = name.replace(prefix, "foxglove/")
    return name


def capture_time(image: RecordedImage) -> int:
    """Nanoseconds of the header; of the recording where the header has no time."""
    header = getattr(image.message, "header", None)
    stamp = header.stamp if header is not None else image.message.timestamp
    if isinstance(stamp, str):  # JSON as protobuf writes it
        stamp_ns = int(np.datetime64(stamp.removesuffix("Z"), "ns").astype(np.int64))
    else:
        # sec, nanosec (ROS 2); sec, nsec (Foxglove's JSON); seconds, nanos (protobuf)
        whole = _first(stamp, "sec", "seconds")
        stamp_ns = int(whole) * 10**9 + int(_first(stamp, "nanosec", "nsec", "nanos"))
    return stamp_ns or image.log_time_ns


def source_frame(kind: str, image: RecordedImage, index: int) -> SourceFrame:
    """The frame in a message of one of the ``IMAGE_TYPES``.

    Raises BrokenFrame for a message that is damaged, or pixels of a kind that is not understood.
    """
    if image.fault:
        raise BrokenFrame(image.fault)
    try:
        return _frame_of(kind, image, index)
    except FOREIGN as error:  # JSON may have anything
        reason = shortened(" ".join(str(error).split())) or type(error).__name__
        raise BrokenFrame(f"its message is no {kind} ({reason})") from None


FOREIGN = (AttributeError, TypeError, ValueError, OverflowError, KeyError)
"""The errors of reading fields that are absent or of another type."""


def _frame_of(kind: str, image: RecordedImage, index: int) -> SourceFrame:
    message, stamp_ns = image.message, capture_time(image)
    if kind not in _RAW_TYPES:
        data = bytes(message.data)
        return SourceFrame(index=index, stamp_ns=stamp_ns, encoding=encoding_of(data), data=data)
    encoding = OTHER_NAMES.get(message.encoding, message.encoding)
    if encoding not in RAW_BYTES:
        raise BrokenFrame(
            f"images with encoding {shown(message.encoding)} are not supported; convert them to "
            f"one of {', '.join(RAW_BYTES)}"
        )
    return SourceFrame(
        index=index,
        stamp_ns=stamp_ns,
        encoding=encoding,
        data=_rows(message, encoding),
        width=int(message.width),
        height=int(message.height),
    )


def _rows(message: Any, encoding: str) -> bytes:
    """The pixels without padding, little-endian.  As they are where they do not fit the size: the
    frame is then counted as broken."""
    width, step = int(message.width), int(message.step)
    rows = raw_rows(encoding, int(message.height))
    row = width * RAW_BYTES[encoding]
    pixels = np.frombuffer(bytes(message.data), np.uint8)
    if pixels.size == rows * step and step > row:
        pixels = pixels.reshape(rows, step)[:, :row]
    if is_deep(encoding) and getattr(message, "is_bigendian", False) and pixels.size % 2 == 0:
        pixels = np.ascontiguousarray(pixels).reshape(-1).view(">u2").astype("<u2").view(np.uint8)
    return pixels.tobytes()


def calibration(message: Any, *, rectified: bool) -> Calibration:
    """The camera of a CameraInfo or CameraCalibration.

    rectified: the images have been rectified, so that the projection matrix is the camera.
    Raises CalibrationError for a camera that was never calibrated, and for binned or cropped
    images, whose matrix is for the whole sensor.
    """
    content: dict[str, Any] = {"image_width": message.width, "image_height": message.height}
    K, P = _numbers(message, "k"), _numbers(message, "p")
    if rectified and len(P) == 12 and P[0] > 0.0:
        content["camera_matrix"] = {"data": [*P[0:3], *P[4:7], *P[8:11]]}
        content["distortion_coefficients"] = {"data": []}
        return calibration_from_camera_info(content)
    if len(K) != 9 or K[0] == 0.0:
        raise CalibrationError("the camera is not calibrated (K is zero)")
    _check_region(message)
    content["camera_matrix"] = {"data": K}
    content["distortion_model"] = str(message.distortion_model)
    content["distortion_coefficients"] = {"data": _numbers(message, "d")}
    return calibration_from_camera_info(content)


def _check_region(message: Any) -> None:
    region = getattr(message, "roi", None)
    cropped = region is not None and 0 < int(region.width) * int(region.height) < int(
        message.width
    ) * int(message.height)
    if cropped or max(getattr(message, "binning_x", 0), getattr(message, "binning_y", 0)) > 1:
        raise CalibrationError(
            "the images are binned or cropped, but the calibration is for full images"
        )


def _numbers(message: Any, name: str) -> list[float]:
    """A matrix of the message; ROS 1 and Foxglove write it with a capital letter."""
    values = getattr(message, name, None)
    values = getattr(message, name.upper(), ()) if values is None else values
    return [float(value) for value in cast(Any, values)]


def _first(record: Any, *names: str) -> Any:
    """The first of the fields that is there; 0 where none is (JSON leaves zeros out)."""
    return next((getattr(record, name) for name in names if hasattr(record, name)), 0)
