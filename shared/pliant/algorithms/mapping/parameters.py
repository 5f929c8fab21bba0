"""Parameters of the mapper."""

from pydantic import Field

from pliant.algorithms.bundle.problem import BundleParameters, CalibrationUncertainty
from pliant.algorithms.parameters import Parameters


class StartParameters(Parameters):
    """How a map segment starts."""

    min_tracks: int = Field(
        default=100, ge=8, description="Tracks that two frames must share to start a map"
    )
    parallax_deg: float = Field(
        default=3.0, gt=0.0, description="Median parallax of two frames to start with, degrees"
    )
    patient_s: float = Field(
        default=0.5, ge=0.0, description="Seconds after which min_parallax_deg is enough"
    )
    min_parallax_deg: float = Field(
        default=1.0, gt=0.0, description="Least median parallax of the two frames, degrees"
    )
    long_s: float = Field(
        default=2.0,
        ge=0.0,
        description="Seconds after which it is enough that a quarter of the tracks has it",
    )
    max_s: float = Field(
        default=4.0, gt=0.0, description="Seconds that frames wait; older ones get no pose"
    )
    min_points: int = Field(
        default=100, ge=30, description="Points that a start must have after adjustment"
    )
    max_median_error_px: float = Field(
        default=1.0, gt=0.0, description="Largest median reprojection error of a start, px"
    )
    epipolar_gate_px: float = Field(
        default=1.0, gt=0.0, description="Largest epipolar error of an inlier, px"
    )
    min_inlier_share: float = Field(
        default=0.5, gt=0.0, le=1.0, description="Least share of shared tracks that must agree"
    )
    keyframes: int = Field(
        default=6, ge=3, description="Keyframes spread over the frames of the start"
    )


class LocalisationParameters(Parameters):
    """How the pose of a new frame is found."""

    min_inliers: int = Field(
        default=30, ge=6, description="Inliers without which a frame has no pose"
    )
    inlier_px: float = Field(
        default=1.5, gt=0.0, description="Largest reprojection error of an inlier, px"
    )
    kernel_sigma_px: float = Field(
        default=2.0, gt=0.0, description="Scale of the Geman-McClure kernel of the pose, px"
    )
    ransac_gate_px: float = Field(
        default=4.0, gt=0.0, description="Largest error of an inlier of P3P and RANSAC, px"
    )
    ransac_samples: int = Field(default=100, ge=1, description="Triples tried by RANSAC")
    min_predicted_share: float = Field(
        default=0.5,
        ge=0.0,
        le=1.0,
        description="Share of inliers under which the predicted pose is checked against RANSAC",
    )
    max_lost_s: float = Field(
        default=1.0, ge=0.0, description="Seconds without a pose after which a new segment starts"
    )


class ReacquisitionParameters(Parameters):
    """How mapped points that lost their track are found again among the maxima of a frame."""

    enabled: bool = Field(default=True, description="Look for lost points in every frame")
    radius_px: float = Field(default=2.5, gt=0.0, description="Largest distance to a maximum, px")
    min_zncc: float = Field(
        default=0.8,
        ge=-1.0,
        le=1.0,
        description="Least correlation of the 8x8 patches, where the image is at hand, and of "
        "points by which two keyframes show one place",
    )


class RecoveryParameters(Parameters):
    """How the camera is found again after frames without a pose."""

    points: int = Field(
        default=400, ge=30, description="Points looked for far from where they were"
    )
    radius_share: float = Field(
        default=0.01,
        gt=0.0,
        description="Radius about the prediction, share of the image width, when nothing was lost",
    )
    growth_share_per_s: float = Field(
        default=0.3, ge=0.0, description="What a second without a pose adds to the radius"
    )
    max_radius_share: float = Field(
        default=0.15, gt=0.0, le=1.0, description="Largest radius, share of the image width"
    )
    ransac_samples: int = Field(default=500, ge=1, description="Triples tried by RANSAC")
    min_agreeing: int = Field(
        default=15,
        ge=6,
        description="Points that must agree for a pose to be looked at more closely",
    )
    min_support_share: float = Field(
        default=0.015,
        ge=0.0,
        le=1.0,
        description="Least share of the points in view that support a pose: wrong ones reach 1 %",
    )
    min_agreement: float = Field(
        default=0.6,
        ge=0.0,
        le=1.0,
        description="Least share of the points found at a pose that support it: wrong ones reach "
        "half, for what is found is near",
    )


class SupportParameters(Parameters):
    """When a pose is published as doubtful."""

    settled_s: float = Field(
        default=0.5,
        ge=0.0,
        description="Age at which a track that enough keyframes saw should belong to a point, "
        "seconds",
    )
    max_contrary_share: float = Field(
        default=0.12,
        ge=0.0,
        le=1.0,
        description="Share of the image that moves otherwise than the pose says",
    )
    min_share: float = Field(
        default=0.4, ge=0.0, le=1.0, description="Share of the points seen that fit the pose"
    )
    min_spread: float = Field(
        default=0.06,
        ge=0.0,
        le=1.0,
        description="Standard deviation of what fits, share of the image's width or height",
    )


class KeyframeParameters(Parameters):
    """When a frame becomes a keyframe."""

    min_shared_share: float = Field(
        default=0.6,
        ge=0.0,
        le=1.0,
        description="A keyframe is due when fewer than this share of the last one's points would "
        "remain in the next frame",
    )
    min_tracked_share: float = Field(
        default=0.35,
        ge=0.0,
        le=1.0,
        description="The same where the camera has hardly moved: while min_shared_share is in "
        "view, tracks that noise has ended are no reason for a keyframe",
    )
    telling_flow_px: float = Field(
        default=8.0,
        gt=0.0,
        description="The camera has hardly moved when the median point moved by less since the "
        "last keyframe, beside the turn of the camera, px at 640x480",
    )
    max_flow_px: float = Field(
        default=20.0,
        gt=0.0,
        description="A keyframe is due when the median point moved by this since the last, beside "
        "the turn of the camera, px at 640x480",
    )
    max_s: float = Field(
        default=0.65,
        gt=0.0,
        description="A keyframe is due after this many seconds with any motion",
    )
    min_flow_px: float = Field(
        default=3.0, gt=0.0, description="Motion under which no keyframe is made, px at 640x480"
    )


class WindowParameters(Parameters):
    """The keyframes under adjustment."""

    keyframes: int = Field(default=20, ge=3, description="Keyframes in the window")
    fixed: int = Field(
        default=6, ge=1, description="Older keyframes that see the most of the same: they stay"
    )
    keyframe_iterations: int = Field(
        default=2, ge=1, description="Most iterations of Schur LM at a keyframe"
    )
    sweeps: int = Field(
        default=2,
        ge=0,
        description="Subspace Gauss-Newton sweeps on every frame, over its pose and the points "
        "that it sees; 0 means none",
    )
    outlier_px: float = Field(
        default=2.5, gt=0.0, description="Observations with a larger error are removed, px"
    )
    final_adjustment: bool = Field(
        default=True, description="Adjust all keyframes of a segment when the stream ends"
    )
    final_iterations: int = Field(
        default=30, ge=1, description="Most iterations of Schur LM at the end of the stream"
    )
    kept_observations: int = Field(
        default=6_000_000,
        ge=1000,
        description="Observations that the adjustments of the whole map have room for, some 200 "
        "bytes each: beyond, points that few keyframes see hang on a keyframe, as they were found",
    )
    kept_neighbours: int = Field(
        default=300,
        ge=10,
        description="Keyframes with which one may share points, in the mean of the squares: an "
        "adjustment takes time by that mean, and beyond it keyframes hang on another one",
    )
    kept_per_keyframe: int = Field(
        default=150,
        ge=1,
        description="Observations that a keyframe keeps of these: where there would be less, "
        "keyframes hang on another one that sees the same points",
    )


class WholeMapParameters(Parameters):
    """Adjustments of the whole map while it grows."""

    growth: float = Field(
        default=0.2,
        ge=0.0,
        description="Share by which the keyframes of a segment grow from one adjustment of all of "
        "them to the next; 0: only at the end",
    )
    distance_frames: int = Field(
        default=30,
        ge=1,
        description="Frames after which the result is taken over, or more of a large map; who has "
        "not found it waits",
    )
    observations_per_frame: int = Field(
        default=8000,
        ge=1,
        description="Observations for which that is a frame at least: it takes 4 to 6 us of one "
        "core for each of them, so 32 to 48 ms a frame",
    )
    points_per_keyframe: int = Field(
        default=1000,
        ge=100,
        description="Points of each keyframe in it, those that most keyframes see: they tell as "
        "much of poses and lens as all of them",
    )
    iterations: int = Field(
        default=12, ge=1, description="Most iterations of Schur LM; the next adjustment goes on"
    )


class PointParameters(Parameters):
    """When a tracked candidate becomes a point of the map."""

    min_parallax_deg: float = Field(
        default=1.0, gt=0.0, description="Least angle between two of its rays, degrees"
    )
    max_error_px: float = Field(
        default=1.5, gt=0.0, description="Largest reprojection error in any frame, px"
    )
    min_observations: int = Field(
        default=3, ge=2, description="Keyframes and current frame that must observe it"
    )


class MappingParameters(Parameters):
    """Everything that the mapper needs to know."""

    start: StartParameters = StartParameters()
    localisation: LocalisationParameters = LocalisationParameters()
    reacquisition: ReacquisitionParameters = ReacquisitionParameters()
    recovery: RecoveryParameters = RecoveryParameters()
    support: SupportParameters = SupportParameters()
    keyframe: KeyframeParameters = KeyframeParameters()
    window: WindowParameters = WindowParameters()
    whole_map: WholeMapParameters = WholeMapParameters()
    point: PointParameters = PointParameters()
    bundle: BundleParameters = BundleParameters(kernel_sigma_px=1.0)
    calibration: CalibrationUncertainty = CalibrationUncertainty()
    only_localise: bool = Field(
        default=False,
        description="Find frames in a map of earlier sessions, and map nothing (run --localise)",
    )
    snapshot_frames: int = Field(
        default=100,
        ge=1,
        description="Frames between two snapshots: everything active, for who came late",
    )
