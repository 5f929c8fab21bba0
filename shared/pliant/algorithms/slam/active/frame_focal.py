"""The focal length of each frame, if it changes during a clip (see ``changing_focal``).

The magnification of a frame relative to the map shows the change long before an adjustment of all
keyframes is due.  It must be far more than one step of the camera explains, and at least half as
large in the frame before.  One frame alone is not enough: a rolling shutter magnifies and reduces
the frames of a shaking hand in turn.  After a change is found, each frame gets the focal length
that fits its tracks, with a random walk from that of the frame before as its prior.
"""

from dataclasses import replace

import numpy as np

from pliant.algorithms.slam.active.active_map import ActiveMap
from pliant.algorithms.slam.calibration.changing_focal import RATE, SPREAD
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.estimate.focal_pose import refine_focal, thinning
from pliant.algorithms.slam.estimate.problem import CalibrationUncertainty
from pliant.algorithms.slam.locate.localisation import Motion
from pliant.algorithms.slam.map.landmarks import MAPPED
from pliant.algorithms.tracks import FrameTracks

_AT_ONCE = 50.0
"""Standard deviations of one frame's magnification: real clips with one focal length reach 33,
zoomed ones begin at 70.
"""

_LEAST = 2.0 * CalibrationUncertainty().focal
"""Minimum log magnification: two standard deviations of a trusted calibration."""

_LEAST_GAP_S = 1e-3


def refocused(
    active: ActiveMap,
    calibration: SelfCalibration,
    motion: Motion,
    stamp_ns: int,
    tracks: FrameTracks,
) -> SelfCalibration:
    """Return the calibration with a frame's focal length, estimated from its tracks of landmarks.

    tracks: of the rectified image.
    """
    linked, changes = active.linked(MAPPED), calibration.changes
    if len(linked) < active.parameters.localisation.min_inliers:
        return calibration
    every = thinning(len(linked))
    linked = linked[::every]
    rows, predicted = active.links.rows[linked], motion.predictions(stamp_ns)[0]
    points_px = calibration.frame_view.pixels(tracks.points_px.take(linked, 0))
    if calibration.readout:
        rolled = active.segment.rolled(calibration, motion.velocity)
        depths = active.segment.inverse_depths(rows, predicted)
        points_px = rolled.removed(points_px, depths)
    given = calibration.given
    change, sigma = refine_focal(
        predicted, active.points.xyz.take(rows, 0), points_px, active.camera, (given.cx, given.cy),
        RATE * np.sqrt(max(motion.lost_s(stamp_ns), _LEAST_GAP_S)) if changes else SPREAD,
        every,
    )  # fmt: skip
    lasts = shows_at_once(change, sigma) and change * active.magnification > 0.0
    log_focal = calibration.log_focal + change
    active.magnification = log_focal if shows_at_once(2.0 * log_focal, sigma) else 0.0
    if not changes and not lasts:
        return calibration
    active.seen_by = replace(calibration, changes=True, log_focal=log_focal)
    return active.seen_by


def shows_at_once(log_focal: float, sigma: float) -> bool:
    """Whether the magnification of one frame relative to the map is certainly a change."""
    return abs(log_focal) > max(_LEAST, _AT_ONCE * sigma)
