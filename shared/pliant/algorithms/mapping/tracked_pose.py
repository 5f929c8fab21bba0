"""The pose of a frame by its tracks alone: what there is time for where mapping is behind.

Nothing is looked for in the image, and the map stays as it is; it costs a tenth of mapping a frame.
"""

from typing import NamedTuple

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.mapping.active_map import ActiveMap
from pliant.algorithms.mapping.frame_pose import (
    Support,
    at_once,
    localise,
    refine_by_all,
    support_at,
)
from pliant.algorithms.mapping.localisation import Motion
from pliant.algorithms.mapping.map_store import MAPPED, Observations
from pliant.algorithms.mapping.observation_table import reprojection_errors
from pliant.algorithms.mapping.self_calibration import SelfCalibration
from pliant.algorithms.tracks import FrameExtrema, FrameTracks


class Tracked(NamedTuple):
    """T_world_camera of a frame, its tracks had it been taken at once, and what there is for it."""

    T_world_camera: F64
    tracks: FrameExtrema
    support: Support


def pose_by_tracks(
    active: ActiveMap,
    calibration: SelfCalibration,
    motion: Motion,
    frame: int,
    stamp_ns: int,
    tracks: FrameTracks,
    generator: np.random.Generator,
) -> Tracked | None:
    """Localise a frame where its tracks lead; None where too few do, as after a cut.

    tracks: as the tracker gives them, of the rectified image; ``active.links`` follow them.
    """
    seen = calibration.ideal(FrameExtrema.without_maxima(tracks))
    located = localise(active, calibration, motion, stamp_ns, seen, None, generator)
    if located is None or not located.is_firm:
        return None
    T_world_camera = located.T_world_camera
    if calibration.readout:
        velocity = motion.velocity_at(frame, T_world_camera)
        seen, _ = at_once(active, calibration, T_world_camera, velocity, seen)
        T_world_camera = refine_by_all(active, T_world_camera, seen, Observations.none())
    linked = active.linked(MAPPED)
    xyz = active.points.xyz[active.links.rows[linked]]
    errors = reprojection_errors(T_world_camera, xyz, seen.points_px[linked], active.camera)
    active.judge_tracks(linked, errors)
    support = support_at(active, motion, T_world_camera, Observations.none(), seen)
    if support.inliers < active.parameters.localisation.min_inliers:
        return None
    return Tracked(T_world_camera, seen, support)
