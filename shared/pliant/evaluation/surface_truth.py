"""The exact ground truth about a deforming built-in sequence, read from its folder."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F32, F64, I32, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, transform
from pliant.datasets.builtin_deforming import SURFACES_NAME
from pliant.errors import DatasetError
from pliant.formats.tum import read_tum
from pliant.rendering.sheet_render import look_at_pixels
from pliant.rendering.sheets import material_positions

_HIDDEN_M = 1e-3


@dataclass(frozen=True)
class MaterialPoints:
    """N points of surfaces.  sheet: -1 where there is none.  where: column and row in its grid."""

    sheet: I32  # (N,)
    where: F64  # (N, 2)


class SurfaceTruth:
    """Where material points are in every frame.  The world is that of the sequence."""

    def __init__(self, folder: Path, camera: PinholeCamera) -> None:
        """Raises DatasetError if the folder is not one of a deforming built-in sequence."""
        file = folder / SURFACES_NAME
        if not file.is_file():
            raise DatasetError(
                f"{folder}: has no {SURFACES_NAME}: it is not a deforming built-in sequence"
            )
        with np.load(file, allow_pickle=False) as content:
            self.names: list[str] = content["names"].tolist()
            self._vertices: list[F32] = [content[f"vertices_{k}"] for k in range(len(self.names))]
        self.camera = camera
        self.T_world_camera: F64 = np.asarray(
            read_tum(folder / "groundtruth.txt").T_world_camera, np.float64
        )

    def __len__(self) -> int:
        return len(self.T_world_camera)

    @property
    def moving_camera(self) -> bool:
        """Whether the camera moves."""
        return bool(np.ptp(self.T_world_camera, axis=0).max() > 1e-9)

    def sheets(self, frame: int) -> list[F64]:
        """(R, C, 3) vertices of all sheets."""
        return [vertices[frame].astype(np.float64) for vertices in self._vertices]

    def at_pixels(self, frame: int, points_px: F32 | F64) -> MaterialPoints:
        """The material points of a frame at (N, 2) pixels."""
        pixels = np.asarray(points_px, np.float64)
        sheet, where, _ = look_at_pixels(
            self.sheets(frame), self.T_world_camera[frame], self.camera, pixels
        )
        return MaterialPoints(sheet, where)

    def depths(self, frame: int, points_px: F64) -> F64:
        """(N,) depth along the optical axis at (N, 2) pixels; 0: no sheet."""
        return look_at_pixels(
            self.sheets(frame), self.T_world_camera[frame], self.camera, points_px
        )[2]

    def positions(self, points: MaterialPoints, frame: int) -> F64:
        """(N, 3) metres, world; NaN where there is no sheet."""
        out = np.full((len(points.sheet), 3), np.nan)
        for number, vertices in enumerate(self._vertices):
            mine = points.sheet == number
            if mine.any():
                grid = vertices[frame].astype(np.float64)
                out[mine] = material_positions(grid, points.where[mine])
        return out

    def visible(self, points: MaterialPoints, frame: int, margin_px: float = 0.0) -> BoolArray:
        """(N,) whether points are in the image, this far from its border, and not occluded."""
        T_camera_world = inverse(self.T_world_camera[frame])
        positions = transform(T_camera_world, self.positions(points, frame))
        front = positions[:, 2] > 0.0
        positions[~front] = (0.0, 0.0, 1.0)
        pixels = self.camera.project(positions)
        size = (self.camera.width - 1 - margin_px, self.camera.height - 1 - margin_px)
        front &= ((pixels >= margin_px) & (pixels <= size)).all(axis=1)
        _, _, depth = look_at_pixels(
            self.sheets(frame), self.T_world_camera[frame], self.camera, pixels
        )
        return front & (np.abs(depth - positions[:, 2]) < _HIDDEN_M)
