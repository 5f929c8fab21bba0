"""The frames of a segment that take part in a second start, and their poses after it."""

import numpy as np

from pliant.algorithms.arrays import F64
from pliant.algorithms.geometry import inverse
from pliant.algorithms.slam.adjust.second_start import SampledFrames, SecondPose
from pliant.algorithms.slam.adjust.track_sample import TrackSample
from pliant.algorithms.slam.calibration.rolling_shutter import FramePoses
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.estimate.pose import Correspondences, refine_pose
from pliant.algorithms.slam.map.keyframe import Keyframe
from pliant.algorithms.slam.parameters import MappingParameters

_PAIRS = 4
"""Maximum pairs of successive frames on one reference keyframe, in the sample of a second start.  A
camera that turns slowly, or stands, sees the same tracks in many frames: their system is dense, and
takes the cube of their number.
"""


def sampled_frames(
    sample: TrackSample, path: FramePoses, keyframes: list[Keyframe]
) -> SampledFrames | None:
    """Return the sample with the poses of its frames on these keyframes; None without a sample."""
    if not sample.frames:
        return None
    seen_in = {each.frame for each in sample.frames}
    frames, T_world_camera, _ = path.frames_on(keyframes)
    hosted = {keyframe.id: dict[int, F64]() for keyframe in keyframes}
    for each, pose in zip(frames, T_world_camera, strict=True):
        if each.frame in seen_in:
            T_host_camera = inverse(each.keyframe.T_world_camera) @ pose
            hosted[each.keyframe.id][each.frame] = T_host_camera
    poses = dict[int, tuple[int, F64]]()
    for slot, on_one in enumerate(hosted.values()):
        every = -(-len(on_one) // _PAIRS)
        for n, (frame, T_host_camera) in enumerate(on_one.items()):
            if n % every < 2:
                poses[frame] = slot, T_host_camera
    own = np.array([keyframe.frame for keyframe in keyframes], np.int64)
    poses |= {frame: (slot, np.eye(4)) for slot, frame in enumerate(own.tolist())}
    numbers = np.array(sorted(poses), np.int64)
    placed = [poses[number] for number in numbers.tolist()]
    return SampledFrames(
        numbers=numbers,
        hosts=np.array([slot for slot, _ in placed], np.int64),
        T_host_camera=np.array([pose for _, pose in placed]),
        keyframes=np.searchsorted(numbers, own),
        sampled=sample.frames,
    )


def place_frames(
    frames: list[SecondPose], path: FramePoses, keyframes: list[Keyframe],
    known: SelfCalibration, parameters: MappingParameters,
) -> set[int]:  # fmt: skip
    """Place frames between keyframes as a second start has them.

    known: its calibration.   Returns the frames that have enough inliers there; others stay.
    """
    by_number, placed = {each.frame: each for each in frames}, set[int]()
    limits, camera = parameters.localisation, known.view.camera
    for frame, keyframe, _ in path.frames_on(keyframes)[0]:
        each = by_number.get(frame)
        if each is None:
            continue
        seen = Correspondences(each.xyz, each.points_px, known.weights(each.points_px))
        found = refine_pose(
            each.T_world_camera, seen, camera, parameters.bundle,
            inlier_px=limits.inlier_px, iterations=1,
        )  # fmt: skip
        inliers = int(np.count_nonzero(found.inliers))
        if inliers >= limits.min_inliers:
            path.refine(frame, keyframe, found.T_world_camera, inliers, found.information)
            placed.add(frame)
    return placed
