"""The deforming built-in sequences: how their folders are filled.

Beside what every rendered sequence has, the folder holds ``surfaces.npz``, the exact ground truth:

    names                 (S,) of the sheets
    vertices_0, ...       (F, R, C, 3) float32, metres, world: the grid of each sheet in each frame

A sheet is made of triangles: each cell of its grid is split from its first to its last vertex.  A
material point is a sheet and its column and row in the grid.  There is no ``surface.ply``.
"""

import hashlib
import zipfile
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.datasets.sequence_files import Progress, render_threads, write_sequence
from pliant.errors import DatasetError
from pliant.formats.npz import NpzWriter
from pliant.rendering.deforming_scenes import (
    DeformingOptions,
    PaperOptions,
    deforming_scene,
    frame_numbers,
)
from pliant.rendering.film import CameraOptions
from pliant.rendering.sheets import DeformingScene

SURFACES_NAME = "surfaces.npz"
# Raise it with every change that alters a single pixel: old caches are then passed over.
RENDERER_VERSION = 1

_FPS = 30
_TRACKS_KEY = "P_gt_mm"
_WHERE_TRACKS = "add ?tracks=PATH of mdh_23frames_301pts.npz (Kinect paper, true points)"


@dataclass(frozen=True)
class DeformingPlan:
    """Everything that a sequence is made of.  numbers: of its frames, of 30 a second."""

    name: str
    scene: DeformingScene
    camera: CameraOptions
    options: DeformingOptions
    numbers: list[int]

    def description(self) -> dict[str, Any]:
        """The options and versions that determine every byte of the folder, as JSON."""
        digest = hashlib.sha256()
        for number in (self.numbers[0], self.numbers[len(self.numbers) // 2], self.numbers[-1]):
            digest.update(np.round(self.scene.path.T_world_camera(number / _FPS), 9).tobytes())
            for sheet in self.scene.sheets:
                digest.update(np.round(sheet.shape(number / _FPS), 9).tobytes())
        return {
            "renderer_version": RENDERER_VERSION,
            "sequence": self.name,
            "frames": len(self.numbers),
            "shapes_sha256": digest.hexdigest(),
            "camera": self.camera.model_dump(mode="json"),
            "options": self.options.model_dump(mode="json", exclude={"tracks"}),
            "materials": [sheet.material.model_dump(mode="json") for sheet in self.scene.sheets],
        }

    def render(self, folder: Path, progress: Progress) -> None:
        """Fill an empty folder, but for ``scene.json``."""
        from pliant.rendering.sheet_render import SheetRenderer, paint_sheet  # it has kernels

        scene = self.scene
        numbers = self.numbers
        with render_threads() as executor:
            textures = [paint_sheet(scene, i) for i in range(len(scene.sheets))]
            renderer = SheetRenderer(scene, textures, self.camera)
            write_sequence(
                folder,
                f"built-in:{self.name}",
                lambda index: renderer.frame(numbers[index], numbers[index] / _FPS),
                [number * 1_000_000_000 // _FPS for number in numbers],
                self.camera,
                scene.depth_scale,
                executor,
                progress,
            )
        with NpzWriter(folder / SURFACES_NAME) as npz:
            npz.add("names", np.array([sheet.name for sheet in scene.sheets]))
            for i, sheet in enumerate(scene.sheets):
                for number in self.numbers:
                    vertices = sheet.shape(number / _FPS).astype(np.float32)
                    npz.add(f"vertices_{i}", vertices[None])


def deforming_plan(name: str, options: DeformingOptions) -> DeformingPlan:
    """Check the options against the scene.  Raises DatasetError."""
    tracks = None
    if isinstance(options, PaperOptions):
        if options.tracks is None:
            raise DatasetError(f"built-in:{name}: needs the paper's points: {_WHERE_TRACKS}")
        tracks = _read_tracks(Path(options.tracks))
    scene = deforming_scene(name, options, tracks)
    numbers = frame_numbers(scene.frames, options.drop)
    if options.frames is not None and options.frames > len(numbers):
        raise DatasetError(
            f"built-in:{name}: frames={options.frames}: it has only {len(numbers)} frames"
        )
    numbers = numbers[: options.frames]
    return DeformingPlan(name, scene, options.camera(), options, numbers)


def _read_tracks(file: Path) -> F64:
    """(K, N, 3) metres.  Raises DatasetError."""
    if not file.is_file():
        raise DatasetError(f"{file}: no such file with the paper's points: {_WHERE_TRACKS}")
    try:
        with np.load(file, allow_pickle=False) as content:
            tracks = np.asarray(content[_TRACKS_KEY], np.float64) * 1e-3
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile, TypeError):
        raise DatasetError(
            f"{file}: holds no array {_TRACKS_KEY}; it should be mdh_23frames_301pts.npz"
        ) from None
    if tracks.ndim != 3 or tracks.shape[2] != 3 or min(tracks.shape[:2]) < 3:
        raise DatasetError(f"{file}: {_TRACKS_KEY} should be (frames, points, 3)")
    if not np.isfinite(tracks).all() or tracks[:, :, 2].min() <= 0.0:
        raise DatasetError(f"{file}: {_TRACKS_KEY} has points that are not in front of the camera")
    return tracks
