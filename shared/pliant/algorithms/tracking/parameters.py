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
    min_zncc: float = Field(
        default=0.88,
        ge=-1.0,
        le=1.0,
        description="Minimum ZNCC of a patch; below it the track is lost.",
    )
    min_strength: float = Field(
        default=1.0,
        ge=0.0,
        description="Minimum smaller eigenvalue of a new patch's structure tensor per pixel, DN^2.",
    )
    fine_strength: float = Field(
        default=0.7,
        ge=0.0,
        description="Patches weaker than this are taken at half size, with twice the extent, DN^2.",
    )
    coast_s: float = Field(
        default=0.68, ge=0.0, description="Maximum consecutive seconds without an extremum."
    )
