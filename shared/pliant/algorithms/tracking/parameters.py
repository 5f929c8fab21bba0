"""Parameters of the extrema tracker; every switch off gives VITAMIN-E, section 2, literally."""

from pydantic import Field

from pliant.algorithms.parameters import Parameters


class TrackingParameters(Parameters):
    """What a user may change about tracking.  Lengths are pixels of the full-size image."""

    blur_sigma_px: float = Field(
        default=1.0, ge=0.5, le=1.3, description="Gaussian before the derivatives of Eq. 1, px."
    )
    min_curvature: float = Field(
        default=0.5, ge=0.0, description="Extrema with a smaller |kappa| are not used, DN^3."
    )
    both_signs: bool = Field(
        default=True,
        description="Track minima of kappa (bright features) besides maxima (dark ones).",
    )
    max_tracks: int = Field(
        default=10_000, ge=100, le=100_000, description="Most tracks in a frame."
    )
    spacing_px: int = Field(
        default=2, ge=0, le=20, description="A new track starts at least this far from every other."
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
        default=300, ge=20, le=4000, description="Most BRIEF points for the dominant flow."
    )
    flow_max_shift_px: float = Field(
        default=180.0, gt=0.0, description="Longest displacement between matched BRIEF points, px."
    )
    prediction_weight: float = Field(
        default=1.0,
        ge=0.0,
        description="lambda of Eq. 5 as a multiple of the track's own last kappa.",
    )
    prediction_sigma_px: float = Field(default=3.0, gt=0.0, description="Scale of w in Eq. 5, px.")
    max_correction_px: float = Field(
        default=5.0, gt=0.0, description="Longest distance of an extremum from its prediction, px."
    )

    local_flow: bool = Field(
        default=True,
        description="Predict with a coarse-to-fine grid of local flow, not an affine alone.",
    )
    subpixel: bool = Field(default=True, description="Place extrema by a parabola, not on pixels.")
    patch_refinement: bool = Field(
        default=True,
        description="Refine by a small patch, which also carries a track through frames without "
        "an extremum.",
    )
    turn_patches: bool = Field(
        default=True,
        description="Turn and scale patches with the surface that they show.",
    )
    patch_iterations: int = Field(
        default=4, ge=1, le=20, description="Most Gauss-Newton steps of a patch in a frame."
    )
    min_zncc: float = Field(
        default=0.88,
        ge=-1.0,
        le=1.0,
        description="A patch that correlates less has lost its point.",
    )
    min_residual: float = Field(
        default=1.5,
        ge=0.0,
        description="RMS in grey levels under which ZNCC > min_zncc is not required.",
    )
    min_strength: float = Field(
        default=1.0,
        ge=0.0,
        description="Smaller eigenvalue of a patch's tensor per pixel, DN^2: births.",
    )
    min_isotropy: float = Field(
        default=0.05,
        ge=0.0,
        le=1.0,
        description="Smaller over larger eigenvalue of a patch's tensor: births.  A patch with "
        "less lies on a contour, and slides along it as the contour turns.",
    )
    fine_strength: float = Field(
        default=0.7,
        ge=0.0,
        description="Patches of less than this are taken at half size, to see twice as far, DN^2.",
    )
    extremum_gate_px: float = Field(
        default=1.0,
        gt=0.0,
        description="A patch that ends farther from its extremum coasts instead, px.",
    )
    coast_s: float = Field(
        default=0.68, ge=0.0, description="Most seconds in a row without an extremum."
    )
    coast_gate_px: float = Field(
        default=3.0,
        gt=0.0,
        description="A coasting patch that strays farther from the flow is lost, px.",
    )
    backward_gate_px: float = Field(
        default=0.7,
        gt=0.0,
        description="A coasting patch with a strength of 1 DN^2 must lead back this near to where "
        "it was, px; others by one over the root of their strength, 0.25 to 1 px.",
    )
