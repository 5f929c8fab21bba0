"""Bundle adjustment (VITAMIN-E section 3): subspace Gauss-Newton, Schur complement, and both."""

from pliant.algorithms.bundle.calibration import ideal_pixels, solve_calibrating
from pliant.algorithms.bundle.combined import solve, warm_up
from pliant.algorithms.bundle.information import point_information
from pliant.algorithms.bundle.problem import (
    BundleParameters,
    BundleProblem,
    BundleResult,
    BundleWindow,
    CameraPrior,
    shared_intrinsics,
)
from pliant.algorithms.bundle.refine import refine_points, refine_pose
from pliant.algorithms.bundle.schur import solve_schur
from pliant.algorithms.bundle.subspace import solve_subspace
from pliant.algorithms.bundle.uncertainty import CalibrationUncertainty

__all__ = [
    "BundleParameters",
    "BundleProblem",
    "BundleResult",
    "BundleWindow",
    "CalibrationUncertainty",
    "CameraPrior",
    "ideal_pixels",
    "point_information",
    "refine_points",
    "refine_pose",
    "shared_intrinsics",
    "solve",
    "solve_calibrating",
    "solve_schur",
    "solve_subspace",
    "warm_up",
]
