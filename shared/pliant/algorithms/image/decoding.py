"""Image files from anywhere: decoded, or None."""

from typing import Any

import cv2
import numpy as np


def decoded(data: bytes, flags: int) -> Any:
    """The pixels as ``cv2.imdecode`` gives them; None for what is no image, or one too large."""
    if not data:
        return None
    try:
        return cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except (cv2.error, MemoryError):
        return None
