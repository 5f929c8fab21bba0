"""The deforming surface as one mesh that moves: ``pliant export --to animation``."""

from collections import Counter
from collections.abc import Mapping
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, I64, U8
from pliant.algorithms.surfels.surface_over_time import SurfaceOverTime, surface_over_time
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.errors import ResultError
from pliant.export.surface_meshes import check_deformable, colours_at, surfels_with_images
from pliant.formats.animated import AnimatedMesh, write_animated_glb
from pliant.messages.types import Surfels
from pliant.recording.reader import Recording
from pliant.results.surfel_frames import final_surfels
from pliant.results.surfels import is_metric

_KEYS = 60
"""Most key frames unless every Nth is given: the file grows with them, and with the surfels."""
_NO_COLOUR = np.full(3, 128, np.uint8)


def animation(
    recording: Recording, path: Path, folder: Path | None, every: int | None = None
) -> None:
    """Animated glTF of the longest segment, in its world, with a key frame for every Nth frame.

    Raises ResultError for a recording without surfels, and where fewer than two key frames remain.
    """
    segment, every, wanted = key_frames(recording, every)
    keys: list[Surfels] = []
    tints: dict[int, U8] = {}
    for surfels, pixels in surfels_with_images(recording, lambda s: s.frame in wanted):
        keys.append(surfels)
        if pixels is not None:
            rows = np.flatnonzero(surfels.state == SurfelState.TRACKED)
            colours = colours_at(pixels, surfels.points_px[rows])
            tints = dict(zip(surfels.ids[rows].tolist(), colours, strict=True)) | tints
    surface = surface_over_time(keys)
    if not len(surface.triangles):
        raise ResultError(f"{recording.path}: too few surfels are tracked for a surface")
    mesh = animated(surface, keys, tints)
    unit = "metres" if is_metric(recording.metadata()) else "units of the depth at the start"
    write_animated_glb(path, mesh, {"unit": unit, "segment": segment, "key_frames_every": every})


def key_frames(recording: Recording, every: int | None) -> tuple[int, int, set[int]]:
    """Longest segment, N, and every Nth frame of it.  every: N, by default for at most 60 frames.

    Raises ResultError for a recording without surfels, and where fewer than two key frames remain.
    """
    check_deformable(recording)
    segment, frames = _longest_segment(recording)
    every = every or max(1, -(-len(frames) // _KEYS))
    chosen = frames[frames % every == 0]
    if len(chosen) < 2:
        raise ResultError(
            f"{recording.path}: needs two frames with tracked surfels, segment "
            f"{segment} has {len(chosen)} of every {every}: use a smaller --every"
        )
    return segment, every, set(chosen.tolist())


def animated(
    surface: SurfaceOverTime, keys: list[Surfels], tints: Mapping[int, U8]
) -> AnimatedMesh:
    """The surface with a vertex for each surfel of the triangles that are always shown.

    Any other triangle has three vertices of its own, which lie in its centroid where it is not
    shown: that of the places where its surfels were tracked last, or are tracked first.
    tints: colour by id.
    """
    places = _filled(surface.positions)
    always = surface.shown.all(axis=0)
    rows, shared = np.unique(surface.triangles[always], return_inverse=True)
    own = surface.triangles[~always]
    corners = places[:, own]
    hidden = ~surface.shown[:, ~always]
    corners[hidden] = corners[hidden].mean(axis=1, keepdims=True)
    positions = np.concatenate([places[:, rows], corners.reshape(len(keys), -1, 3)], axis=1)
    alone = len(rows) + np.arange(own.size)
    triangles = np.concatenate([shared.reshape(-1, 3), alone.reshape(-1, 3)])
    colours = None
    if tints:
        ids = surface.ids[np.concatenate([rows, own.ravel()])].tolist()
        colours = np.array([tints.get(number, _NO_COLOUR) for number in ids], np.uint8)
    return AnimatedMesh(
        times_s=np.array([s.stamp_ns - keys[0].stamp_ns for s in keys]) / 1e9,
        names=[f"frame {s.frame}" for s in keys],
        positions=positions,
        triangles=triangles[:, ::-1].astype(np.int32),  # seen from the camera, not from behind
        colours=colours,
    )


def _longest_segment(recording: Recording) -> tuple[int, I64]:
    """The first of those with the most frames in which surfels were followed, and these frames."""
    followed = [
        (s.segment, s.frame) for s in final_surfels(recording.path) if not s.missing and not s.lost
    ]
    if not followed:
        return 0, np.zeros(0, np.int64)
    ((longest, _),) = Counter(segment for segment, _ in followed).most_common(1)
    return longest, np.array([frame for segment, frame in followed if segment == longest])


def _filled(positions: F64) -> F64:
    """(K, N, 3) with gaps filled by the last finite position, or by the first at the start."""
    keys = np.arange(len(positions))[:, None]
    found = np.isfinite(positions[..., 0])
    last = np.maximum.accumulate(np.where(found, keys, -1), axis=0)
    row = np.where(last < 0, found.argmax(axis=0), last)
    return np.take_along_axis(positions, row[..., None], axis=0)
