"""Parameters of the deforming surfels.

DSDT leaves the saturation threshold, the schedule of lambda, omega_E, omega_I and Sigma open.
``docs/surfels.md`` says how the values here were chosen.
"""

from typing import Literal

from pydantic import Field

from pliant.algorithms.parameters import Parameters


class SurfelParameters(Parameters):
    """What a user may change about surfels.  Lengths are pixels of the full-size image."""

    camera: Literal["static", "moving", "static_map"] = Field(
        default="static",
        description="static: section IV, and the paper's DSDT-SC on a moving camera; moving: "
        "section V; static_map: only the camera moves, the paper's DSDT-SM.",
    )
    model: Literal["isometric", "conformal", "equiareal", "general"] = Field(
        default="isometric", description="Deformation of a surfel's own plane (Table I)."
    )
    omega_i: float = Field(
        default=1e6,
        ge=0.0,
        description="omega_I of Eq. 13, DN^2: pull of F towards I (soft isometry).  A patch of "
        "23 px holds it at its shape by 1e5 to 1e7 DN^2 of its own.  No effect when isometric.",
    )

    illumination: Literal["both", "bias", "none"] = Field(
        default="both",
        description="What follows the light in each surfel and frame: gain and bias of Eq. 5, the "
        "bias alone, or nothing, as if the light never changed.",
    )

    omega_e: float = Field(
        default=25.0,
        gt=0.0,
        description="omega_E of Eq. 21, DN^2: the variance of a residual that is as likely as a "
        "surfel one Sigma off its equilibrium.",
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
        description="Neighbours on the same surface that a surfel holds on to (not in the paper); "
        "0: the paper's surfels, each on its own.",
    )
    strain: float = Field(
        default=0.02,
        gt=0.0,
        description="Relative change of the distance of neighbours that is as likely as a residual "
        "of root omega_E.  Less is a stiffer surface.",
    )
    bend: float = Field(
        default=0.3, gt=0.0, description="The same for the angle between neighbours, rad."
    )
    tear: float = Field(
        default=0.3,
        gt=0.0,
        description="Strain at which neighbours hold on by a quarter only: what tears or slides.",
    )
    off_plane: float = Field(
        default=0.3,
        gt=0.0,
        description="Neighbours are off each other's plane by at most this share of the distance.",
    )
    together_steps: int = Field(
        default=3, ge=1, description="Steps of all surfels together at full size."
    )
    coarse_together_steps: int = Field(
        default=2, ge=0, description="The same at half the size, with a camera that stands still."
    )

    depth_from: Literal["sensor", "map", "flat"] = Field(
        default="sensor",
        description="Where surfels start: sensor: depth maps that come with the images.  map: our "
        "own map of a scene that holds nearly still at first, seen by a camera that moves.  flat: "
        "a plane in front of the camera, one unit away; then only motion in the image is right.",
    )
    map_keyframes: int = Field(
        default=5, ge=2, description="Keyframes that our own map has before surfels start on it."
    )
    map_sigma: float = Field(
        default=0.01,
        gt=0.0,
        description="Points of our own map count whose depth is known to this share of itself, for "
        "half a pixel of noise.",
    )
    map_points: int = Field(
        default=200, ge=3, description="Such points in the keyframe on which surfels start."
    )
    map_births: bool = Field(
        default=True,
        description="Surfels are born later, too, on keyframes of our own map that they agree "
        "with; no: only those of the start.",
    )
    map_birth_sigma: float = Field(
        default=0.005,
        gt=0.0,
        description="As map_sigma, for those births: new surface has been seen for a short while.",
    )
    map_surfels: int = Field(
        default=30,
        ge=1,
        description="Surfels that agree with a later keyframe's depth, so that others are born on "
        "it; and half of those that it shows.",
    )
    map_disagreement: float = Field(
        default=0.02,
        gt=0.0,
        description="A surfel disagrees whose depth is off the keyframe's by more than this share, "
        "after the median.  Nothing is born where most surfels do.",
    )
    prediction: Literal["auto", "none", "tracks"] = Field(
        default="auto",
        description="tracks: each surfel starts where the extrema about it went, and else where "
        "the dominant flow leads (not in the paper; the tracking service runs, too).  auto: where "
        "the tracking service runs anyway.",
    )

    max_surfels: int = Field(default=500, ge=1, le=20_000, description="Most surfels at a time.")
    patch_px: int = Field(
        default=23,
        ge=7,
        le=63,
        description="Side of a surfel's patch, px of each pyramid level, odd.",
    )
    sparse_stride_px: int = Field(
        default=2,
        ge=1,
        le=4,
        description="Distance of a patch's samples at every second level, from the second on, px "
        "of the level; at the others it is one pixel.",
    )
    levels: int = Field(default=4, ge=1, le=6, description="Levels of the pyramid.")
    spacing_px: int = Field(
        default=7, ge=1, description="Non-maximum suppression of corners and room of a surfel, px."
    )
    corner_window_px: int = Field(
        default=7, ge=3, description="Window of the corners' structure tensor, px, odd."
    )
    min_strength: float = Field(
        default=4.0,
        ge=0.0,
        description="Least smaller eigenvalue of a corner's structure tensor, DN^2 per px^2.",
    )
    tangent_px: int = Field(
        default=23, ge=5, description="Window in which depth is fitted for the tangents, px, odd."
    )
    depth_jump: float = Field(
        default=0.08, gt=0.0, description="Relative step of depth that is another surface."
    )
    depth_noise: float = Field(
        default=5e-4, ge=0.0, description="Relative noise that no depth is expected to be below."
    )
    max_depth_residual: float = Field(
        default=0.005, gt=0.0, description="Most rms of the tangent's fit, relative to depth."
    )
    min_depth_share: float = Field(
        default=0.5, gt=0.0, le=1.0, description="Least share of the window that has that surface."
    )
    max_slope: float = Field(
        default=4.0,
        gt=0.0,
        description="Steepest surface at birth: relative change of depth per unit of normalised "
        "coordinate.",
    )
    max_off_plane: float = Field(
        default=0.03,
        gt=0.0,
        description="Pixels whose depth is missing, or off a new surfel's plane by more than this "
        "share, are no part of its texture.",
    )
    min_template: float = Field(
        default=0.6,
        gt=0.0,
        le=1.0,
        description="Least share of a patch inside of the image and on the surfel's plane.",
    )

    jacobian: Literal["template", "both", "frame"] = Field(
        default="both",
        description="Derivatives of Eq. 5 from the frame's patch (forward, as the paper), or from "
        "the texture: faster, converges less often.  both: at the coarse scales of a static camera "
        "their mean, which converges most often, otherwise the frame's.",
    )
    stale_px: float = Field(
        default=0.3,
        ge=0.0,
        description="The sums of products of the derivatives are kept until a surfel has moved as "
        "far as this.  They shape the steps, and not where they end.",
    )
    saturation: float = Field(
        default=40.0, gt=0.0, description="A residual beyond this counts as this, DN."
    )
    highlight: float = Field(
        default=250.0, gt=0.0, description="Brighter pixels are highlights and do not count, DN."
    )
    first_lambda: float = Field(
        default=1.0, ge=0.0, description="lambda is at least this in the first steps of a level."
    )
    damped_steps: int = Field(
        default=1, ge=0, description="How many accepted steps of a level are the first ones."
    )
    start_lambda: float = Field(
        default=0.01, gt=0.0, description="lambda that a level starts with."
    )
    lambda_down: float = Field(default=10.0, gt=1.0, description="Divides lambda after a success.")
    lambda_up: float = Field(default=4.0, gt=1.0, description="Multiplies lambda after a failure.")
    coarse_iterations: int = Field(default=6, ge=1, description="Most steps, but at full size.")
    fine_iterations: int = Field(default=10, ge=1, description="Most steps at full size.")
    coarse_step_px: float = Field(
        default=0.05, gt=0.0, description="A step that moves no corner farther ends a level, px."
    )
    fine_step_px: float = Field(default=0.01, gt=0.0, description="The same at full size, px.")

    slack: float = Field(
        default=0.1,
        ge=0.0,
        description="A step that raises the cost by less than this share counts as a success: "
        "noise that interpolation smooths more or less moves the cost by as much.",
    )

    min_zncc: float = Field(
        default=0.85,
        ge=-1.0,
        le=1.0,
        description="A surfel that correlates less is an outlier (paper: 0.95 for the Kinect "
        "sequences, 0.85 in the body).",
    )
    min_visible: float = Field(
        default=0.5, ge=0.0, le=1.0, description="With less of its patch seen it is occluded."
    )
    lost_after: int = Field(
        default=15, ge=1, description="Frames in a row without success until a surfel is lost."
    )
    forget_after: int = Field(
        default=150, ge=1, description="Frames lost until a surfel is given up for a new one."
    )
    min_alive: int = Field(
        default=8, ge=1, description="With fewer surfels tracked, tracking as a whole is lost."
    )
