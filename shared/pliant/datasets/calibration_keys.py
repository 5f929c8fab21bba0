"""The values of a calibration file by key, and the camera of it that is meant."""

from dataclasses import dataclass
from typing import Any, TypeAlias

Keys: TypeAlias = dict[str, Any]
"""The values of a file, by key."""


@dataclass(frozen=True)
class Wanted:
    """Which camera of a file is meant.

    image_size: (width, height) of its images, if known.    kitti_camera: number of KITTI's.
    camera: as the user names it, "cam1" or "1"; "".   source: topic or folder of the images; "".
    """

    image_size: tuple[int, int] | None = None
    kitti_camera: int = 0
    camera: str = ""
    source: str = ""
