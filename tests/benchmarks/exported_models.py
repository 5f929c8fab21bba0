"""How well an exported COLMAP model fits its images, beside COLMAP's own of the same images.

Neither is measured by what it was made from: corners are followed from image to image (Shi and
Tomasi, pyramidal Lucas-Kanade, and back again).  Of each track one observation is held out; the
others make a point, which is projected into the image that was held out.
"""

import tempfile
from collections.abc import Iterator
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any, cast

import cv2
import numpy as np

from benchmarks.colmap import map_by_colmap
from benchmarks.table import markdown_header, markdown_row
from pliant.algorithms.arrays import F32, F64, U8, BoolArray
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.slam.estimate.triangulation import triangulate
from pliant.export.export import export_result

_CORNERS = 300
"""New ones in each image, each followed through so many images at most, at least:"""
_MOST_IMAGES, _LEAST_IMAGES = 8, 4
_BACK_PX = 0.3
"""How near a corner must come to where it was when it is followed back."""
_CLOSE_PX = 2.0
_HEADER = (
    *("run", "model", "images", "points", "held-out px: median", "90 %"),
    *(f"within {_CLOSE_PX:g} px", "tracks"),
)


@dataclass(frozen=True)
class _Tracks:
    """u, v, seen: (M, N) of the images, in the order of their names, and tracks."""

    u: F32
    v: F32
    seen: BoolArray


@dataclass(frozen=True)
class _Model:
    camera: PinholeCamera
    T_world_camera: dict[str, F64]
    points: int


def measure(results: list[Path]) -> Iterator[str]:
    """Two rows for each result folder: ours, and COLMAP's of the images that we exported."""
    yield markdown_header(_HEADER)
    for result in results:
        with tempfile.TemporaryDirectory() as folder:
            ours = export_result(result, "colmap", Path(folder) / "ours")
            theirs = map_by_colmap(ours / "images", Path(folder) / "theirs")
            models = {
                "Pliant": _read(ours / "sparse" / "0"),
                "COLMAP": _read(theirs),
            }
            names = sorted(set.intersection(*(set(m.T_world_camera) for m in models.values())))
            tracks = _tracked([ours / "images" / name for name in names])
        errors = {name: _held_out(model, names, tracks) for name, model in models.items()}
        common = np.isfinite(np.stack(list(errors.values()))).all(axis=0)
        for name, model in models.items():
            found = errors[name][common]
            median, most = np.percentile(found, (50.0, 90.0))
            yield markdown_row(
                (
                    *(result.name, name, str(len(model.T_world_camera)), f"{model.points:,}"),
                    *(f"{median:.2f}", f"{most:.2f}"),
                    *(f"{100.0 * (found < _CLOSE_PX).mean():.1f} %", f"{common.sum():,}"),
                )
            )


def _read(folder: Path) -> _Model:
    pycolmap: Any = import_module("pycolmap")
    read = pycolmap.Reconstruction(str(folder))
    (camera,) = read.cameras.values()
    fx, fy, cx, cy = (float(each) for each in camera.params)
    poses: dict[str, F64] = {}
    for image in read.images.values():
        T_camera_world = np.eye(4)
        T_camera_world[:3] = image.cam_from_world().matrix()
        poses[image.name] = inverse(T_camera_world)
    pinhole = PinholeCamera(
        width=camera.width, height=camera.height, fx=fx, fy=fy, cx=cx - 0.5, cy=cy - 0.5
    )
    return _Model(pinhole, poses, read.num_points3D())


def _tracked(files: list[Path]) -> _Tracks:
    """Corners that are followed through at least four images."""
    images = [cast(U8, cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)) for file in files]
    columns: list[tuple[F32, BoolArray]] = []
    for first in range(len(images) - _LEAST_IMAGES + 1):
        corners = cv2.goodFeaturesToTrack(images[first], _CORNERS, 0.01, 8.0)
        here = np.asarray(corners, np.float32).reshape(-1, 2)
        alive = np.ones(len(here), np.bool_)
        places = np.zeros((len(images), len(here), 2), np.float32)
        seen = np.zeros((len(images), len(here)), np.bool_)
        places[first], seen[first] = here, True
        for at in range(first + 1, min(first + _MOST_IMAGES, len(images))):
            here, good = _followed(images[at - 1], images[at], here)
            alive &= good
            places[at], seen[at] = here, alive
        enough = seen.sum(axis=0) >= _LEAST_IMAGES
        columns.append((places[:, enough], seen[:, enough]))
    places = np.concatenate([each for each, _ in columns], axis=1)
    seen = np.concatenate([each for _, each in columns], axis=1)
    return _Tracks(places[..., 0].copy(), places[..., 1].copy(), seen)


def _followed(image: U8, following: U8, corners: F32) -> tuple[F32, BoolArray]:
    """(N, 2) where corners (N, 2) are in the next image, and which of them lead back."""
    flow: Any = cv2.calcOpticalFlowPyrLK
    there, found, _ = flow(image, following, corners, None, winSize=(15, 15), maxLevel=4)
    back, found_back, _ = flow(following, image, there, None, winSize=(15, 15), maxLevel=4)
    near = np.linalg.norm(back - corners, axis=1) < _BACK_PX
    return there, near & (found.ravel() > 0) & (found_back.ravel() > 0)


def _held_out(model: _Model, names: list[str], tracks: _Tracks) -> F64:
    """(N,) px by which the point of each track misses the observation that it was not made of."""
    T = np.array([model.T_world_camera[name] for name in names])
    columns = np.arange(tracks.seen.shape[1])
    generator = np.random.default_rng(0)
    out = np.argmax(tracks.seen * generator.random(tracks.seen.shape), axis=0)
    used = tracks.seen.copy()
    used[out, columns] = False
    xyz, _, _, _ = triangulate(T, tracks.u, tracks.v, used, columns, model.camera)
    T_camera_world = inverse(T)[out]
    local = np.einsum("nij,nj->ni", T_camera_world[:, :3, :3], xyz) + T_camera_world[:, :3, 3]
    true = np.stack([tracks.u[out, columns], tracks.v[out, columns]], axis=1)
    with np.errstate(all="ignore"):
        errors = np.linalg.norm(model.camera.project(local) - true, axis=1)
    return np.where(local[:, 2] > 0.0, errors, np.nan)
