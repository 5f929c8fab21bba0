"""Strain of the deforming surface, as arrays and pictures: ``pliant export --to strain``."""

from pathlib import Path

import numpy as np

from pliant.algorithms.surfels.surface_over_time import surface_over_time
from pliant.algorithms.surfels.surface_strain import strains
from pliant.export.animation import key_frames
from pliant.export.images import make_folder
from pliant.export.surface_meshes import surfels_with_images
from pliant.formats.npz import NpzWriter
from pliant.pictures.movie import write_image
from pliant.pictures.strain_colours import strain_scale
from pliant.pictures.strain_map import draw_strain
from pliant.recording.reader import Recording


def strain_maps(
    recording: Recording, path: Path, folder: Path | None, every: int | None = None
) -> None:
    """A folder with ``strain.npz``, and ``NNNNNN.png`` for each key frame with an image.

    Key frames are those of an animation.  Raises ResultError as there.
    """
    _, _, wanted = key_frames(recording, every)
    make_folder(path)
    keys = [s for s, _ in surfels_with_images(recording, lambda s: s.frame in wanted)]
    surface = surface_over_time(keys)
    values = strains(surface)
    with NpzWriter(path / "strain.npz") as npz:
        npz.add("frames", np.array([surfels.frame for surfels in keys], np.int64))
        npz.add("stamps_ns", np.array([surfels.stamp_ns for surfels in keys], np.int64))
        npz.add("ids", surface.ids)
        npz.add("positions", surface.positions)
        npz.add("triangles", surface.triangles)
        npz.add("strain", values.astype(np.float32))
    full = strain_scale(values)
    images = surfels_with_images(recording, lambda s: s.frame in wanted)
    for (surfels, pixels), now in zip(images, values, strict=True):
        if pixels is None:
            continue
        shown = np.isfinite(now)
        points = np.zeros((len(surface.ids), 2), np.float32)
        _, column, row = np.intersect1d(surface.ids, surfels.ids, return_indices=True)
        points[column] = surfels.points_px[row]
        words = f"frame {surfels.frame}   blue: -{full:.1%}   red: +{full:.1%}"
        picture = draw_strain(pixels, points, surface.triangles[shown], now[shown], full, words)
        write_image(path / f"{surfels.frame:06d}.png", picture)
