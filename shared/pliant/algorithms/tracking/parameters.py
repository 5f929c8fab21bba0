"""Parameters of the extrema tracker (VITAMIN-E, section 2, and what was added to it)."""

from pydantic import Field

from pliant.algorithms.parameters import Parameters


class TrackingParameters(Parameters):
    """Parameters of tracking.  Lengths are pixels of the full-size image."""

    blur_sigma_px: float = Field(
        default=1.0, ge=0.5, le=1.3, description="Gaussian before the derivatives of Eq. 1, px."
    )
    min_curvature: float = Field(
        default=0.5, ge=0.0, description="Minimum |kappa| of an extremum, DN^3."
    )
    max_tracks: int = Field(
        default=10_000, ge=100, le=100_000, description="Maximum tracks in a frame."
    )
    spacing_px: int = Field(
        default=2, ge=0, le=20, description="Minimum distance of a new track to all others, px."
    )
    cell_px: int = Field(
        default=40,
        ge=8,
        description="Side of the cells over which new tracks are spread evenly, px.",
    )

    flow_sigma_px: float = Field(
        default=6.0,
        gt=0.0,
        description="Scale of the Geman-McClure kernel of the affine fit (Eq. 3), px.",
    )
    flow_points: int = Field(
        default=300, ge=20, le=4000, description="Maximum BRIEF points for the dominant flow."
    )
    flow_max_shift_px: float = Field(
        default=180.0, gt=0.0, description="Maximum displacement between matched BRIEF points, px."
    )
    prediction_weight: float = Field(
        default=1.0,
        ge=0.0,
        description="lambda of Eq. 5 as a multiple of the track's own last kappa.",
    )
    prediction_sigma_px: float = Field(default=3.0, gt=0.0, description="Scale of w in Eq. 5, px.")
    max_correction_px: float = Field(
        default=5.0,
        gt=0.0,
        description="Maximum distance between an extremum and its prediction, px.",
    )

    patch_iterations: int = Field(
        default=4, ge=1, le=20, description="Maximum Gauss-Newton steps of a patch in a frame."
    )
    min_zncc: float = Field(
        default=0.88,
        ge=-1.0,
        le=1.0,
        description="Minimum ZNCC of a patch; below it the track is lost.",
    )
    min_residual: float = Field(
        default=1.5,
        ge=0.0,
        description="RMS residual, grey levels, below which min_zncc is not required.",
    )
    min_strength: float = Field(
        default=1.0,
        ge=0.0,
        description="Minimum smaller eigenvalue of a new patch's structure tensor per pixel, DN^2.",
    )
    min_isotropy: float = Field(
        default=0.05,
        ge=0.0,
        le=1.0,
        description=(
            "Minimum ratio of the eigenvalues of a new patch's structure tensor.  A patch "
            "below it lies on a contour and slides along it."
        ),
    )
    fine_strength: float = Field(
        default=0.7,
        ge=0.0,
        description="Patches weaker than this are taken at half size, with twice the extent, DN^2.",
    )
    extremum_gate_px: float = Field(
        default=1.0,
        gt=0.0,
        description="Maximum distance between a patch and its extremum, px; beyond, it coasts.",
    )
    coast_s: float = Field(
        default=0.68, ge=0.0, description="Maximum consecutive seconds without an extremum."
    )
    coast_gate_px: float = Field(
        default=3.0,
        gt=0.0,
        description="Maximum distance of a coasting patch from the flow, px.",
    )
    backward_gate_px: float = Field(
        default=0.7,
        gt=0.0,
        description=(
            "Maximum distance between the start and the backward-tracked position of a "
            "coasting patch with a strength of 1 DN^2, px; it scales with one over the root "
            "of the strength, 0.25 to 1 px."
        ),
    )
