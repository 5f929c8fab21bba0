"""Sequences for the tables of surfels: images, depth maps and truth, loaded once."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.datasets import open_source
from pliant.datasets.base import BrokenFrame, is_builtin
from pliant.datasets.builtin import builtin_folder, is_deforming
from pliant.datasets.depth import DepthRectifier
from pliant.datasets.rectifier import Rectifier
from pliant.datasets.source_spec import SourceSpec
from pliant.errors import DatasetError
from pliant.evaluation.surface_truth import SurfaceTruth


@dataclass(frozen=True)
class Sequence:
    """What all rows share.  Depth maps are empty where nobody needs them."""

    camera: PinholeCamera
    images: list[U8]
    stamps_ns: list[int]
    depths: list[F64]
    truth: SurfaceTruth | None

    def interval_s(self, number: int) -> float:
        """From the frame before to this one."""
        return 1e-9 * (self.stamps_ns[number] - self.stamps_ns[number - 1])


def load(source: str, frames: int, *, all_depths: bool = False) -> Sequence:
    """Its first frames.  With exact surfaces only the first depth map, or ``all_depths``.

    Raises DatasetError.
    """
    folder = str(builtin_folder(source)) if is_builtin(source) else source
    dataset = open_source(SourceSpec(location=folder, depth="all"))
    rectifier, depths = Rectifier(dataset.calibration), DepthRectifier(dataset.calibration)
    exact = is_deforming(source)
    images: list[U8] = []
    stamps_ns: list[int] = []
    maps: list[F64] = []
    for frame in dataset:
        if len(images) == frames:
            break
        try:
            grey, _ = rectifier.rectify(frame)
            # Only one that has no exact surfaces is judged by its depth in every frame.
            needed = frame.depth and (not exact or not maps or all_depths)
            depth = depths.rectify(frame.index, frame.depth) if needed else np.zeros((0, 0))
        except BrokenFrame as error:
            raise DatasetError(f"{source}: {error}") from None
        images.append(grey)
        stamps_ns.append(frame.stamp_ns)
        maps.append(depth)
    if not images or not maps[0].size:
        raise DatasetError(f"{source}: its first frame has no depth map to start from")
    truth = SurfaceTruth(Path(folder), rectifier.camera) if exact else None
    return Sequence(rectifier.camera, images, stamps_ns, maps, truth)
