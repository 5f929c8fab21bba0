"""Pliant: trajectory, dense map and deforming surfaces from the video of one camera."""

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

from pliant import arithmetic
from pliant.version import __version__ as __version__

if TYPE_CHECKING:
    from pliant.algorithms.camera import PinholeCamera as PinholeCamera
    from pliant.api.evaluation import evaluate as evaluate
    from pliant.api.evaluation import read_trajectory as read_trajectory
    from pliant.api.known import KnownMap as KnownMap
    from pliant.api.known import Located as Located
    from pliant.api.known import load_map as load_map
    from pliant.api.result import Result as Result
    from pliant.api.result import open as open
    from pliant.api.run import run as run
    from pliant.api.slam import Slam as Slam
    from pliant.api.slam import Tracked as Tracked
    from pliant.api.slam import follow as follow
    from pliant.datasets.calibration import Calibration as Calibration
    from pliant.trajectory import Trajectory as Trajectory

arithmetic.fix()
# FFmpeg is silent, because our own messages describe a broken video.  OpenCV reads this once.
os.environ.setdefault("OPENCV_FFMPEG_LOGLEVEL", "-8")

_WHERE = {
    "Calibration": "pliant.datasets.calibration",
    "KnownMap": "pliant.api.known",
    "Located": "pliant.api.known",
    "PinholeCamera": "pliant.algorithms.camera",
    "Result": "pliant.api.result",
    "Slam": "pliant.api.slam",
    "Tracked": "pliant.api.slam",
    "Trajectory": "pliant.trajectory",
    "evaluate": "pliant.api.evaluation",
    "follow": "pliant.api.slam",
    "load_map": "pliant.api.known",
    "open": "pliant.api.result",
    "read_trajectory": "pliant.api.evaluation",
    "run": "pliant.api.run",
}
"""Loaded on demand: a service that needs none of it starts faster."""


def __getattr__(name: str) -> Any:
    if name not in _WHERE:
        raise AttributeError(f"module 'pliant' has no attribute {name!r}")
    return getattr(import_module(_WHERE[name]), name)


def __dir__() -> list[str]:
    return sorted([*globals(), *_WHERE])
