"""The pose of a frame by its tracks alone, for when mapping is behind.

It searches nothing in the image and does not change the map; it costs a tenth of mapping a frame.
"""

import numpy as np

from pliant.algorithms.slam.active.active_map import ActiveMap
from pliant.algorithms.slam.active.frame_pose import (
    judge_tracks,
    localise,
    refine_by_all,
    supported,
    to_global_shutter,
)
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.frame import Frame, IdealFrame, PlacedFrame
from pliant.algorithms.slam.locate.localisation import Motion


def pose_by_tracks(
    active: ActiveMap,
    calibration: SelfCalibration,
    motion: Motion,
    frame: Frame,
    generator: np.random.Generator,
) -> PlacedFrame | None:
    """Localise a frame by its tracks; None if too few lead to landmarks, as after a cut.

    motion: before it.   ``active.links`` follow its tracks.
    """
    ideal = IdealFrame.of(frame, calibration)
    located = localise(active, motion, ideal, generator)
    if located is None or not located.is_firm:
        return None
    T_world_camera = located.T_world_camera
    ideal = to_global_shutter(active, motion, ideal, T_world_camera)
    placed = PlacedFrame(frame=ideal, T_world_camera=T_world_camera)
    if calibration.readout:
        placed = refine_by_all(active, placed)
    judge_tracks(active, placed)
    placed = supported(active, motion, placed)
    enough = placed.support.inliers >= active.parameters.localisation.min_inliers
    return placed if enough else None
