"""Makes ``deforming_map.npz``: the map of a scene that deformed, adjusted as a whole at the end.

It is made only where it can be trusted: see ``held_out.py``.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.deformable.followed_map import FollowedMap
from pliant.algorithms.deformable.judged_map import INTERVAL_NS, TOO_FEW, JudgedMap, judged_map
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.slam.calibration.corrected_view import corrected_view
from pliant.formats.npz import NpzWriter
from pliant.map_history import MapHistory
from pliant.messages import topics
from pliant.messages.types import Extrema
from pliant.recording.reader import Recording
from pliant.results.run import Run
from pliant.results.surfel_frames import add_final, recorded_surfels, surfels_by_map

_MOST = 150
"""Keyframes; a longer run has them farther apart."""
NO_MAP = "the run has no map"


@dataclass(frozen=True)
class _Map:
    """frames, stamps_ns: (K,) of the keyframes of a map that is to be trusted."""

    judged: JudgedMap
    frames: I64
    stamps_ns: I64


def write_deforming_map(path: Path, recording: Path, run: Run) -> str:
    """Adjust the longest segment of a run's map, and correct its surfels by it.

    Returns why it cannot be, "" where it can.  Cameras, landmarks and displacements are in world
    and unit of the map.
    """
    segment = run.history.longest_segment()
    if run.stream is None or segment < 0:
        return NO_MAP
    # A rigid map that deforms estimates a wrong correction: a calibration that is given counts.
    correction = run.correction_of(segment) if run.stream.focal_sigma > 0.0 else ()
    view = corrected_view(run.stream.camera, correction)

    def tracks() -> Iterator[tuple[int, I64, F64]]:
        for t in Recording(recording).decoded(topics.EXTREMA):
            if isinstance(t, Extrema):
                yield t.frame, t.ids, view.pixels(t.points_px).astype(np.float64)

    made = _adjusted(run.history, view.camera, tracks())
    if isinstance(made, str):
        return made
    followed = FollowedMap(made.judged.found, made.judged.ids, made.stamps_ns)
    final = surfels_by_map(followed, tracks(), recorded_surfels(recording), view.camera)
    with NpzWriter(path) as npz:
        _add(npz, made)
        add_final(npz, final)
    return ""


def adjust_and_write(
    path: Path, history: MapHistory, camera: PinholeCamera, tracks: Iterable[tuple[int, I64, F64]]
) -> str:
    """The same for a map and the frames, ids (N,) and pixels (N, 2) of its tracks, no surfels."""
    made = _adjusted(history, camera, tracks)
    if isinstance(made, str):
        return made
    with NpzWriter(path) as npz:
        _add(npz, made)
    return ""


def _adjusted(
    history: MapHistory, camera: PinholeCamera, tracks: Iterable[tuple[int, I64, F64]]
) -> _Map | str:
    """The map, or why it is not to be trusted."""
    segment = history.longest_segment()
    poses = {frame: pose for frame, (of, pose) in history.final().items() if of == segment}
    frames = _spread(np.array(sorted(poses), np.int64), history.stamps_ns)
    wanted = set(frames.tolist())
    seen = {frame: (ids, pixels) for frame, ids, pixels in tracks if frame in wanted and len(ids)}
    if not seen:
        return TOO_FEW
    frames = np.array(list(seen), np.int64)
    ids, pixels = [ids for ids, _ in seen.values()], [pixels for _, pixels in seen.values()]
    T = pose_to_matrix(np.array([poses[frame] for frame in frames.tolist()]))
    judged = judged_map(ids, pixels, T, camera)
    if isinstance(judged, str):
        return judged
    stamps_ns = np.array([history.stamps_ns[frame] for frame in frames.tolist()], np.int64)
    return judged.problem or _Map(judged, frames, stamps_ns)


def _add(npz: NpzWriter, made: _Map) -> None:
    found, chosen, landmarks = made.judged.found, made.judged.tracks, made.judged.ids
    tracked = np.full((len(made.frames), len(landmarks), 2), np.nan, np.float32)
    tracked[chosen.keyframes, chosen.landmarks] = chosen.points_px
    kept = np.flatnonzero(found.reliable)
    npz.add("frames", made.frames)
    npz.add("stamps_ns", made.stamps_ns)
    npz.add("T_world_camera", found.T_world_camera)
    npz.add("ids", landmarks[kept])
    npz.add("rest", found.rest[kept])
    npz.add("nodes", found.nodes)
    npz.add("displacements", found.displacements)
    npz.add("carriers", found.carriers[kept])
    npz.add("weights", found.weights[kept])
    npz.add("points_px", tracked[:, kept])


def _spread(frames: I64, stamps_ns: dict[int, int]) -> I64:
    """Frames that are an interval apart, or as many as there may be."""
    chosen: list[int] = []
    for frame in frames.tolist():
        if not chosen or stamps_ns[frame] - stamps_ns[chosen[-1]] >= INTERVAL_NS:
            chosen.append(frame)
    if len(chosen) > _MOST:
        chosen = [chosen[k] for k in np.linspace(0, len(chosen) - 1, _MOST).astype(np.int64)]
    return np.array(chosen, np.int64)
