"""Makes ``deforming_map.npz``: the map of a scene that deformed, adjusted as a whole at the end."""

from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.deformable.adjustment import adjust_deforming
from pliant.algorithms.deformable.track_choice import choose_tracks
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.slam.calibration.corrected_view import corrected_view
from pliant.formats.npz import NpzWriter
from pliant.messages import topics
from pliant.messages.types import Extrema
from pliant.recording.reader import Recording
from pliant.results.run import Run

_INTERVAL_NS = 190_000_000
"""Least time between two keyframes: 0.2 s, less the jitter of a clock."""
_MOST = 150
"""Keyframes; a longer run has them farther apart."""


def write_deforming_map(path: Path, recording: Path, run: Run) -> str:
    """Adjust the longest segment of a run's map.  Returns why it cannot be, "" where it can.

    Cameras, landmarks and displacements are in world and unit of the map.
    """
    history, stream = run.history, run.stream
    segment = history.longest_segment()
    if stream is None or segment < 0:
        return "the run has no map"
    poses = {frame: pose for frame, (of, pose) in history.final().items() if of == segment}
    frames = _spread(np.array(sorted(poses), np.int64), history.stamps_ns)
    view = corrected_view(stream.camera, run.correction_of(segment))
    ids: list[I64] = []
    pixels: list[F64] = []
    wanted = set(frames.tolist())
    for tracks in Recording(recording).decoded(topics.EXTREMA):
        assert isinstance(tracks, Extrema)
        if tracks.frame in wanted:
            ids.append(tracks.ids)
            pixels.append(view.pixels(tracks.points_px).astype(np.float64))
    chosen, landmarks = choose_tracks(ids, pixels, view.camera.width, view.camera.height)
    T = pose_to_matrix(np.array([poses[frame] for frame in frames.tolist()]))
    try:
        found = adjust_deforming(chosen, T, view.camera)
    except (ValueError, np.linalg.LinAlgError):
        return "too few tracks were followed through several keyframes"
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
        if not chosen or stamps_ns[frame] - stamps_ns[chosen[-1]] >= _INTERVAL_NS:
            chosen.append(frame)
    if len(chosen) > _MOST:
        chosen = [chosen[k] for k in np.linspace(0, len(chosen) - 1, _MOST).astype(np.int64)]
    return np.array(chosen, np.int64)
