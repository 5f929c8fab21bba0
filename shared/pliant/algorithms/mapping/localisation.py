"""The pose of a frame from the points of the map that it sees."""

from dataclasses import dataclass

import numpy as np

from pliant.algorithms.absolute_pose import pose_by_ransac, truncated_cost
from pliant.algorithms.arrays import F32, F64, BoolArray
from pliant.algorithms.bundle.problem import BundleParameters
from pliant.algorithms.bundle.subspace import refine_pose
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import inverse
from pliant.algorithms.mapping.directions import Spread, refine_pose_spread
from pliant.algorithms.mapping.parameters import LocalisationParameters

_COARSE_SIGMAS = 4.0
"""The kernel is first this many times wider, so that a poor prediction still converges."""

_PREDICTION_GATE_PX = 20.0


@dataclass(frozen=True, kw_only=True)
class Localisation:
    """T_world_camera of a frame, and which of the points (N,) support it.

    stands: there is no sign that it is elsewhere than it stood, see ``Spread``.
    """

    T_world_camera: F64
    inliers: BoolArray
    stands: bool = False


def locate(
    predictions: list[F64],
    points_world: F64,
    points_px: F32,
    camera: PinholeCamera,
    parameters: LocalisationParameters,
    generator: np.random.Generator,
    spread: Spread | None = None,
) -> Localisation:
    """The pose that most points agree with: from the best prediction, or by P3P and RANSAC.

    predictions: poses (4, 4) to start from, at least one.   points_world: (N, 3).  points_px:
    (N, 2).  spread: of provisional points, see ``directions``; None: all are certain.
    The caller judges whether the inliers suffice.
    """
    points_n = camera.normalise(points_px.astype(np.float64))
    gate = _PREDICTION_GATE_PX / camera.fx
    costs = [_cost(T_world_camera, points_world, points_n, gate) for T_world_camera in predictions]
    start = predictions[int(np.argmin(costs))]
    best = refine(start, points_world, points_px, camera, parameters, spread=spread)
    if best.inliers.sum() < parameters.min_predicted_share * len(points_px):
        found = pose_by_ransac(
            points_world,
            points_n,
            generator,
            gate=parameters.ransac_gate_px / camera.fx,
            samples=parameters.ransac_samples,
        )
        if found is not None:
            other = refine(found[0], points_world, points_px, camera, parameters, spread=spread)
            if other.inliers.sum() > best.inliers.sum():
                best = other
    return best


def refine(
    T_world_camera: F64,
    points_world: F64,
    points_px: F32,
    camera: PinholeCamera,
    parameters: LocalisationParameters,
    *,
    near: bool = False,
    spread: Spread | None = None,
) -> Localisation:
    """Robust refinement of a pose, from a wide kernel to a narrow one; near: narrow at once.

    spread: of provisional points, see ``directions``; None: all are certain.
    """
    inliers, stands = np.zeros(len(points_px), np.bool_), False
    for widening in (1.0,) if near else (_COARSE_SIGMAS, 1.0):
        if spread is not None:
            T_world_camera, squared, stands = refine_pose_spread(
                T_world_camera, points_world, spread.vectors, points_px, camera,
                standing=spread.standing,
                kernel_sigma_px=widening * parameters.kernel_sigma_px,
            )  # fmt: skip
            inliers = squared < parameters.inlier_px**2
            continue
        bundle = BundleParameters(kernel_sigma_px=widening * parameters.kernel_sigma_px)
        T_world_camera, inliers, _ = refine_pose(
            T_world_camera, points_world, points_px, camera, bundle, inlier_px=parameters.inlier_px
        )
    return Localisation(T_world_camera=T_world_camera, inliers=inliers, stands=stands)


def _cost(T_world_camera: F64, points_world: F64, points_n: F64, gate: float) -> float:
    T = inverse(T_world_camera)
    return truncated_cost(
        np.ascontiguousarray(T[:3, :3]), np.ascontiguousarray(T[:3, 3]), points_world, points_n,
        gate,
    )  # fmt: skip
