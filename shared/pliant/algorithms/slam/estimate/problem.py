"""Input and output of bundle adjustment: cameras, points and observations.

Two forms of the same problem: ``BundleProblem`` lists its observations, for Schur LM;
``BundleWindow`` selects them from dense camera x point arrays, as a window of keyframes has them.
"""

from dataclasses import dataclass, field
from typing import Annotated, TypeAlias

import numpy as np
from pydantic import Field

from pliant.algorithms.arrays import F32, F64, I32, BoolArray, Shape, check_arrays
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.parameters import Parameters

SHARED = 7
"""Unknowns of a calibration that all cameras share: see ``calibration``."""

INITIAL_DAMPING = 1e-4
"""Of Levenberg-Marquardt, relative to the diagonal of the Hessian."""


class BundleParameters(Parameters):
    """Parameters shared by all bundle adjustment solvers."""

    kernel_sigma_px: float = Field(
        default=2.0,
        ge=0.0,
        description="Scale of the Geman-McClure kernel, px; 0: plain least squares",
    )
    min_depth: float = Field(
        default=1e-3,
        description=(
            "Depth, in map units, below which a landmark is behind the camera and costs the "
            "kernel's maximum; a large negative number disables the test"
        ),
    )
    max_iterations: int = Field(
        default=30,
        ge=1,
        description="Maximum Levenberg-Marquardt iterations of the Schur solver",
    )
    max_sweeps: int = Field(
        default=4, ge=0, description="Maximum sweeps of the subspace solver when it runs alone"
    )
    min_relative_decrease: float = Field(
        default=1e-5,
        ge=0.0,
        description="Stop when an iteration or a sweep reduces the cost by less than this share",
    )


class CalibrationUncertainty(Parameters):
    """Uncertainty of the given calibration: standard deviations of a prior at 0."""

    focal: float = Field(
        default=0.01,
        ge=0.0,
        description="Standard deviation of the focal length, as a share of it; 0: fixed",
    )
    k1: float = Field(
        default=0.02,
        ge=0.0,
        description=(
            "Standard deviation of the radial distortion k1 after rectification. Observations"
            " near the border count less by it until k1 is estimated; 0: fixed"
        ),
    )
    k2: float = Field(
        default=0.0,
        ge=0.0,
        description="Standard deviation of the radial distortion k2 after rectification; 0: fixed",
    )
    readout: float = Field(
        default=0.1,
        ge=0.0,
        description=(
            "Standard deviation of the rolling-shutter readout, as a share of the frame "
            "interval; 0: global shutter"
        ),
    )
    principal_point: float = Field(
        default=0.0,
        ge=0.0,
        description=(
            "Standard deviation of the principal point in x and y, as a share of the focal "
            "length; 0: fixed until the images contradict it"
        ),
    )
    aspect: float = Field(
        default=0.0,
        ge=0.0,
        description="Standard deviation of the logarithm of fy / fx beside the given one; 0 holds "
        "it until the images contradict it",
    )
    prior_px: float = Field(
        default=1.0,
        gt=0.0,
        description=(
            "Weight of this prior: one standard deviation costs as much as one observation "
            "with a residual of this many px"
        ),
    )

    @property
    def sigmas(self) -> F64:
        """(SHARED,) of the focal factor's logarithm, k1, k2, the readout, the principal point and
        the logarithm of the aspect ratio."""
        point = self.principal_point
        return np.array([self.focal, self.k1, self.k2, self.readout, point, point, self.aspect])


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
    readout_flow: (O, 2) px by which a rolling shutter moves each observation where its readout
        fills the frame interval; None: every row of a frame is taken at once.
    """

    T_world_camera: Annotated[F64, Shape("M", 4, 4)]
    points_world: Annotated[F64, Shape("N", 3)]
    camera_index: Annotated[I32, Shape("O")]
    point_index: Annotated[I32, Shape("O")]
    points_px: Annotated[F32, Shape("O", 2)]
    intrinsics: Annotated[F64, Shape("M", 6)]
    fixed_cameras: Annotated[BoolArray, Shape("M")]
    weights: F32 | None = None
    readout_flow: F32 | None = None

    def __post_init__(self) -> None:
        check_arrays(self)
        observations = len(self.camera_index)
        _check_optional("weights", self.weights, (observations,))
        _check_optional("readout_flow", self.readout_flow, (observations, 2))
        if len(self.camera_index):
            if self.camera_index.min() < 0 or self.camera_index.max() >= len(self.T_world_camera):
                raise ValueError("camera_index: out of range")
            if self.point_index.min() < 0 or self.point_index.max() >= len(self.points_world):
                raise ValueError("point_index: out of range")


@dataclass(frozen=True, kw_only=True)
class BundleWindow:
    """Cameras, and points that are some columns of a dense table of observations.

    columns: of the points.   seen: whether camera m observes column c.
    u, v, weights: pixel and factor of the cost term of each observation; anything elsewhere.
    Points created together should be adjacent: blocks of points that a camera does not observe are
    skipped.  The other fields are those of ``BundleProblem``.
    """

    T_world_camera: Annotated[F64, Shape("M", 4, 4)]
    points_world: Annotated[F64, Shape("N", 3)]
    columns: Annotated[I32, Shape("N")]
    u: Annotated[F32, Shape("M", "C")]
    v: Annotated[F32, Shape("M", "C")]
    weights: Annotated[F32, Shape("M", "C")]
    seen: Annotated[BoolArray, Shape("M", "C")]
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
        One for each observation of a ``BundleProblem`` (O,), inf for those left out as not finite;
        none (0,) for a ``BundleWindow``.
    correction: (SHARED,) of the calibration, where it was unknown: see ``solve_schur``.
    covariance: (SHARED, SHARED) of the correction, where residuals have a standard deviation of
        1 px, if requested.
    log_focal: (M,) of each camera relative to the shared focal length, (0,) where it is the same.
    """

    T_world_camera: F64
    points_world: F64
    initial_cost: float
    final_cost: float
    iterations: int
    converged: bool
    squared_residuals: F32
    costs: F64 = field(default_factory=lambda: np.zeros(0))
    correction: F64 = field(default_factory=lambda: np.zeros(SHARED))
    covariance: F64 = field(default_factory=lambda: np.zeros((SHARED, SHARED)))
    log_focal: F64 = field(default_factory=lambda: np.zeros(0))

    def residual_variance(self, problem: "BundleProblem") -> float:
        """Variance of the residuals of the solved problem, px^2; 0 without redundancy."""
        unknowns = 3 * len(self.points_world) + 6 * len(self.T_world_camera)
        redundancy = 2 * len(problem.points_px) - unknowns
        return 2.0 * self.final_cost / redundancy if redundancy > 0 else 0.0


def shared_intrinsics(camera: PinholeCamera, count: int) -> F64:
    """(count, 6) rows ``fx, fy, cx, cy, 0, 0``: one camera without distortion for all frames."""
    return np.tile(np.array([*camera.intrinsics, 0.0, 0.0]), (count, 1))


def _check_optional(name: str, value: F32 | None, shape: tuple[int, ...]) -> None:
    if value is not None and (value.dtype != np.float32 or value.shape != shape):
        raise ValueError(f"{name}: expected float32 {shape}, got {value.dtype} {value.shape}")
