"""Bundle adjustment (VITAMIN-E section 3): subspace Gauss-Newton and Schur complement."""

from pliant.algorithms.bundle.calibration import ideal_pixels, solve_calibrating
from pliant.algorithms.bundle.problem import (
    BundleParameters,
    BundleProblem,
    BundleResult,
    BundleWindow,
    shared_intrinsics,
)
from pliant.algorithms.bundle.refine import refine_points, refine_pose
from pliant.algorithms.bundle.schur import solve_schur
from pliant.algorithms.bundle.subspace import solve_subspace
from pliant.algorithms.bundle.uncertainty import CalibrationUncertainty
from pliant.algorithms.bundle.warm_up import warm_up

__all__ = [
    "BundleParameters",
    "BundleProblem",
    "BundleResult",
    "BundleWindow",
    "CalibrationUncertainty",
    "ideal_pixels",
    "refine_points",
    "refine_pose",
    "shared_intrinsics",
    "solve_calibrating",
    "solve_schur",
    "solve_subspace",
    "warm_up",
]
