"""A run as a nerfstudio folder, which splat and NeRF trainers read directly.

    transforms.json    the camera, and for each image its file and camera-to-world
    images/            see ``posed_images``
    masks/             black where trainers are to ignore them; of all images, or of none
    points.ply         the map, for splats to start from

The camera's axes are OpenGL's, x right, y up, z back; the world is the map's.  Pixels have (0.5,
0.5) at the centre of the top-left one, as COLMAP's.
https://docs.nerf.studio/quickstart/data_conventions.html
"""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from pliant.export.images import camera_of
from pliant.export.models import write_points
from pliant.export.posed_images import IdealCamera, PosedImage, write_posed_images
from pliant.formats.text import write_bytes
from pliant.recording.reader import Recording
from pliant.results.run import read_run

_OPENCV_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_POINTS = "points.ply"


def nerfstudio(recording: Recording, path: Path, folder: Path | None) -> None:
    """``transforms.json``, ``images`` and ``points.ply``."""
    run = read_run(recording.path)
    ideal = IdealCamera(run)
    images = write_posed_images(recording, camera_of(recording), ideal, path / "images")
    write_points(path / _POINTS, run.history.points_in(ideal.segment))
    write_transforms(path, ideal, images, _POINTS)


def write_transforms(
    path: Path, ideal: IdealCamera, images: list[PosedImage], points: str,
    mask_name: Callable[[str], str] = str,
) -> None:  # fmt: skip
    """``transforms.json``.  points: file of the points.    mask_name: of an image, by its name."""
    camera = ideal.camera
    content: dict[str, Any] = {
        "camera_model": "OPENCV",
        "w": camera.width,
        "h": camera.height,
        "fl_x": camera.fx,
        "fl_y": camera.fy,
        "cx": camera.cx + 0.5,
        "cy": camera.cy + 0.5,
        **dict.fromkeys(("k1", "k2", "p1", "p2"), 0.0),
        "ply_file_path": points,
        "frames": [
            {
                "file_path": f"images/{image.name}",
                **({"mask_path": f"masks/{mask_name(image.name)}"} if image.masked else {}),
                "transform_matrix": (image.T_world_camera @ _OPENCV_OPENGL).tolist(),
            }
            for image in images
        ],
    }
    write_bytes(path / "transforms.json", f"{json.dumps(content, indent=1)}\n".encode())
