"""Parameters of the deforming surfels.

DSDT leaves the saturation threshold, the schedule of lambda, omega_E and Sigma open.  Values that
users should not need to change are constants in the code; ``docs/surfels.md`` explains all of them.
"""

from typing import Literal

from pydantic import Field

from pliant.algorithms.parameters import Parameters


class SurfelParameters(Parameters):
    """Parameters of surfels.  Lengths are pixels of the full-size image."""

    camera: Literal["static", "moving"] = Field(
        default="static",
        description="static: section IV, and the paper's DSDT-SC on a moving camera; moving: "
        "section V.",
    )
    model: Literal["isometric", "equiareal", "general"] = Field(
        default="isometric",
        description="Deformation of a surfel's own plane (Table I).  isometric: paper, cloth and "
        "what hardly stretches; equiareal, general: what stretches.",
    )
    light: Literal["any", "camera", "camera-fixed"] = Field(
        default="any",
        description="camera: the only lamp is at the camera, as an endoscope's, and brightness "
        "tells a stretch from an approach (model does not count).  camera-fixed: its exposure is "
        "fixed, too, which tells more.  any: brightness tells nothing.",
    )
    expected_motion: float = Field(
        default=0.02,
        gt=0.0,
        description="Root of the heuristic covariance Sigma of Eq. 20, as a share of a surfel's "
        "depth at birth.  Less is a more rigid scene.",
    )
    neighbours: int = Field(
        default=8,
        ge=0,
        le=32,
        description="Neighbours on the same surface that a surfel is joined to (not in the "
        "paper); 0: the paper's surfels, each on its own.",
    )
    strain: float = Field(
        default=0.02,
        gt=0.0,
        description=(
            "Relative change of the distance between neighbours that costs as much as a "
            "residual of 5 DN.  Smaller values make the surface stiffer."
        ),
    )
    bend: float = Field(
        default=0.3,
        gt=0.0,
        description="The same for the angle between neighbours, rad; a third of it on made-up "
        "depth (flat).",
    )

    depth_from: Literal["sensor", "map", "flat"] = Field(
        default="sensor",
        description=(
            "Initial depth: sensor: depth maps that come with the images.  map: Pliant's own "
            "map of a scene that is nearly static at first, with a moving camera.  flat: a "
            "plane in front of the camera, one unit away; then only motion in the image is "
            "valid."
        ),
    )
    map_keyframes: int = Field(
        default=5, ge=2, description="Keyframes of Pliant's own map before surfels start on it."
    )
    map_sigma: float = Field(
        default=0.01,
        gt=0.0,
        description=(
            "Maximum relative depth sigma of the map points that are used, for half a pixel "
            "of noise."
        ),
    )
    map_points: int = Field(
        default=200,
        ge=3,
        description="Minimum number of such points in the keyframe on which surfels start.",
    )
    map_birth_sigma: float = Field(
        default=0.005,
        gt=0.0,
        description=(
            "The same maximum for surfels that are created later, on surface that was "
            "observed for a short time."
        ),
    )

    max_surfels: int = Field(default=500, ge=1, le=20_000, description="Maximum number of surfels.")
    patch_px: int = Field(
        default=23,
        ge=7,
        le=63,
        description="Side of a surfel's patch, px of each pyramid level, odd.",
    )
    levels: int = Field(default=4, ge=1, le=6, description="Levels of the pyramid.")
    spacing_px: int = Field(
        default=7, ge=1, description="Minimum distance between corners and between surfels, px."
    )
    min_strength: float = Field(
        default=4.0,
        ge=0.0,
        description="Minimum smaller eigenvalue of a corner's structure tensor, DN^2 per px^2.",
    )
    max_depth_residual: float = Field(
        default=0.005,
        gt=0.0,
        description="Maximum rms residual of a surfel's tangent plane, relative to depth.",
    )
    highlight: float = Field(
        default=250.0,
        gt=0.0,
        description="Pixels brighter than this are highlights and do not count, DN.",
    )

    min_zncc: float = Field(
        default=0.85,
        ge=-1.0,
        le=1.0,
        description=(
            "Minimum ZNCC of a tracked surfel; below it is an outlier (paper: 0.95 for the "
            "Kinect sequences, 0.85 in the body)."
        ),
    )
    min_visible: float = Field(
        default=0.5,
        ge=0.0,
        le=1.0,
        description="Minimum visible share of its patch; below it is occluded.",
    )
    lost_after_s: float = Field(
        default=0.52, ge=0.0, description="Seconds without tracking after which a surfel is lost."
    )
    forget_after_s: float = Field(
        default=4.99, ge=0.0, description="Seconds after which a lost surfel is removed."
    )
    min_alive: int = Field(
        default=8,
        ge=1,
        description="Minimum tracked surfels; with fewer, tracking as a whole is lost.",
    )
