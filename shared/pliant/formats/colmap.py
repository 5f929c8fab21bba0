"""COLMAP's text model: ``cameras.txt``, ``images.txt`` and ``points3D.txt``.

For splats, NeRFs and multi-view stereo.  COLMAP's pixels have (0.5, 0.5) at the centre of the
top-left pixel, and its poses map the world to the camera.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from pliant.algorithms.arrays import F64, I64, U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, matrix_to_pose
from pliant.formats.text import format_fixed, write_lines


@dataclass(frozen=True)
class ColmapImage:
    """One image: its file, T_world_camera (4, 4), and what it sees.

    points_px: (N, 2), (0, 0) at the centre of the top-left pixel.    points: (N,) rows of points.
    """

    name: str
    T_world_camera: F64
    points_px: F64
    points: I64


def write_colmap(
    folder: Path,
    camera: PinholeCamera,
    images: Sequence[ColmapImage],
    positions: F64,
    colours: U8,
) -> None:
    """Write a model: images are numbered from 1 in their order, points from 1 by row.

    positions: (N, 3) in the world.     colours: (N, 3) RGB.
    Raises ResultError if the disk fails.
    """
    write_lines(
        folder / "cameras.txt",
        [
            "# CAMERA_ID MODEL WIDTH HEIGHT PARAMS[]",
            f"1 PINHOLE {camera.width} {camera.height} {camera.fx!r} {camera.fy!r} "
            f"{camera.cx + 0.5!r} {camera.cy + 0.5!r}",
        ],
    )
    write_lines(folder / "images.txt", _image_lines(images))
    write_lines(folder / "points3D.txt", _point_lines(camera, images, positions, colours))


def _image_lines(images: Sequence[ColmapImage]) -> Iterator[str]:
    yield "# IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME; then POINTS2D[] as X Y POINT3D_ID"
    for number, image in enumerate(images, start=1):
        pose = matrix_to_pose(inverse(image.T_world_camera)).tolist()
        values = [pose[6], *pose[3:6], *pose[:3]]
        yield f"{number} {' '.join(format_fixed(v) for v in values)} 1 {image.name}"
        pixels = (image.points_px + 0.5).tolist()
        yield " ".join(
            f"{u:.3f} {v:.3f} {point + 1}"
            for (u, v), point in zip(pixels, image.points.tolist(), strict=True)
        )


def _point_lines(
    camera: PinholeCamera, images: Sequence[ColmapImage], positions: F64, colours: U8
) -> Iterator[str]:
    yield "# POINT3D_ID X Y Z R G B ERROR TRACK[] as IMAGE_ID POINT2D_IDX"
    tracks: list[list[str]] = [[] for _ in range(len(positions))]
    errors = np.zeros(len(positions))
    for number, image in enumerate(images, start=1):
        T_camera_world = inverse(image.T_world_camera)
        seen = positions[image.points] @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        error = np.linalg.norm(camera.project(seen) - image.points_px, axis=1)
        np.add.at(errors, image.points, error)
        for row, point in enumerate(image.points.tolist()):
            tracks[point].append(f"{number} {row}")
    for point, track in enumerate(tracks):
        xyz = " ".join(format_fixed(value) for value in positions[point])
        rgb = " ".join(str(value) for value in colours[point].tolist())
        mean = errors[point] / max(1, len(track))
        yield f"{point + 1} {xyz} {rgb} {format_fixed(mean, 4)} {' '.join(track)}".rstrip()
