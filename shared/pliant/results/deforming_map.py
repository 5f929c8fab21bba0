"""Makes ``deforming_map.npz``: the map of a scene that deformed, adjusted as a whole at the end.

It is made only where it can be trusted: see ``held_out.py``.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.deformable.judged_map import INTERVAL_NS, TOO_FEW, judged_map
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.slam.calibration.corrected_view import corrected_view
from pliant.formats.npz import NpzWriter
from pliant.map_history import MapHistory
from pliant.messages import topics
from pliant.messages.types import Extrema
from pliant.recording.reader import Recording
from pliant.results.run import Run

_MOST = 150
"""Keyframes; a longer run has them farther apart."""
NO_MAP = "the run has no map"


def write_deforming_map(path: Path, recording: Path, run: Run) -> str:
    """Adjust the longest segment of a run's map.  Returns why it cannot be, "" where it can.

    Cameras, landmarks and displacements are in world and unit of the map.
    """
    segment = run.history.longest_segment()
    if run.stream is None or segment < 0:
        return NO_MAP
    # A rigid map that deforms estimates a wrong correction: a calibration that is given counts.
    correction = run.correction_of(segment) if run.stream.focal_sigma > 0.0 else ()
    view = corrected_view(run.stream.camera, correction)
    tracks = Recording(recording).decoded(topics.EXTREMA)
    seen = (
        (t.frame, t.ids, view.pixels(t.points_px).astype(np.float64))
        for t in tracks
        if isinstance(t, Extrema)
    )
    return adjust_and_write(path, run.history, view.camera, seen)


def adjust_and_write(
    path: Path, history: MapHistory, camera: PinholeCamera, tracks: Iterable[tuple[int, I64, F64]]
) -> str:
    """The same for a map and the frames, ids (N,) and pixels (N, 2) of its tracks."""
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
    if judged.problem:
        return judged.problem
    found, chosen, landmarks = judged.found, judged.tracks, judged.ids
    tracked = np.full((len(frames), len(landmarks), 2), np.nan, np.float32)
    tracked[chosen.keyframes, chosen.landmarks] = chosen.points_px
    kept = np.flatnonzero(found.reliable)
    with NpzWriter(path) as npz:
        npz.add("frames", frames)
        npz.add("stamps_ns", np.array([history.stamps_ns[f] for f in frames.tolist()], np.int64))
        npz.add("T_world_camera", found.T_world_camera)
        npz.add("ids", landmarks[kept])
        npz.add("rest", found.rest[kept])
        npz.add("nodes", found.nodes)
        npz.add("displacements", found.displacements)
        npz.add("carriers", found.carriers[kept])
        npz.add("weights", found.weights[kept])
        npz.add("points_px", tracked[:, kept])
    return ""


def _spread(frames: I64, stamps_ns: dict[int, int]) -> I64:
    """Frames that are an interval apart, or as many as there may be."""
    chosen: list[int] = []
    for frame in frames.tolist():
        if not chosen or stamps_ns[frame] - stamps_ns[chosen[-1]] >= INTERVAL_NS:
            chosen.append(frame)
    if len(chosen) > _MOST:
        chosen = [chosen[k] for k in np.linspace(0, len(chosen) - 1, _MOST).astype(np.int64)]
    return np.array(chosen, np.int64)
