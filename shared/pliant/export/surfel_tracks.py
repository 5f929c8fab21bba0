"""Surfels as tracks in space: ``pliant export --to tracks``."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import I64
from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.export.images import make_folder
from pliant.export.surface_meshes import check_deformable
from pliant.formats.npz import NpzWriter
from pliant.formats.text import format_seconds
from pliant.messages.types import Surfels
from pliant.recording.reader import Recording
from pliant.results.surfel_frames import final_surfels
from pliant.results.surfels import is_metric


def surfel_tracks(recording: Recording, path: Path, folder: Path | None, every: int = 1) -> None:
    """A folder with ``tracks.npz``, dense, and ``tracks.csv``, a line for each tracked surfel.

    A column of the arrays is a surfel: ids are unique in their segment, as are world frames.
    Raises ResultError for a recording without surfels.
    """
    check_deformable(recording)
    make_folder(path)
    keys = sorted({key for surfels in _frames(recording, every) for key in _keys(surfels)})
    columns = {key: n for n, key in enumerate(keys)}
    unit = "metre" if is_metric(recording.metadata()) else "arbitrary"
    x, y, z = (f"{axis}_m" if unit == "metre" else axis for axis in "xyz")
    with (
        NpzWriter(path / "tracks.npz") as npz,
        (path / "tracks.csv").open("w", encoding="ascii", newline="\n") as csv,
    ):
        numbers = np.array(keys, np.int64).reshape(-1, 2)
        npz.add("segments", numbers[:, 0])
        npz.add("ids", numbers[:, 1])
        npz.add("unit", np.array([unit]))
        csv.write(f"frame,seconds,segment,id,{x},{y},{z},confirmed,zncc,confidence\n")
        for surfels in _frames(recording, every):
            rows = np.flatnonzero(surfels.state == SurfelState.TRACKED)
            at = np.array([columns[key] for key in _keys(surfels)], np.int64)
            _add(npz, surfels, rows, at, len(keys))
            csv.writelines(_lines(surfels, rows))


def _frames(recording: Recording, every: int) -> Iterator[Surfels]:
    """Yield the frames with surfels."""
    for surfels in final_surfels(recording.path):
        if not surfels.missing and surfels.frame % every == 0:
            yield surfels


def _keys(surfels: Surfels) -> list[tuple[int, int]]:
    """Segment and id of each tracked surfel."""
    tracked = surfels.ids[surfels.state == SurfelState.TRACKED]
    return [(surfels.segment, number) for number in tracked.tolist()]


def _add(npz: NpzWriter, surfels: Surfels, rows: I64, at: I64, count: int) -> None:
    """One frame of the dense arrays.  at: columns of the tracked rows, of ``count``."""
    positions, zncc = np.full((1, count, 3), np.nan), np.full((1, count), np.nan, np.float32)
    confirmed, confidence = np.full((1, count), -1, np.int8), np.full_like(zncc, np.nan)
    positions[0, at], zncc[0, at] = surfels.positions[rows], surfels.zncc[rows]
    if len(surfels.confirmed):
        confirmed[0, at] = surfels.confirmed[rows]
    if len(surfels.confidence):
        confidence[0, at] = surfels.confidence[rows]
    npz.add("frames", np.array([surfels.frame], np.int64))
    npz.add("stamps_ns", np.array([surfels.stamp_ns], np.int64))
    npz.add("T_world_camera", surfels.T_world_camera[None])
    npz.add("positions", positions)
    npz.add("confirmed", confirmed)
    npz.add("zncc", zncc)
    npz.add("confidence", confidence)


def _lines(surfels: Surfels, rows: I64) -> Iterator[str]:
    head = f"{surfels.frame},{format_seconds(surfels.stamp_ns)},{surfels.segment}"
    known, rated = len(surfels.confirmed) > 0, len(surfels.confidence) > 0
    for row in rows.tolist():
        x, y, z = surfels.positions[row].tolist()
        confirmed = int(surfels.confirmed[row]) if known else ""
        confidence = f"{surfels.confidence[row]:.3f}" if rated else ""
        yield (
            f"{head},{surfels.ids[row]},{x:.9g},{y:.9g},{z:.9g},"
            f"{confirmed},{surfels.zncc[row]:.4f},{confidence}\n"
        )
