"""The same clip through COLMAP and through Pliant, on the same cores: time, accuracy, points.

Both start from files on a disk and the calibration of the source, and end with files: Pliant's
whole command with its mesh, start-up included, and COLMAP's features, sequential matches and
incremental mapping of undistorted images that are ready for it, with its defaults for a video.
"""

import os
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator, Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import cv2
import numpy as np

from benchmarks.table import markdown_header, markdown_row
from pliant import arithmetic
from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.datasets import open_source
from pliant.datasets.base import BrokenFrame
from pliant.datasets.rectifier import Rectifier
from pliant.errors import PliantError
from pliant.evaluation.presentation import metres
from pliant.evaluation.run_evaluation import evaluate_trajectory
from pliant.formats.ply import read_ply
from pliant.formats.trajectory_files import read_trajectory
from pliant.formats.tum import read_tum
from pliant.trajectory import Trajectory

_HEADER = ("clip", "by", "wall", "processor", "frames with a pose", "ATE RMSE", "points")


def measure(sources: Sequence[str]) -> Iterator[str]:
    """Two rows for each source."""
    yield markdown_header(_HEADER)
    for source in sources:
        dataset = open_source(source)
        if dataset.ground_truth_path is None:
            raise PliantError(f"{source}: brings no true poses to compare with")
        truth = read_trajectory(dataset.ground_truth_path)
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            stamps = _write_images(source, folder / "images")
            for by, once in (("Pliant", _pliant), ("COLMAP", _colmap)):
                began, spent = time.monotonic(), children_s()
                found, points = once(source, folder, stamps)
                wall, cpu = time.monotonic() - began, children_s() - spent
                told = evaluate_trajectory(found, truth, frames=len(stamps))
                yield markdown_row(
                    (
                        *(Path(source).name, by, f"{wall:.0f} s", f"{cpu:.0f} s"),
                        f"{len(found) / len(stamps):.0%}",
                        metres(told.ate_m.rmse) if told.ate_m else told.reason,
                        f"{points:,}",
                    )
                )


def children_s() -> float:
    """Processor time of what has been started here and has ended."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return used.ru_utime + used.ru_stime


def _write_images(source: str, folder: Path) -> list[int]:
    """Undistorted images as ``NNNNNN.png``; the stamps of all frames."""
    dataset = open_source(source)
    rectifier = Rectifier(dataset.calibration)
    folder.mkdir()
    stamps: list[int] = []
    for frame in dataset:
        stamps.append(frame.stamp_ns)
        try:
            grey, colour = rectifier.rectify(frame)
        except BrokenFrame:
            continue
        image = grey if colour is None else colour[..., ::-1]
        cv2.imwrite(str(folder / f"{frame.index:06d}.png"), image)
    return stamps


def _pliant(source: str, folder: Path, stamps: Sequence[int]) -> tuple[Trajectory, int]:
    """Poses, and how many points."""
    result = folder / "result"
    _finished([sys.executable, "-m", "pliant_services.cli", "run", source, "--output", str(result)])
    return read_tum(result / "trajectory.txt"), len(read_ply(result / "points.ply").points)


def _colmap(source: str, folder: Path, stamps: Sequence[int]) -> tuple[Trajectory, int]:
    camera = Rectifier(open_source(source).calibration).camera
    numbers = (camera.fx, camera.fy, camera.cx, camera.cy)
    _finished([sys.executable, "-m", __name__, str(folder), ",".join(map(repr, numbers))])
    pycolmap: Any = import_module("pycolmap")
    model = pycolmap.Reconstruction(str(folder / "model"))
    poses: dict[int, F64] = {}
    for image in model.images.values():
        T_camera_world = np.eye(4)
        T_camera_world[:3] = image.cam_from_world().matrix()
        poses[stamps[int(Path(image.name).stem)]] = inverse(T_camera_world)
    ordered = sorted(poses)
    trajectory = Trajectory(
        stamps_ns=np.array(ordered, np.int64),
        T_world_camera=np.array([poses[stamp_ns] for stamp_ns in ordered]).reshape(-1, 4, 4),
    )
    return trajectory, model.num_points3D()


def _finished(command: list[str]) -> None:
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode not in (0, 3):
        raise PliantError(f"{' '.join(command)}: {done.stderr.strip()}")


def map_by_colmap(images: Path, folder: Path, camera: PinholeCamera | None = None) -> Path:
    """COLMAP's model with the most images, by its defaults for a video.

    camera: of the images, kept as it is; None: COLMAP finds a pinhole camera.
    """
    pycolmap: Any = import_module("pycolmap")
    folder.mkdir(exist_ok=True)
    pycolmap.logging.minloglevel = pycolmap.logging.ERROR.value
    reader, options = pycolmap.ImageReaderOptions(), pycolmap.IncrementalPipelineOptions()
    reader.camera_model = "PINHOLE"
    if camera is not None:
        # Its pixels begin at their corners.
        numbers = (camera.fx, camera.fy, camera.cx + 0.5, camera.cy + 0.5)
        reader.camera_params = ",".join(map(str, numbers))
        options.ba_refine_focal_length = False
    database = folder / "database.db"
    pycolmap.extract_features(
        database, images, camera_mode=pycolmap.CameraMode.SINGLE, reader_options=reader
    )
    pycolmap.match_sequential(database)
    found: dict[int, Any] = pycolmap.incremental_mapping(database, images, folder, options)
    if not found:
        raise PliantError(f"{images}: COLMAP finds no model")
    best = max(found, key=lambda number: found[number].num_reg_images())
    return folder / str(best)


def main() -> None:
    """In a process of its own, whose processor time is COLMAP's.

    Its libraries choose as from a shell: what fixes our arithmetic would leave them one thread.
    """
    for name in arithmetic.VARIABLES:
        os.environ.pop(name, None)
    folder, numbers = Path(sys.argv[1]), sys.argv[2]
    images = folder / "images"
    first: Any = cv2.imread(str(next(images.iterdir())), cv2.IMREAD_GRAYSCALE)
    height, width = first.shape
    fx, fy, cx, cy = map(float, numbers.split(","))
    camera = PinholeCamera(width=width, height=height, fx=fx, fy=fy, cx=cx, cy=cy)
    map_by_colmap(images, folder / "colmap", camera).rename(folder / "model")


if __name__ == "__main__":
    main()
