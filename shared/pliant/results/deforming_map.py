"""Makes ``deforming_map.npz``: the map of a scene that deformed, adjusted as a whole at the end.

It is made only where it can be trusted: see ``held_out.py``.
"""

from collections.abc import Iterable
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.deformable.adjustment import adjust_deforming
from pliant.algorithms.deformable.held_out import Evidence, weigh
from pliant.algorithms.deformable.track_choice import choose_tracks
from pliant.algorithms.geometry import pose_to_matrix
from pliant.algorithms.slam.calibration.corrected_view import corrected_view
from pliant.formats.npz import NpzWriter
from pliant.map_history import MapHistory
from pliant.messages import topics
from pliant.messages.types import Extrema
from pliant.recording.reader import Recording
from pliant.results.run import Run

_INTERVAL_NS = 190_000_000
"""Least time between two keyframes: 0.2 s, less the jitter of a clock."""
_MOST = 150
"""Keyframes; a longer run has them farther apart."""
_TOO_FEW = "too few tracks through several keyframes determine it"
_NO_JUDGES = "too few other tracks judge it"
_FEWEST = 30
"""Tracks that judge it."""
_CERTAIN, _PREDICTED, _GAIN, _STIFF = 0.65, 0.95, 0.6, 0.5
"""Least share of certain landmarks, and least figures of the evidence.

Scenes whose map is right have 0.79, 0.99, 0.7 and 0.6 or more.  Rigid scenes with an inexact
calibration have up to 0.83, 0.95, 0.5 and 1.0; with a camera that hardly moves 0.3, 1.0, 3 and 1.0.
"""


def write_deforming_map(path: Path, recording: Path, run: Run) -> str:
    """Adjust the longest segment of a run's map.  Returns why it cannot be, "" where it can.

    Cameras, landmarks and displacements are in world and unit of the map.
    """
    segment = run.history.longest_segment()
    if run.stream is None or segment < 0:
        return "the run has no map"
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
        return _TOO_FEW
    frames = np.array(list(seen), np.int64)
    ids, pixels = [ids for ids, _ in seen.values()], [pixels for _, pixels in seen.values()]
    chosen, landmarks = choose_tracks(ids, pixels, camera.width, camera.height)
    others = [~np.isin(of, landmarks) for of in ids]
    held_out, judges = choose_tracks(
        [of[other] for of, other in zip(ids, others, strict=True)],
        [at[other] for at, other in zip(pixels, others, strict=True)],
        camera.width,
        camera.height,
    )
    if len(judges) < _FEWEST:
        return _NO_JUDGES if len(landmarks) >= _FEWEST else _TOO_FEW
    T = pose_to_matrix(np.array([poses[frame] for frame in frames.tolist()]))
    try:
        found = adjust_deforming(chosen, T, camera)
        evidence = weigh(found, held_out, camera)
    except (ValueError, ArithmeticError, np.linalg.LinAlgError):
        return _TOO_FEW
    if why := doubt(float(found.reliable.mean()), evidence):
        return why
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


def doubt(certain: float, evidence: Evidence) -> str:
    """Why a map is not to be trusted, "" where it is."""
    if not certain >= _CERTAIN:
        return f"only {certain:.0%} of its landmarks are certain"
    if not evidence.predicted >= _PREDICTED:
        return f"it predicts only {evidence.predicted:.0%} of the tracks that it was not made from"
    if not evidence.gain >= _GAIN:
        return "a rigid map predicts its tracks as well, or nearly so"
    if not evidence.stiff >= _STIFF:
        return (
            f"only {evidence.stiff:.0%} of its landmarks hardly move, "
            "so camera and deformation cannot be told apart"
        )
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
