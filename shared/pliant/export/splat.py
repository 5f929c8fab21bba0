"""A run for Gaussian splatting: the output of ``colmap`` and ``nerfstudio`` in one folder.

    images/, masks/           as of both, but of near-duplicate views only the sharp ones
    sparse/0/                 the COLMAP model; the dense points have no observations
    sparse/0/points3D.ply     the dense points with normals
    transforms.json           nerfstudio's, with these points

The dense points are the vertices of the fine mesh, and where it has no surface points of the map;
their normals are 0.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F32, U8, BoolArray
from pliant.algorithms.geometry import inverse
from pliant.algorithms.image.duplicate_views import sharp_views
from pliant.algorithms.meshing.mesh_blocks import KEY_LIMIT, pack
from pliant.export.colmap import MODEL, mask_name, seen_model
from pliant.export.crop import Box, rows_in
from pliant.export.images import camera_of, make_folder
from pliant.export.nerfstudio import write_transforms
from pliant.export.posed_images import IdealCamera, PosedImage, write_posed_images
from pliant.formats.colmap import write_colmap
from pliant.formats.ply import write_ply
from pliant.map_history import Points
from pliant.messages.mesh_pieces import joined
from pliant.recording.reader import Recording
from pliant.results.mesh_files import meshes_of
from pliant.results.run import Run, read_run

_CLOUD = f"{MODEL}/points3D.ply"
_MOST_POINTS = 200_000
"""Maximum number of dense points: trainers add more where they need them."""
_REACH_VOXELS = 4.0
"""The truncation of the TSDF: so near to the mesh a point of the map is on the same surface."""
_COMPARED_POINTS = 4096
"""Points of the map that are compared to find near-duplicate views."""


@dataclass(frozen=True)
class Cloud:
    """positions, normals: (N, 3).    colours: (N, 3) RGB."""

    positions: F32
    normals: F32
    colours: U8

    def select(self, rows: BoolArray | slice) -> "Cloud":
        """Some of the points."""
        return Cloud(self.positions[rows], self.normals[rows], self.colours[rows])


def splat(recording: Recording, path: Path, folder: Path | None, crop: Box | None = None) -> None:
    """The files above, of the longest segment.  crop: only points in this box."""
    run = read_run(recording.path)
    ideal = IdealCamera(run)
    images = write_posed_images(
        recording, camera_of(recording), ideal, path / "images", mask_name=mask_name
    )
    points = run.history.points_in(ideal.segment)
    images = _without_blurred(path, images, ideal, points)
    model, kept = seen_model(recording, ideal, images, points, crop)
    sparse = points.select(kept)
    dense = _dense(run, ideal.segment, sparse)
    dense = dense.select(rows_in(crop, dense.positions))
    dense = dense.select(slice(None, None, max(1, -(-len(dense.positions) // _MOST_POINTS))))
    make_folder(path / MODEL)
    unseen = dense.select(np.any(dense.normals, axis=1))  # the others are in the model already
    positions = np.concatenate([sparse.positions, unseen.positions]).astype(np.float64)
    colours = np.concatenate([sparse.colours, unseen.colours]).astype(np.uint8)
    write_colmap(path / MODEL, ideal.camera, model, positions, colours)
    write_ply(path / _CLOUD, dense.positions, dense.colours, normals=dense.normals)
    write_transforms(path, ideal, images, _CLOUD, mask_name)


def _without_blurred(
    path: Path, images: list[PosedImage], ideal: IdealCamera, points: Points
) -> list[PosedImage]:
    """Delete blurred images of which a near-duplicate is sharper, and return the others."""
    positions = points.positions[:: max(1, len(points) // _COMPARED_POINTS)]
    pixels = np.full((len(images), len(positions), 2), np.nan)
    for image, seen in zip(images, pixels, strict=True):
        T = inverse(image.T_world_camera)
        local = positions @ T[:3, :3].T + T[:3, 3]
        ahead = np.flatnonzero(local[:, 2] > 0.0)
        projected = ideal.camera.project(local[ahead])
        inside = ideal.shows(projected)
        seen[ahead[inside]] = projected[inside]
    sharpness = np.array([image.sharpness for image in images])
    kept = sharp_views(pixels, sharpness, ideal.camera.width)
    for image, stays in zip(images, kept, strict=True):
        if not stays:
            (path / "images" / image.name).unlink()
            (path / "masks" / mask_name(image.name)).unlink(missing_ok=True)
    return [image for image, stays in zip(images, kept, strict=True) if stays]


def _dense(run: Run, segment: int, points: Points) -> Cloud:
    """Vertices of the fine mesh, and the points of the map that are far from it."""
    colours = np.asarray(points.colours, np.uint8).reshape(-1, 3)
    sparse = np.asarray(points.positions, np.float32).reshape(-1, 3)
    far = Cloud(sparse, np.zeros_like(sparse), colours)
    pieces = meshes_of(run.mesh).get((segment, "fine"))
    if pieces is None or not len(pieces[0].positions):
        return far
    mesh = joined(pieces)
    near = _is_near(sparse, mesh.positions, _REACH_VOXELS * pieces[0].voxel_size)
    return Cloud(
        np.concatenate([mesh.positions, sparse[~near]]),
        np.concatenate([mesh.normals, far.normals[~near]]),
        np.concatenate([mesh.colours, colours[~near]]),
    )


def _is_near(positions: F32, known: F32, reach: float) -> BoolArray:
    """(N,) which positions have a known one in their cell of a grid or one of its neighbours.

    reach: side of a cell.
    """
    limit = KEY_LIMIT - 2
    cells, occupied = (
        np.clip(np.floor(each / reach), -limit, limit).astype(np.int32)
        for each in (positions, known)
    )
    occupied_keys = np.unique(pack(occupied))
    near = np.zeros(len(positions), np.bool_)
    for shift in np.ndindex(3, 3, 3):
        near |= np.isin(pack(cells + np.array(shift, np.int32) - 1), occupied_keys)
    return near
