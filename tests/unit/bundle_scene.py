"""Small synthetic windows with known truth, and a plain numpy model of Eq. 6, for the tests."""

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from pliant.algorithms.geometry import inverse, so3_exp
from pliant.algorithms.slam.estimate.problem import (
    SHARED,
    BundleParameters,
    BundleProblem,
    BundleResult,
    BundleWindow,
    CalibrationUncertainty,
)
from pliant.algorithms.slam.estimate.subspace import solve_subspace

F64 = NDArray[np.float64]


@dataclass(frozen=True)
class Scene:
    """A problem and the truth from which it was disturbed."""

    problem: BundleProblem
    T_world_camera: F64
    points_world: F64


def make_scene(
    *,
    cameras: int = 5,
    points: int = 60,
    seed: int = 0,
    noise_px: float = 0.0,
    visible: float = 1.0,
    disturbance: float = 1.0,
    outliers: float = 0.0,
    distortion: tuple[float, float] = (0.0, 0.0),
) -> Scene:
    """Cameras on an arc look at a box of points; the first two are fixed, which fixes the gauge."""
    rng = np.random.default_rng(seed)
    T = np.tile(np.eye(4), (cameras, 1, 1))
    for m in range(cameras):
        T[m, :3, :3] = so3_exp(np.array([0.02 * np.sin(m), -0.04 * m, 0.01 * m]))
        T[m, :3, 3] = [0.25 * m, 0.05 * np.sin(2.0 * m), 0.02 * m]
    world = rng.uniform([-2.0, -1.5, 4.0], [3.0, 1.5, 8.0], (points, 3))
    intrinsics = np.tile([500.0, 520.0, 320.0, 240.0, *distortion], (cameras, 1))
    px = project(T, world, intrinsics)
    seen = rng.random((cameras, points)) < visible
    seen[:2] = True
    camera_index, point_index = np.nonzero(seen)
    observed = px[camera_index, point_index]
    observed += rng.normal(0.0, 1.0, observed.shape) * noise_px
    wrong = rng.random(len(observed)) < outliers
    observed[wrong] += rng.uniform(20.0, 60.0, (int(wrong.sum()), 2))
    start = T.copy()
    for m in range(2, cameras):
        start[m, :3, :3] = T[m, :3, :3] @ so3_exp(disturbance * rng.normal(0.0, 0.01, 3))
        start[m, :3, 3] += disturbance * rng.normal(0.0, 0.02, 3)
    moved = world * (1.0 + disturbance * rng.normal(0.0, 0.03, (points, 1)))
    problem = BundleProblem(
        T_world_camera=start,
        points_world=moved,
        camera_index=camera_index.astype(np.int32),
        point_index=point_index.astype(np.int32),
        points_px=observed.astype(np.float32),
        intrinsics=intrinsics,
        fixed_cameras=np.arange(cameras) < 2,
    )
    return Scene(problem, T, world)


def to_window(problem: BundleProblem) -> BundleWindow:
    """Every second column of a table, with others between that are no part of the problem."""
    columns = 1 + 2 * np.arange(len(problem.points_world), dtype=np.int32)
    u, v, w = np.full((3, len(problem.T_world_camera), 2 * len(columns) + 1), 7.0, np.float32)
    seen = np.zeros(u.shape, np.bool_)
    at = (problem.camera_index, columns[problem.point_index])
    u[at], v[at], seen[at] = problem.points_px[:, 0], problem.points_px[:, 1], True
    w[at] = 1.0 if problem.weights is None else problem.weights
    return BundleWindow(
        T_world_camera=problem.T_world_camera, points_world=problem.points_world, columns=columns,
        u=u, v=v, weights=w, seen=seen, intrinsics=problem.intrinsics,
        fixed_cameras=problem.fixed_cameras,
    )  # fmt: skip


def sweep(problem: BundleProblem, parameters: BundleParameters) -> BundleResult:
    """The subspace method alone."""
    return solve_subspace(to_window(problem), parameters)


def project(T_world_camera: F64, points_world: F64, intrinsics: F64) -> F64:
    """(M, N, 2) pixels."""
    T = inverse(T_world_camera)
    local = np.einsum("mij,nj->mni", T[:, :3, :3], points_world) + T[:, None, :3, 3]
    xy = local[..., :2] / local[..., 2:]
    r2 = (xy**2).sum(axis=-1, keepdims=True)
    lens = 1.0 + intrinsics[:, None, 4:5] * r2 + intrinsics[:, None, 5:6] * r2**2
    return intrinsics[:, None, :2] * lens * xy + intrinsics[:, None, 2:4]


def residuals(problem: BundleProblem, T_world_camera: F64, points_world: F64) -> F64:
    """(O, 2) observed minus projected."""
    px = project(T_world_camera, points_world, problem.intrinsics)
    return problem.points_px.astype(np.float64) - px[problem.camera_index, problem.point_index]


def cost(
    problem: BundleProblem, T_world_camera: F64, points_world: F64, parameters: BundleParameters
) -> float:
    """Eq. 6 with the Geman-McClure kernel."""
    s = (residuals(problem, T_world_camera, points_world) ** 2).sum(axis=1)
    sigma = parameters.kernel_sigma_px
    rho = s if sigma == 0.0 else s / (1.0 + s / sigma**2)
    weights = 1.0 if problem.weights is None else problem.weights
    return float(0.5 * (weights * rho).sum())


def move(T_world_camera: F64, step: F64) -> F64:
    """One (4, 4) pose moved by (rho, theta): T_camera_world is multiplied from the left."""
    T = inverse(T_world_camera)
    E = np.eye(4)
    E[:3, :3], E[:3, 3] = so3_exp(step[3:]), step[:3]
    return inverse(E @ T)


def numeric_jacobian(problem: BundleProblem, epsilon: float = 1e-6) -> F64:
    """(2 O, 6 M + 3 N) central differences of the residuals by all steps."""
    M, N = len(problem.T_world_camera), len(problem.points_world)
    columns: list[F64] = []
    for k in range(6 * M + 3 * N):
        sides: list[F64] = []
        for sign in (1.0, -1.0):
            T, points = problem.T_world_camera.copy(), problem.points_world.copy()
            if k < 6 * M:
                step = np.zeros(6)
                step[k % 6] = sign * epsilon
                T[k // 6] = move(T[k // 6], step)
            else:
                points[(k - 6 * M) // 3, (k - 6 * M) % 3] += sign * epsilon
            sides.append(residuals(problem, T, points).reshape(-1))
        columns.append((sides[0] - sides[1]) / (2.0 * epsilon))
    return np.stack(columns, axis=1)


def dense_normal_equations(problem: BundleProblem, parameters: BundleParameters) -> tuple[F64, F64]:
    """H and the negative gradient of the whole problem, from finite differences."""
    J = numeric_jacobian(problem)
    r = residuals(problem, problem.T_world_camera, problem.points_world)
    s = (r**2).sum(axis=1)
    sigma = parameters.kernel_sigma_px
    inverse_s2 = 0.0 if sigma == 0.0 else sigma**-2
    w = np.repeat(1.0 / (1.0 + s * inverse_s2) ** 2, 2)
    return J.T @ (w[:, None] * J), -J.T @ (w * r.reshape(-1))


EXACT = BundleParameters(kernel_sigma_px=0.0, max_iterations=60, min_relative_decrease=1e-10)


FREE = CalibrationUncertainty(
    focal=1.0, k1=1.0, k2=1.0, readout=1.0, principal_point=1.0, aspect=1.0, prior_px=1e-3
)


def with_lens(problem, s=0.0, k1=0.0, k2=0.0, a=0.0, b=0.0, t=0.0):
    """The problem as a camera with this lens is believed to see it."""
    intrinsics = problem.intrinsics.copy()
    intrinsics[:, :2] *= np.exp(s)
    intrinsics[:, 1] *= np.exp(t)
    intrinsics[:, 2:4] += intrinsics[:, :2] * (a, b)
    intrinsics[:, 4:] = k1, k2
    return dataclasses.replace(problem, intrinsics=intrinsics)


def with_flow(problem):
    """The problem with what a rolling shutter would do, here at random."""
    shape = (len(problem.camera_index), 2)
    flow = np.random.default_rng(1).normal(0.0, 3.0, shape).astype(np.float32)
    return dataclasses.replace(problem, readout_flow=flow)


def calibration_jacobian(problem, q, step=1e-6):
    """(2 O, SHARED) central differences of what is predicted, at the problem's poses and points."""

    def predicted(q):
        lens = with_lens(problem, *q[:3], *q[4:]).intrinsics
        px = project(problem.T_world_camera, problem.points_world, lens)
        at = (problem.camera_index, problem.point_index)
        return (px[at] + q[3] * problem.readout_flow).reshape(-1)

    sides = [(predicted(q + d), predicted(q - d)) for d in step * np.eye(SHARED)]
    J = np.stack([(a - b) / (2.0 * step) for a, b in sides], axis=1)
    return J, problem.points_px.astype(np.float64).reshape(-1) - predicted(q)
