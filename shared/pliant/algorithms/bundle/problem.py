"""What bundle adjustment is asked and what it answers: cameras, points and observations.

Two forms of the same problem are accepted everywhere: ``BundleProblem`` lists its observations,
``BundleWindow`` holds them as dense camera x point arrays, which is how the solvers work inside.
"""

from dataclasses import dataclass, field
from typing import Annotated, TypeAlias

import numpy as np
from pydantic import Field

from pliant.algorithms.arrays import F32, F64, I32, BoolArray, Shape, check_arrays
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.parameters import Parameters


class BundleParameters(Parameters):
    """Parameters shared by all bundle adjustment solvers."""

    kernel_sigma_px: float = Field(
        default=2.0,
        ge=0.0,
        description="Scale of the Geman-McClure kernel in px; 0 means plain least squares",
    )
    min_depth: float = Field(
        default=1e-3,
        description="Depth in map units under which a point counts as behind a camera and costs "
        "what the kernel saturates at; a large negative number turns the test off",
    )
    max_iterations: int = Field(
        default=30,
        ge=1,
        description="Most Levenberg-Marquardt iterations of the Schur solver",
    )
    max_sweeps: int = Field(
        default=4, ge=0, description="Most sweeps of the subspace solver on its own"
    )
    min_relative_decrease: float = Field(
        default=1e-5,
        ge=0.0,
        description="Stop when an iteration or a sweep lowers the cost by less than this share",
    )
    initial_damping: float = Field(
        default=1e-4,
        gt=0.0,
        description="First Levenberg-Marquardt damping, relative to the diagonal of the Hessian",
    )
    sweep_damping: float = Field(
        default=1e-3,
        ge=0.0,
        description="Damping of a subspace block, relative to the diagonal of the block",
    )


@dataclass(frozen=True, kw_only=True)
class BundleProblem:
    """Cameras, points and a list of observations (VITAMIN-E Eq. 6).

    T_world_camera: poses of the cameras.     points_world: points in the world frame.
    camera_index, point_index, points_px: one observation each, (u, v) with (0, 0) at the centre
        of the top-left pixel.  A camera observes a point at most once (a repetition replaces).
        Observations that are not finite, or of a point that is not finite, are left out.
    intrinsics: fx, fy, cx, cy in px, and the radial distortion k1, k2 (0 for rectified images):
        ``u = fx (1 + k1 r^2 + k2 r^4) x + cx`` with x, y on the plane z = 1.
    fixed_cameras: cameras that do not move.  At least one, or the gauge is left to the damping.
    weights: factors of the observations' cost terms, 0 leaves one out; None: all 1.
    """

    T_world_camera: Annotated[F64, Shape("M", 4, 4)]
    points_world: Annotated[F64, Shape("N", 3)]
    camera_index: Annotated[I32, Shape("O")]
    point_index: Annotated[I32, Shape("O")]
    points_px: Annotated[F32, Shape("O", 2)]
    intrinsics: Annotated[F64, Shape("M", 6)]
    fixed_cameras: Annotated[BoolArray, Shape("M")]
    weights: F32 | None = None

    def __post_init__(self) -> None:
        check_arrays(self)
        weights = self.weights
        if weights is not None and (weights.dtype, weights.shape) != (
            np.dtype(np.float32),
            self.camera_index.shape,
        ):
            raise ValueError(f"weights: one float32 an observation, got {weights.dtype}")
        if len(self.camera_index):
            if self.camera_index.min() < 0 or self.camera_index.max() >= len(self.T_world_camera):
                raise ValueError("camera_index: out of range")
            if self.point_index.min() < 0 or self.point_index.max() >= len(self.points_world):
                raise ValueError("point_index: out of range")


@dataclass(frozen=True, kw_only=True)
class BundleWindow:
    """Cameras, points and dense observations: the form that needs no conversion.

    u, v: pixels where camera m observes point n; any finite number elsewhere.
    weights: factor of the cost term of each observation, 0 where there is none.
    Points born together should stand together: blocks of points that a camera does not see are
    skipped.  The other fields are those of ``BundleProblem``.
    """

    T_world_camera: Annotated[F64, Shape("M", 4, 4)]
    points_world: Annotated[F64, Shape("N", 3)]
    u: Annotated[F32, Shape("M", "N")]
    v: Annotated[F32, Shape("M", "N")]
    weights: Annotated[F32, Shape("M", "N")]
    intrinsics: Annotated[F64, Shape("M", 6)]
    fixed_cameras: Annotated[BoolArray, Shape("M")]

    def __post_init__(self) -> None:
        check_arrays(self)


AnyProblem: TypeAlias = BundleProblem | BundleWindow


@dataclass(frozen=True, kw_only=True)
class BundleResult:
    """The adjusted cameras and points.

    T_world_camera (M, 4, 4), points_world (N, 3): fixed ones are returned unchanged.
    initial_cost, final_cost: ``0.5 sum w rho(r^2)`` in px^2 before and after.
    iterations: sweeps and Levenberg-Marquardt iterations that were tried.
    costs: the cost at the start and after each iteration.
    converged: the decrease became small, as opposed to the iterations running out.
    squared_residuals: px^2 without kernel or weight; inf where the point lies behind the camera.
        One for each observation of a ``BundleProblem`` (O,); (M, N) for a ``BundleWindow``, inf
        where nothing is observed.  Observations left out as not finite: inf.
    """

    T_world_camera: F64
    points_world: F64
    initial_cost: float
    final_cost: float
    iterations: int
    converged: bool
    squared_residuals: F32
    costs: F64 = field(default_factory=lambda: np.zeros(0))


def shared_intrinsics(camera: PinholeCamera, count: int) -> F64:
    """(count, 6) rows ``fx, fy, cx, cy, 0, 0``: one camera without distortion for all frames."""
    return np.tile(np.array([camera.fx, camera.fy, camera.cx, camera.cy, 0.0, 0.0]), (count, 1))
