"""The deforming surface as a sequence of meshes: ``pliant export --to surface``."""

from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F32, U8
from pliant.algorithms.surfels.surface import surface_of
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.errors import ResultError
from pliant.export.images import camera_of, make_folder, rectified_images
from pliant.formats.ply import write_ply
from pliant.messages import topics
from pliant.messages.types import Surfels
from pliant.pictures.masked import dimmed
from pliant.pictures.overlay import draw_marks
from pliant.recording.reader import Recording
from pliant.results.surfel_frames import final_surfels, has_surfels
from pliant.viewers.surfel_quads import surfel_picture


def surfaces(recording: Recording, path: Path, folder: Path | None, every: int = 1) -> None:
    """``NNNNNN.ply`` for each ``every``-th frame: tracked surfels, joined to triangles, in colour.

    In metres, or in units of our own map, and in the world of the segment.  Raises ResultError for
    a recording without surfels.
    """
    check_deformable(recording)
    make_folder(path)
    for surfels, pixels in surfels_with_images(recording, lambda s: s.frame % every == 0):
        _write(path / f"{surfels.frame:06d}.ply", surfels, pixels)


def check_deformable(recording: Recording) -> None:
    """Raise ResultError for a recording without surfels."""
    if not has_surfels(recording.path):
        raise ResultError(f"{recording.path}: has no surfels: run it with --profile deformable")


def surfels_with_images(
    recording: Recording, wanted: Callable[[Surfels], bool]
) -> Iterator[tuple[Surfels, U8 | None]]:
    """The wanted frames that have surfels, with their images, None if there is none."""
    has_images = next(recording.messages(topics.SOURCE), None) is not None
    images = rectified_images(recording, camera_of(recording)) if has_images else iter(())
    pixels: U8 | None = None
    seen = -1
    for surfels in final_surfels(recording.path):
        if surfels.missing or not wanted(surfels):
            continue
        while seen < surfels.frame:
            seen, _, pixels, _ = next(images, (surfels.frame, 0, None, None))
        yield surfels, pixels if seen == surfels.frame else None


def colours_at(pixels: U8, points_px: F32) -> U8:
    """(N, 3) RGB of the nearest pixels."""
    column, row = np.rint(points_px).astype(np.int64).T
    height, width = pixels.shape[:2]
    colours = pixels[np.clip(row, 0, height - 1), np.clip(column, 0, width - 1)]
    return np.broadcast_to(colours.reshape(-1, *pixels.shape[2:] or (1,)), (len(points_px), 3))


def overlay_pictures(recording: Recording) -> Iterator[U8]:
    """Each frame with its surfels, coloured by state as in the viewers."""
    stream = camera_of(recording)
    images = rectified_images(recording, stream)
    states = {
        SurfelState.TRACKED: "alive",
        SurfelState.OUTLIER: "outlier (red)",
        SurfelState.OCCLUDED: "occluded (violet)",
        SurfelState.LOST: "lost",
    }
    for surfels in final_surfels(recording.path):
        if surfels.missing:
            continue
        image = next(each for each in images if each.number == surfels.frame)
        seen = surfel_picture(surfels, stream.camera)
        counts = [f"{np.count_nonzero(surfels.state == s)} {name}" for s, name in states.items()]
        words = "   ".join([f"frame {surfels.frame}", *counts])
        shown = dimmed(image.pixels, image.used)
        yield draw_marks(shown, seen.points_px, seen.point_colours, words)


def _write(path: Path, surfels: Surfels, pixels: U8 | None) -> None:
    rows, normals, triangles = surface_of(surfels)
    positions = surfels.positions[rows].astype(np.float32)
    colours = None if pixels is None else colours_at(pixels, surfels.points_px[rows])
    write_ply(path, positions, colours, normals=normals, faces=triangles)
