"""The surfels of a recording, frame by frame: as they were online, and by the final map."""

import zipfile
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.deformable.followed_map import FollowedMap
from pliant.algorithms.surfels.final_surfels import FinalSurfels, SurfelsByMap
from pliant.errors import ResultError
from pliant.formats.npz import NpzWriter
from pliant.messages import topics
from pliant.messages.types import Surfels
from pliant.recording.reader import Recording
from pliant.results.folder import DEFORMING_MAP_NAME

_ARRAYS = {
    "surfel_frames": "frames",
    "surfel_cameras": "T_world_camera",
    "factor_segments": "segments",
    "factor_ids": "ids",
    "factor_stamps_ns": "factor_stamps_ns",
    "factors": "factors",
}
"""Of a deforming map's file, by field of ``FinalSurfels``."""


def has_surfels(recording: Path) -> bool:
    """Whether a recording is one of the deformable profile."""
    return next(Recording(recording).messages(topics.SURFELS), None) is not None


def recorded_surfels(recording: Path) -> Iterator[Surfels]:
    """The surfels of every frame, as they were online."""
    for message in Recording(recording).decoded(topics.SURFELS):
        assert isinstance(message, Surfels)
        yield message


def final_surfels(recording: Path) -> Iterator[Surfels]:
    """The surfels of every frame by the map beside the recording; as recorded if it has none.

    Raises ResultError for a file that is no map.
    """
    final = corrector(recording.parent / DEFORMING_MAP_NAME)
    return (final(surfels) for surfels in recorded_surfels(recording))


def corrector(deforming_map: Path) -> Callable[[Surfels], Surfels]:
    """Corrects the surfels of a frame by a map; leaves them as they are if there is none.

    Raises ResultError for a file that is no map.
    """
    final = _read(deforming_map)
    if final is None:
        return lambda surfels: surfels
    return lambda surfels: final.corrected(surfels, surfels.stamp_ns)


def surfels_by_map(
    followed: FollowedMap,
    tracks: Iterator[tuple[int, I64, F64]],
    surfels: Iterator[Surfels],
    camera: PinholeCamera,
) -> FinalSurfels:
    """Follow a map through all frames.  tracks: frames, ids (N,) and rectified pixels (N, 2)."""
    by_map = SurfelsByMap()
    frame, ids, pixels = -1, np.zeros(0, np.int64), np.zeros((0, 2))
    for each in surfels:
        while frame < each.frame:
            frame, ids, pixels = next(tracks, (each.frame, ids[:0], pixels[:0]))
        if not each.missing and len(each.ids):
            seen = followed.see(each.stamp_ns, ids, pixels, camera) if frame == each.frame else None
            by_map.take(each, each.stamp_ns, seen)
    return by_map.found()


def add_final(npz: NpzWriter, final: FinalSurfels) -> None:
    """Add the arrays to a deforming map's file."""
    for array, name in _ARRAYS.items():
        npz.add(array, getattr(final, name))


def _read(deforming_map: Path) -> FinalSurfels | None:
    """None where there is no map, or an older one, without surfels."""
    try:
        with np.load(deforming_map, allow_pickle=False) as content:
            if not _ARRAYS.keys() <= set(content.files):
                return None
            return FinalSurfels(**{name: content[array] for array, name in _ARRAYS.items()})
    except FileNotFoundError:
        return None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        raise ResultError(f"{deforming_map}: no valid map: remove the file") from None
