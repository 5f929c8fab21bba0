"""A run as a COLMAP model: its posed images, their camera, and points with their observations.

Keyframes see what the mapper had them see.  The other frames see what their tracks lead to: a track
is that of the point which the most keyframes see on it, where it lies no farther off than an inlier
of the mapper.  A point that fewer than two images see is left out.
"""

from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, I64
from pliant.algorithms.geometry import inverse
from pliant.algorithms.slam.locate.reacquisition import MaximaGrid
from pliant.export.crop import Box
from pliant.export.images import camera_of, make_folder
from pliant.export.on_earth import write_geo_registration
from pliant.export.posed_images import (
    INLIER_PX,
    IdealCamera,
    PosedImage,
    write_posed_images,
)
from pliant.formats.colmap import ColmapImage, write_colmap
from pliant.map_history import Points
from pliant.messages import topics
from pliant.messages.types import Extrema
from pliant.recording.reader import Recording
from pliant.results.run import SeenKeyframe, read_run, seen_by_keyframes

MODEL = "sparse/0"
_SAME_PX = 0.1  # of a track that was observed, but for rounding


def colmap(recording: Recording, path: Path, folder: Path | None) -> None:
    """``sparse/0`` with the text model, ``images`` as its camera sees them, and where there are
    masks ``masks`` as COLMAP names them.  ``geo_registration.txt`` where fixes place the map."""
    run = read_run(recording.path)
    ideal = IdealCamera(run)
    images = write_posed_images(
        recording, camera_of(recording), ideal, path / "images", mask_name=mask_name
    )
    points = run.history.points_in(ideal.segment)
    model, kept = seen_model(recording, ideal, images, points)
    make_folder(path / MODEL)
    colours = np.asarray(points.colours[kept], np.uint8)
    write_colmap(path / MODEL, ideal.camera, model, points.positions[kept], colours)
    write_geo_registration(recording, run, path / "geo_registration.txt", images)


def mask_name(name: str) -> str:
    """COLMAP's file of the mask of an image."""
    return f"{name}.png"


def seen_model(
    recording: Recording, ideal: IdealCamera, images: list[PosedImage], points: Points,
    crop: Box | None = None,
) -> tuple[list[ColmapImage], I64]:  # fmt: skip
    """The images with their points, and (K,) rows of the points that two of them observe.

    Points of an image are numbers of those rows.    crop: only points in this box.
    """
    seen = seen_by_keyframes(recording, set(ideal.keyframes.values()))
    sights = _sights(recording, ideal, images, seen, points.ids, points.positions)
    counts = np.bincount(np.concatenate([rows for _, rows in sights]), minlength=len(points))
    wanted = counts >= 2
    kept = np.flatnonzero(wanted if crop is None else wanted & crop.holds(points.positions))
    number = np.full(len(points), -1, np.int64)
    number[kept] = np.arange(len(kept))
    model = [
        ColmapImage(
            image.name,
            image.T_world_camera,
            pixels[number[rows] >= 0],
            number[rows][number[rows] >= 0],
        )
        for image, (pixels, rows) in zip(images, sights, strict=True)
    ]
    return model, kept


def _sights(
    recording: Recording,
    ideal: IdealCamera,
    images: list[PosedImage],
    seen: dict[int, SeenKeyframe],
    ids: I64,
    positions: F64,
) -> list[tuple[F64, I64]]:
    """The (N, 2) pixels of the points that each image observes, and the (N,) rows of those.

    seen: by the id of the keyframe.    ids: (P,) of the points, ascending.    positions: (P, 3).
    """
    owner = _owners(recording, ideal, seen)
    wanted = {image.frame: image for image in images}
    found: dict[int, tuple[F64, I64]] = {}
    for tracks in recording.decoded(topics.EXTREMA):
        assert isinstance(tracks, Extrema)
        image = wanted.get(tracks.frame)
        if image is None:
            continue
        keyframe = seen.get(ideal.keyframes.get(tracks.frame, -1))
        if keyframe is not None:
            points, points_px = keyframe.point_ids, keyframe.points_px
        else:
            points = np.array([owner.get(track, -1) for track in tracks.ids.tolist()], np.int64)
            points_px = tracks.points_px
        rows = np.minimum(np.searchsorted(ids, points), len(ids) - 1)
        known = np.flatnonzero(ids[rows] == points)
        pixels = ideal.pixels(tracks.frame, points_px[known]).astype(np.float64)
        found[tracks.frame] = _inliers(ideal, image, pixels, rows[known], positions)
    nothing = np.zeros((0, 2)), np.zeros(0, np.int64)
    return [found.get(image.frame, nothing) for image in images]


def _owners(
    recording: Recording, ideal: IdealCamera, seen: dict[int, SeenKeyframe]
) -> dict[int, int]:
    """The point (by id) of each track that is seen on one: in the most keyframes."""
    camera = camera_of(recording)
    pairs = [np.zeros((0, 2), np.int64)]
    for tracks in recording.decoded(topics.EXTREMA):
        assert isinstance(tracks, Extrema)
        keyframe = seen.get(ideal.keyframes.get(tracks.frame, -1))
        if keyframe is None:
            continue
        places = np.zeros((len(tracks.ids), 3), np.float32)
        places[:, :2] = tracks.points_px
        grid = MaximaGrid.build(places, camera.width, camera.height, 1.0)
        rows = grid.nearest(keyframe.points_px, _SAME_PX)
        on = rows >= 0
        pairs.append(np.stack([tracks.ids[rows[on]], keyframe.point_ids[on]], axis=1))
    unique, counts = np.unique(np.concatenate(pairs), axis=0, return_counts=True)
    order = np.lexsort((counts, unique[:, 0]))  # the last of a track stays
    return dict(unique[order].tolist())


def _inliers(
    ideal: IdealCamera, image: PosedImage, pixels: F64, rows: I64, positions: F64
) -> tuple[F64, I64]:
    """The pixels (N, 2) near the projection of their point, each point once."""
    T = inverse(image.T_world_camera)
    local = positions[rows] @ T[:3, :3].T + T[:3, 3]
    with np.errstate(divide="ignore", invalid="ignore"):
        errors = np.linalg.norm(ideal.camera.project(local) - pixels, axis=1)
    good = np.flatnonzero((local[:, 2] > 0.0) & (errors < INLIER_PX) & ideal.shows(pixels))
    good = good[np.lexsort((errors[good], rows[good]))]
    points, first = np.unique(rows[good], return_index=True)
    return pixels[good[first]], points
