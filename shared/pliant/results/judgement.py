"""The verdict on a run without ground truth: good, doubtful or bad."""

from collections.abc import Sequence

from pliant.algorithms.map_delta import TRACKING
from pliant.map_history import MapHistory
from pliant.messages.types import PASSED_OVER

GOOD, DOUBTFUL, BAD = "good", "doubtful", "bad"

_WHOLE = 0.9
"""Share of the frames with a pose in one segment that a good run has."""
_LITTLE = 0.5
"""With a smaller one a run is bad."""
DOUBTS = 0.25
"""Share of doubtful poses above which a run is.  Good sequences have up to a sixth."""

_FOLLOWED = 0.75
"""Share of the surfels in view that are tracked in a good frame, and probably right.  In sequences
with ground truth that are tracked well, nine tenths of the frames have 0.84 and more tracked
(cloth, sliding sheets, breathing tissue behind an instrument).  With an instrument that pulls
tissue, half of them have 0.67."""


def doubtful_frames(history: MapHistory) -> list[int]:
    """Return the frames whose pose is flagged as doubtful."""
    return [
        frame
        for frame, (state, reason) in sorted(history.states.items())
        if state == TRACKING and reason not in ("", PASSED_OVER) and frame in history.frames
    ]


def judge(
    *, frames: int, in_segments: list[int], doubtful: int, broken: int = 0, absent: int = 0,
    behind: int = 0, by_gyro: int = 0, calibration: str = "", focal: str = "", failed: bool = False,
) -> tuple[str, str]:  # fmt: skip
    """Return good, doubtful or bad, and the reasons.

    frames: all, except those that a mask covers.   in_segments: poses in each segment of the map.
    doubtful: poses with that flag.   broken: frames that do not decode or have a wrong time.
    absent: announced frames of the source that never came.   behind: frames without a pose for lack
    of time.
    by_gyro: frames that no image places, but the gyro between others.
    calibration: why it bends the map; "" if it does not.   focal: how the focal length changes
    during the clip; "" if it does not.   failed: the source broke off.

    All of them are frames of the source: they count as frames without a pose.
    """
    longest, posed = max(in_segments, default=0), sum(in_segments)
    if not longest:
        return BAD, "there is no map"
    of_source = max(frames + absent, 1)
    share = longest / of_source
    which = "frames of the source" if broken or absent else "frames"
    text = f"{share:.0%} of the {which} have a pose in the largest segment"
    text += f", {by_gyro} are placed by the gyro alone" if by_gyro else ""
    if longest < _LITTLE * (of_source - behind):
        return BAD, text
    if share < _WHOLE and 2 * behind > of_source - longest:
        return DOUBTFUL, (
            f"{text}: the computer was too slow for {behind / of_source:.0%}; use smaller images "
            "(--max-size) or fewer tracks (--light)"
        )
    if focal:
        return DOUBTFUL, focal
    if doubtful > DOUBTS * posed:
        return DOUBTFUL, (
            f"{doubtful / posed:.0%} of the poses are doubtful: something large moves, or the "
            "scene deforms (then use --profile deformable)"
        )
    if absent > (1.0 - _WHOLE) * of_source:
        came = 1.0 - absent / of_source
        return DOUBTFUL, f"only {came:.0%} of the source's frames arrived"
    if broken > (1.0 - _WHOLE) * frames:
        return DOUBTFUL, f"{broken / frames:.0%} of the images are broken"
    if share < _WHOLE:
        return DOUBTFUL, text
    if failed:
        return DOUBTFUL, "the source ended early"
    if calibration:
        return DOUBTFUL, calibration
    return GOOD, text if longest < of_source else "all frames have a pose in one segment"


def slipping_frames(tracked: Sequence[float], in_view: Sequence[int]) -> list[int]:
    """Rows of frames in which few of the surfels in view are tracked.

    tracked: their count, or the sum of their confidences.
    """
    counts = enumerate(zip(tracked, in_view, strict=True))
    return [row for row, (few, seen) in counts if few < _FOLLOWED * seen]


def judge_surfels(
    *, frames: int, in_segments: list[int], slipping: int, depth_from: str, unusable: int,
    unsure: int = 0, together: int = 0, contradicted: int = 0, map_problem: str = "",
    broken: int = 0, absent: int = 0, behind: int = 0, failed: bool = False,
) -> tuple[str, str]:  # fmt: skip
    """As ``judge``, of a surface that deforms.

    in_segments: frames in which the surfels of each start were followed.   slipping: those of them
    in which few of the surfels in view are.   unsure: those in which few are right, counted by
    their confidences.   unusable: depth maps that no surfel could start on.
    together: frames of a camera configured as static in which all surfels move together.
    contradicted: frames whose depth map is not that of most surfels.   map_problem: why the tracks
    of the whole run do not determine camera and depths; "" without evidence of that.
    """
    word, why = judge(
        frames=frames, in_segments=in_segments, doubtful=0, broken=broken,
        absent=absent, behind=behind, failed=failed,
    )  # fmt: skip
    posed = sum(in_segments)
    if not posed:
        return BAD, "no surfels were tracked"
    if word == BAD:
        return word, why
    if slipping > DOUBTS * posed:
        return DOUBTFUL, (
            f"in {slipping / posed:.0%} of the frames less than {_FOLLOWED:.0%} of the surfels in "
            "view are tracked: something covers them, or moves too fast"
        )
    if unsure > DOUBTS * posed:
        return DOUBTFUL, (
            f"in {unsure / posed:.0%} of the frames less than {_FOLLOWED:.0%} of the surfels in "
            "view are probably right: neighbours disagree about the surface"
        )
    if word != GOOD:
        return word, why
    if together > DOUBTS * posed:
        return DOUBTFUL, (
            f"in {together / posed:.0%} of the frames all surfels move like one rigid body: if "
            "the camera moves, use --camera moving"
        )
    if contradicted > (1.0 - _WHOLE) * posed:
        return DOUBTFUL, (
            f"in {contradicted / posed:.0%} of the frames the depth map contradicts most surfels: "
            "the surface stretches, or the image does"
        )
    if map_problem:
        return DOUBTFUL, f"camera and depths are not determined by the whole clip: {map_problem}"
    if unusable > (1.0 - _WHOLE) * frames:
        return DOUBTFUL, f"{unusable / frames:.0%} of the depth maps could not be used"
    if depth_from == "flat":
        return (
            DOUBTFUL,
            f"{why}, but surfels started on a plane: their motion is valid only in the image",
        )
    return GOOD, why
