"""Frames of surfels on a sheet that stretches."""

import numpy as np

from pliant.algorithms.surfels.surfel_frame import SurfelFrame
from pliant.messages.types import Surfels

FIELDS = SurfelFrame.__dataclass_fields__


def surfels_in(frame: int, stretch: float, side: int = 11) -> Surfels:
    """A sheet 2 m away that is longer by ``stretch`` along x."""
    x, y = np.meshgrid(np.linspace(-0.5, 0.5, side), np.linspace(-0.5, 0.5, side))
    points = np.stack([(1.0 + stretch) * x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1)
    n = len(points)
    floats = np.ones(n, np.float32)
    empty = SurfelFrame.empty()
    columns = {name: getattr(empty, name) for name in FIELDS} | {
        "frame": frame, "lost": False, "ids": np.arange(n), "positions": points,
        "tangents": np.broadcast_to(np.eye(3)[:, :2], (n, 3, 2)).copy(),
        "deformations": np.tile([1.0, 0.0, 1.0], (n, 1)),
        "points_px": (500.0 * points[:, :2] / points[:, 2:] + 300.0).astype(np.float32),
        "state": np.zeros(n, np.uint8), "age": np.zeros(n, np.int32), "born": np.zeros(n, np.int32),
    }  # fmt: skip
    columns |= dict.fromkeys(("zncc", "visible", "sigma", "gains", "biases"), floats)
    return Surfels(stamp_ns=10**8 * frame, frame_id="world", missing="", note="", **columns)
