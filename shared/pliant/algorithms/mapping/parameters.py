"""Parameters of the mapper."""

from pydantic import Field

from pliant.algorithms.bundle.problem import BundleParameters, CalibrationUncertainty
from pliant.algorithms.parameters import Parameters


class StartParameters(Parameters):
    """How a map segment starts."""

    min_tracks: int = Field(
        default=100, ge=8, description="Tracks that two frames must share to start a map"
    )
    min_parallax_deg: float = Field(
        default=1.0, gt=0.0, description="Least median parallax of the two frames, degrees"
    )
    max_frames: int = Field(
        default=120, ge=2, description="Frames kept while waiting; older ones get no pose"
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
    max_lost_frames: int = Field(
        default=10, ge=0, description="Frames without a pose after which a new segment starts"
    )


class ReacquisitionParameters(Parameters):
    """How mapped points that lost their track are found again among the maxima of a frame."""

    enabled: bool = Field(default=True, description="Look for lost points in every frame")
    radius_px: float = Field(default=2.5, gt=0.0, description="Largest distance to a maximum, px")
    kappa_ratio: float = Field(
        default=2.0, ge=1.0, description="Largest ratio of the curvatures, either way"
    )
    min_zncc: float = Field(
        default=0.8,
        ge=-1.0,
        le=1.0,
        description="Least correlation of the 8x8 patches, where the image is at hand",
    )


class KeyframeParameters(Parameters):
    """When a frame becomes a keyframe."""

    min_shared_share: float = Field(
        default=0.7,
        ge=0.0,
        le=1.0,
        description="A keyframe is due when fewer than this share of the last one's points remain",
    )
    max_flow_px: float = Field(
        default=25.0,
        gt=0.0,
        description="A keyframe is due when the median point moved by this since the last, px "
        "at an image width of 640",
    )
    max_frames: int = Field(
        default=20, ge=1, description="A keyframe is due after this many frames with any motion"
    )
    min_flow_px: float = Field(
        default=3.0, gt=0.0, description="Motion under which no keyframe is made, px at 640"
    )


class WindowParameters(Parameters):
    """The keyframes under adjustment."""

    keyframes: int = Field(default=12, ge=3, description="Keyframes in the window")
    fixed: int = Field(default=2, ge=1, description="Oldest keyframes of the window that stay")
    points_per_keyframe: int = Field(
        default=400,
        ge=50,
        description="Points of each keyframe, the best observed, that an adjustment by Schur LM "
        "takes; the others follow alone",
    )
    keyframe_iterations: int = Field(
        default=4, ge=1, description="Iterations of Schur LM at a keyframe"
    )
    sweeps: int = Field(
        default=2,
        ge=0,
        description="Subspace Gauss-Newton sweeps on every frame, over its pose and the points "
        "that it sees; 0 means none",
    )
    lens_radius: float = Field(
        default=0.25,
        gt=0.0,
        description="Distance from the optical axis, on the plane z = 1, at which an observation "
        "counts half: calibrations are worst at the border",
    )
    outlier_px: float = Field(
        default=2.5, gt=0.0, description="Observations with a larger error are removed, px"
    )
    final_adjustment: bool = Field(
        default=True, description="Adjust all keyframes of a segment when the stream ends"
    )
    final_iterations: int = Field(
        default=50, ge=1, description="Most iterations of Schur LM at the end of the stream"
    )
    final_points_per_keyframe: int = Field(
        default=1200, ge=50, description="As points_per_keyframe, at the end of the stream"
    )
    final_max_keyframes: int = Field(
        default=1000, ge=3, description="Keyframes above which the final adjustment is left out"
    )
    kept_keyframes: int = Field(
        default=1000,
        ge=30,
        description="Keyframes to come back to: beyond (and beyond final_max_keyframes) those most "
        "like another leave the active map, which bounds its memory; they stay in the results",
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
    keyframe: KeyframeParameters = KeyframeParameters()
    window: WindowParameters = WindowParameters()
    point: PointParameters = PointParameters()
    bundle: BundleParameters = BundleParameters(kernel_sigma_px=1.0)
    calibration: CalibrationUncertainty = CalibrationUncertainty()
    snapshot_frames: int = Field(
        default=100,
        ge=1,
        description="Frames between two snapshots: everything active, for who came late",
    )
