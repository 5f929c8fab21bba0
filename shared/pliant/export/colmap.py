"""A recording as a COLMAP model: which points the keyframes see, and the images that go with them.

Map updates tell where points are, not by which tracks they were seen.  So observations are found
again: a track belongs to the point that it meets, within the mapper's own limit, in the most
keyframes; a track that meets none twice, or a point that fewer than two keyframes see, is left out.
The camera is the one that the map was made with; observations lie where it would have seen them.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.corrected_view import CorrectedView
from pliant.algorithms.geometry import inverse, pose_to_matrix
from pliant.algorithms.mapping.reacquisition import MaximaGrid
from pliant.errors import ResultError
from pliant.formats.colmap import ColmapImage, write_colmap
from pliant.map_history import MapHistory
from pliant.messages import topics
from pliant.messages.types import Extrema
from pliant.recording.reader import Recording

_NEAR_PX = 1.5  # an inlier of the mapper


@dataclass(frozen=True)
class _View:
    """A keyframe: its pose, and which track (row) meets which point (row) at what distance."""

    frame: int
    T_world_camera: F64
    points_px: F64
    tracks: I64
    points: I64
    errors: F64


def write_colmap_model(
    recording: Recording, view: CorrectedView, history: MapHistory, folder: Path
) -> list[int]:
    """Write the model of the longest segment; returns the frames whose images belong to it.

    view: that of the camera with which this segment was made.
    Raises ResultError where there is no map.
    """
    segment = history.longest_segment()
    poses = {f: pose for f, (s, pose) in history.keyframe_poses().items() if s == segment}
    if not poses:
        raise ResultError("the run has no map to export")
    points = history.points()
    points = points.select(points.segments == segment)
    keyframes = [
        _meet(tracks, pose_to_matrix(poses[tracks.frame]), points.positions, view)
        for tracks in recording.decoded(topics.EXTREMA)
        if isinstance(tracks, Extrema) and tracks.frame in poses and not tracks.missing
    ]
    owner = _owners(keyframes)
    seen = [_observations(keyframe, owner) for keyframe in keyframes]
    counts = np.bincount(np.concatenate([p for _, p in seen]), minlength=len(points))
    kept = np.flatnonzero(counts >= 2)
    row = np.full(len(points), -1, np.int64)
    row[kept] = np.arange(len(kept))
    images = [
        ColmapImage(
            image_name(keyframe.frame),
            keyframe.T_world_camera,
            pixels[row[p] >= 0],
            row[p][row[p] >= 0],
        )
        for keyframe, (pixels, p) in zip(keyframes, seen, strict=True)
    ]
    colours = np.asarray(points.colours[kept], np.uint8)
    write_colmap(folder, view.camera, images, points.positions[kept], colours)
    return [keyframe.frame for keyframe in keyframes]


def image_name(frame: int) -> str:
    """The file of a frame."""
    return f"{frame:06d}.png"


def _meet(tracks: Extrema, T_world_camera: F64, positions: F64, view: CorrectedView) -> _View:
    """For every point in view the track that is nearest to it, where one is near."""
    camera, tracks_px = view.camera, view.pixels(tracks.points_px)
    T_camera_world = inverse(T_world_camera)
    space = positions @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    front = np.flatnonzero(space[:, 2] > 0.0)
    pixels = camera.project(space[front])
    inside = np.all((pixels > -0.5) & (pixels < (camera.width - 0.5, camera.height - 0.5)), axis=1)
    front, pixels = front[inside], pixels[inside]
    places = np.zeros((len(tracks.ids), 3), np.float32)
    places[:, :2] = tracks_px
    grid = MaximaGrid.build(places, camera.width, camera.height, _NEAR_PX)
    nearest = grid.nearest(pixels.astype(np.float32), _NEAR_PX)
    met = nearest >= 0
    rows = nearest[met]
    points_px = tracks_px[rows].astype(np.float64)
    errors = np.linalg.norm(pixels[met] - points_px, axis=1)
    return _View(tracks.frame, T_world_camera, points_px, tracks.ids[rows], front[met], errors)


def _owners(views: list[_View]) -> dict[int, int]:
    """The point of each track that met one at least twice: most often, then nearest."""
    pairs = np.concatenate([np.stack([v.tracks, v.points], axis=1) for v in views])
    errors = np.concatenate([view.errors for view in views])
    unique, inverse_rows, counts = np.unique(pairs, axis=0, return_inverse=True, return_counts=True)
    mean = np.bincount(inverse_rows.ravel(), errors, len(unique)) / counts
    often = counts >= 2
    unique, counts, mean = unique[often], counts[often], mean[often]
    order = np.lexsort((unique[:, 1], mean, -counts, unique[:, 0]))
    tracks, first = np.unique(unique[order, 0], return_index=True)
    return dict(zip(tracks.tolist(), unique[order][first, 1].tolist(), strict=True))


def _observations(view: _View, owner: dict[int, int]) -> tuple[F64, I64]:
    """(N, 2) pixels and (N,) points that the view sees, each point at most once."""
    owned = np.array([owner.get(track, -1) for track in view.tracks.tolist()], np.int64)
    good = np.flatnonzero(owned == view.points)
    good = good[np.lexsort((view.errors[good], view.points[good]))]
    points, first = np.unique(view.points[good], return_index=True)
    return view.points_px[good][first], points
