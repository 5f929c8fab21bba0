"""Bundle adjustment problems in public formats: BAL text files and libmv arrays.

BAL (grail.cs.washington.edu/projects/bal): one text file, `cameras points observations`, then
`camera point x y` lines, then nine numbers a camera (rotation vector, translation, f, k1, k2) and
three a point.  Its cameras look along -z with y up and the image centre as origin; here the y and z
axes of each camera and the y axis of its image are turned over, which changes no residual.

libmv (.npz): arrays `intrinsics_f_cx_cy_k1_k2_k3_p1_p2`, `R`, `t`, `cam_image`, `X`,
`point_track`, `obs_image`, `obs_track`, `obs_xy`; x_camera = R X + t, OpenCV axes.

Intrinsics are kept as they stand in the file and are not adjusted.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import inverse, so3_exp
from pliant.algorithms.slam.estimate.problem import BundleProblem
from pliant.errors import DatasetError

Indices = NDArray[Any]


def load_bal(path: Path) -> BundleProblem:
    """Read a BAL text file.  The first camera is fixed.  Raises DatasetError."""
    try:
        numbers = np.array(path.read_text(encoding="ascii").split(), np.float64)
    except (OSError, ValueError) as error:
        raise DatasetError(f"{path}: not a BAL problem: {error}") from error
    cameras, points, observations = (int(x) for x in numbers[:3]) if len(numbers) > 2 else (0, 0, 0)
    if cameras < 1 or len(numbers) != 3 + 4 * observations + 9 * cameras + 3 * points:
        raise DatasetError(f"{path}: not a BAL problem: {len(numbers)} numbers do not fit its head")
    seen = numbers[3 : 3 + 4 * observations].reshape(-1, 4)
    poses = numbers[3 + 4 * observations :][: 9 * cameras].reshape(-1, 9)
    flip = np.diag([1.0, -1.0, -1.0])
    intrinsics = np.zeros((cameras, 6))
    intrinsics[:, 0] = intrinsics[:, 1] = poses[:, 6]
    intrinsics[:, 4:] = poses[:, 7:]
    return _problem(
        flip @ so3_exp(poses[:, :3]),
        poses[:, 3:6] @ flip,
        numbers[len(numbers) - 3 * points :].reshape(-1, 3),
        seen[:, 0],
        seen[:, 1],
        seen[:, 2:] * (1.0, -1.0),
        intrinsics,
    )


def load_libmv(path: Path) -> BundleProblem:
    """Read a libmv problem from an .npz file.  The first camera is fixed.  Raises DatasetError."""
    try:
        with np.load(path) as file:
            data = {name: np.asarray(file[name]) for name in file.files}
        f, cx, cy, k1, k2, *others = data["intrinsics_f_cx_cy_k1_k2_k3_p1_p2"]
        images, tracks = data["cam_image"], data["point_track"]
        camera, point = (
            np.searchsorted(images, data["obs_image"]),
            np.searchsorted(tracks, data["obs_track"]),
        )
        R, t, points, px = data["R"], data["t"], data["X"], data["obs_xy"]
    except (OSError, ValueError, KeyError) as error:
        raise DatasetError(f"{path}: not a libmv problem: {error}") from error
    if any(others):
        raise DatasetError(f"{path}: k3, p1 and p2 are not supported, they are {others}")
    intrinsics = np.tile(np.array([f, f, cx, cy, k1, k2]), (len(R), 1))
    return _problem(R, t, points, camera, point, px, intrinsics)


def _problem(
    R: F64, t: F64, points: F64, camera: Indices, point: Indices, px: F64, intrinsics: F64
) -> BundleProblem:
    T_camera_world = np.tile(np.eye(4), (len(R), 1, 1))
    T_camera_world[:, :3, :3], T_camera_world[:, :3, 3] = R, t
    return BundleProblem(
        T_world_camera=inverse(T_camera_world),
        points_world=np.ascontiguousarray(points, np.float64),
        camera_index=camera.astype(np.int32),
        point_index=point.astype(np.int32),
        points_px=px.astype(np.float32),
        intrinsics=intrinsics,
        fixed_cameras=np.arange(len(R)) == 0,
    )
