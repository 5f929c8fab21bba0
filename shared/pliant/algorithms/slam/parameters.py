"""Parameters of the mapper."""

from pydantic import Field

from pliant.algorithms.parameters import Parameters
from pliant.algorithms.slam.estimate.problem import BundleParameters, CalibrationUncertainty


class StartParameters(Parameters):
    """How a map segment starts."""

    min_tracks: int = Field(
        default=100, ge=8, description="Minimum tracks that two frames share to start a map"
    )
    parallax_deg: float = Field(
        default=3.0,
        gt=0.0,
        description="Median parallax between the two frames of a start, degrees",
    )
    patient_s: float = Field(
        default=0.5, ge=0.0, description="Seconds after which min_parallax_deg is sufficient"
    )
    min_parallax_deg: float = Field(
        default=1.0,
        gt=0.0,
        description="Minimum median parallax between the two frames of a start, degrees",
    )
    long_s: float = Field(
        default=2.0,
        ge=0.0,
        description=(
            "Seconds after which the upper quartile of the parallax counts instead of the median"
        ),
    )
    max_s: float = Field(
        default=4.0,
        gt=0.0,
        description="Maximum seconds that frames wait for a start; older ones get no pose",
    )
    min_points: int = Field(
        default=100, ge=30, description="Minimum landmarks of a start after its adjustment"
    )
    keyframes: int = Field(
        default=6, ge=3, description="Keyframes, evenly spread over the frames of a start"
    )


class LocalisationParameters(Parameters):
    """How the pose of a new frame is estimated."""

    min_inliers: int = Field(default=30, ge=6, description="Minimum inliers of a pose")
    inlier_px: float = Field(
        default=1.5, gt=0.0, description="Maximum reprojection error of an inlier, px"
    )
    max_lost_s: float = Field(
        default=1.0, ge=0.0, description="Seconds without a pose before a new segment starts"
    )


class ReacquisitionParameters(Parameters):
    """How landmarks that lost their track are reacquired at the maxima of a frame."""

    radius_px: float = Field(
        default=2.5,
        gt=0.0,
        description="Maximum distance between a projected landmark and a maximum, px",
    )
    min_zncc: float = Field(
        default=0.8,
        ge=-1.0,
        le=1.0,
        description=(
            "Minimum ZNCC of the 8x8 patches, for reacquisition and for matches between places"
        ),
    )


class KeyframeParameters(Parameters):
    """When a frame becomes a keyframe."""

    min_shared_share: float = Field(
        default=0.6,
        ge=0.0,
        le=1.0,
        description=(
            "A keyframe is due when fewer than this share of the last keyframe's landmarks "
            "would remain in the next frame"
        ),
    )
    min_tracked_share: float = Field(
        default=0.35,
        ge=0.0,
        le=1.0,
        description=(
            "The same share while the camera has hardly moved: tracks that noise ended count "
            "only below it"
        ),
    )
    moved_flow_px: float = Field(
        default=8.0,
        gt=0.0,
        description=(
            "The camera has hardly moved while the median landmark has moved by less than "
            "this since the last keyframe, without the rotation, px at 640x480"
        ),
    )
    max_flow_px: float = Field(
        default=20.0,
        gt=0.0,
        description=(
            "A keyframe is due when the median landmark has moved by this since the last "
            "keyframe, without the rotation, px at 640x480"
        ),
    )
    max_s: float = Field(
        default=0.65,
        gt=0.0,
        description="A keyframe is due after this many seconds with any motion",
    )
    min_flow_px: float = Field(
        default=3.0, gt=0.0, description="Minimum motion for a keyframe, px at 640x480"
    )


class WindowParameters(Parameters):
    """The keyframes under adjustment."""

    keyframes: int = Field(default=20, ge=3, description="Keyframes in the window")
    fixed: int = Field(
        default=6,
        ge=1,
        description="Older keyframes with the largest covisibility; their poses are fixed",
    )
    keyframe_iterations: int = Field(
        default=2, ge=1, description="Maximum Schur LM iterations at a keyframe"
    )
    sweeps: int = Field(
        default=2,
        ge=0,
        description=(
            "Subspace Gauss-Newton sweeps on every frame, over its pose and its landmarks; 0: none"
        ),
    )
    outlier_px: float = Field(
        default=2.5,
        gt=0.0,
        description="Observations with a larger reprojection error are removed, px",
    )
    final_iterations: int = Field(
        default=30, ge=1, description="Maximum Schur LM iterations when the stream ends"
    )
    kept_observations: int = Field(
        default=6_000_000,
        ge=1000,
        description=(
            "Maximum observations in global bundle adjustments, some 200 bytes each. Beyond, "
            "landmarks of few keyframes are fixed relative to a reference keyframe"
        ),
    )
    kept_neighbours: int = Field(
        default=300,
        ge=10,
        description=(
            "Maximum root mean square number of covisible keyframes, which determines the "
            "time of an adjustment. Beyond, keyframes are fixed relative to another one"
        ),
    )
    kept_per_keyframe: int = Field(
        default=150,
        ge=1,
        description=(
            "Minimum observations of a keyframe in global bundle adjustments. With fewer, it "
            "is fixed relative to a keyframe with the same landmarks"
        ),
    )


class WholeMapParameters(Parameters):
    """Global bundle adjustments while the map grows."""

    growth: float = Field(
        default=0.2,
        ge=0.0,
        description=(
            "Growth of a segment, as a share of its keyframes, between two global bundle "
            "adjustments; 0: only at the end"
        ),
    )
    distance_frames: int = Field(
        default=30,
        ge=1,
        description=(
            "Frames after which a result is applied, more for a large map. An adjustment that"
            " has not finished makes the mapper wait"
        ),
    )
    observations_per_frame: int = Field(
        default=8000,
        ge=1,
        description=(
            "Observations per frame of this distance: each takes 4 to 6 us of one core, so 32"
            " to 48 ms per frame"
        ),
    )
    points_per_keyframe: int = Field(
        default=1000,
        ge=100,
        description=(
            "Landmarks of each keyframe, those with the most observations: they determine "
            "poses and calibration as well as all"
        ),
    )
    iterations: int = Field(
        default=12, ge=1, description="Maximum Schur LM iterations; the next adjustment continues"
    )


class PointParameters(Parameters):
    """When a candidate becomes a landmark."""

    min_parallax_deg: float = Field(
        default=1.0, gt=0.0, description="Minimum angle between two of its rays, degrees"
    )
    max_error_px: float = Field(
        default=1.5, gt=0.0, description="Maximum reprojection error in any frame, px"
    )
    min_observations: int = Field(
        default=3,
        ge=2,
        description="Minimum observations, keyframes and the current frame together",
    )


class MappingParameters(Parameters):
    """All parameters of the mapper."""

    start: StartParameters = StartParameters()
    localisation: LocalisationParameters = LocalisationParameters()
    reacquisition: ReacquisitionParameters = ReacquisitionParameters()
    keyframe: KeyframeParameters = KeyframeParameters()
    window: WindowParameters = WindowParameters()
    whole_map: WholeMapParameters = WholeMapParameters()
    point: PointParameters = PointParameters()
    bundle: BundleParameters = BundleParameters(kernel_sigma_px=1.0)
    calibration: CalibrationUncertainty = CalibrationUncertainty()
    only_localise: bool = Field(
        default=False,
        description="Localise frames in a saved map without mapping (run --localise)",
    )
    snapshot_frames: int = Field(
        default=100,
        ge=1,
        description="Frames between two snapshots of the active map, for late readers",
    )
