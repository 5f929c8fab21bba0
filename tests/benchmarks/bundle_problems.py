"""The problems on which bundle adjustment is measured: synthetic windows and public ones."""

from pathlib import Path

import numpy as np

from benchmarks.bal import load_bal, load_libmv
from pliant.algorithms.arrays import F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse, so3_exp
from pliant.algorithms.slam.estimate.problem import (
    BundleParameters,
    BundleProblem,
    shared_intrinsics,
)

CAMERA = PinholeCamera(width=640, height=480, fx=600.0, fy=600.0, cx=319.5, cy=239.5)
WINDOW = BundleParameters(kernel_sigma_px=2.0)
PUBLIC = BundleParameters(
    kernel_sigma_px=20.0, min_depth=-1e9, max_iterations=60, min_relative_decrease=1e-6
)
"""BAL keeps points behind cameras in its cost, as if they were in front.  Its start is 7 px off, so
that a narrow Geman-McClure kernel would send each solver to a local minimum of its own."""
LEAST_SQUARES = PUBLIC.model_copy(update={"kernel_sigma_px": 0.0})

Case = tuple[str, BundleProblem, BundleParameters]


def synthetic_window(
    keyframes: int,
    points: int,
    *,
    track_length: int | None = None,
    disturbance: float = 1.0,
    seed: int = 0,
) -> BundleProblem:
    """A camera moves sideways past points 2 to 8 units away; two keyframes are fixed.

    track_length: keyframes in which a point is seen from its first on; None: in all of them.
    Noise of 0.5 px, 2 % of the observations wrong by up to 40 px.
    disturbance: 1 starts with 2 cm, 0.3 degrees and 3 % of depth wrong (sigma); 0.1 is the start
    that a new keyframe finds in a converged window.
    """
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (keyframes, 1, 1))
    index = np.arange(keyframes)
    turns = np.zeros((keyframes, 3))
    turns[:, 0], turns[:, 1], turns[:, 2] = 0.01 * np.sin(index), 0.006 * index, 0.005 * index
    T[:, :3, :3] = so3_exp(turns)
    T[:, 0, 3], T[:, 1, 3], T[:, 2, 3] = 0.1 * index, 0.02 * np.sin(index), 0.01 * index
    first = rng.integers(0, keyframes, points) if track_length else np.zeros(points, np.int64)
    depth = rng.uniform(2.0, 8.0, points)
    pixel = rng.uniform(0.0, 1.0, (points, 2)) * (CAMERA.width, CAMERA.height)
    local = np.concatenate([CAMERA.normalise(pixel), np.ones((points, 1))], axis=1) * depth[:, None]
    world = np.einsum("nij,nj->ni", T[first, :3, :3], local) + T[first, :3, 3]
    age = index[:, None] - first
    camera_index, point_index = np.nonzero((age >= 0) & (age < (track_length or keyframes)))
    px = _project(T, world)[camera_index, point_index]
    px += rng.normal(0.0, 0.5, px.shape)
    wrong = rng.random(len(px)) < 0.02
    px[wrong] += rng.uniform(-40.0, 40.0, (int(wrong.sum()), 2))
    start = T.copy()
    start[2:, :3, :3] = T[2:, :3, :3] @ so3_exp(
        disturbance * rng.normal(0.0, 0.005, (keyframes - 2, 3))
    )
    start[2:, :3, 3] += disturbance * rng.normal(0.0, 0.02, (keyframes - 2, 3))
    return BundleProblem(
        T_world_camera=start,
        points_world=world * (1.0 + disturbance * rng.normal(0.0, 0.03, (points, 1))),
        camera_index=camera_index.astype(np.int32),
        point_index=point_index.astype(np.int32),
        points_px=px.astype(np.float32),
        intrinsics=shared_intrinsics(CAMERA, keyframes),
        fixed_cameras=index < 2,
    )


def synthetic_cases() -> list[Case]:
    """Windows of 10 and 20 keyframes: started badly, warm, and with short tracks."""
    return [
        ("10 keyframes x 10000 points", synthetic_window(10, 10_000), WINDOW),
        (
            "10 keyframes x 10000 points, warm",
            synthetic_window(10, 10_000, disturbance=0.1),
            WINDOW,
        ),
        ("20 keyframes x 10000 points", synthetic_window(20, 10_000), WINDOW),
        (
            "20 keyframes x 10000 points, tracks of 6",
            synthetic_window(20, 10_000, track_length=6),
            WINDOW,
        ),
    ]


def public_cases(folder: Path) -> list[Case]:
    """BAL and libmv problems of a folder with a text file `ladybug-*` and `libmv/*.npz`.

    Intrinsics stay as they are in the file: k1 and k2 are part of every camera's projection.
    """
    cases: list[Case] = []
    for path in sorted(folder.glob("ladybug-*.txt")):
        problem = load_bal(path)
        cases.append((f"{path.stem}, least squares", problem, LEAST_SQUARES))
        cases.append((f"{path.stem}, Geman-McClure", problem, PUBLIC))
    for path in sorted(folder.glob("libmv/*.npz")):
        cases.append((f"libmv {path.stem}", load_libmv(path), PUBLIC))
    return cases


def _project(T_world_camera: F64, points_world: F64) -> F64:
    T = inverse(T_world_camera)
    local = np.einsum("mij,nj->mni", T[:, :3, :3], points_world) + T[:, None, :3, 3]
    return CAMERA.project(local.reshape(-1, 3)).reshape(*local.shape[:2], 2)
