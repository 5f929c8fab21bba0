"""Bundle adjustment: camera poses and the map, from tracks.

in   camera/stream    once
     map/known        before the first frame: a map of earlier sessions, to continue in
     imu/samples      the inertial samples of the source, before the first frame; of a live source
                      those that came since, before every frame and after the last
     camera/image     every frame: colours, and for re-acquisition patches and maxima of curvature;
                      in live mode, whether to map the frame, or only to localise it by its tracks
     tracks/extrema   every frame
out  map/update       one per frame: pose, points, keyframes, corrections of earlier poses
     map/final        one, after the last frame: the last corrections
     map/keyframe     one per frame: a new keyframe with its image, observations of those that leave
                      (as a map starts: the images of all keyframes that it starts from)
     map/keyframe_final   one, after the last frame: observations of those still in the window
     map/kept         after that: each keyframe of the map with all that was known, for sessions to
                      come

Global bundle adjustment runs in a thread, in parallel with tracking, see ``global_adjustment.py``.
"""

from collections.abc import Callable
from concurrent.futures import Future, ThreadPoolExecutor
from functools import cache, partial
from itertools import islice
from typing import TypeAlias

import cv2
import numpy as np

from pliant.algorithms.arrays import U8
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.geometry import so3_exp
from pliant.algorithms.image.masks import filled
from pliant.algorithms.map_delta import KeyframeDelta, MapDelta
from pliant.algorithms.slam.adjust.global_adjustment import (
    AdjustmentJob,
    AdjustmentResult,
    GlobalAdjustment,
    find_moves,
)
from pliant.algorithms.slam.adjust.loops import Loop
from pliant.algorithms.slam.calibration.self_calibration import SelfCalibration
from pliant.algorithms.slam.calibration_bootstrap import mapper_for
from pliant.algorithms.slam.estimate.absolute_pose import pose_by_ransac
from pliant.algorithms.slam.frame import Frame
from pliant.algorithms.slam.frame_mapper import FrameMapper
from pliant.algorithms.slam.map.keyframe import Keyframe as KeyframeOfMap
from pliant.algorithms.slam.map.landmarks import Landmarks
from pliant.algorithms.slam.mapper import Mapper
from pliant.algorithms.slam.parameters import MappingParameters, WindowParameters
from pliant.algorithms.slam.places.place_index import PlaceIndex, describe, match
from pliant.algorithms.slam.places.similarity import Pairs, similarity_by_ransac
from pliant.algorithms.slam.store.sparsification import sparsify
from pliant.algorithms.tracking.maxima import maxima_of
from pliant.algorithms.tracking.parameters import TrackingParameters
from pliant.algorithms.tracks import FrameExtrema
from pliant.bus.base import Bus, join, receive, receive_one, resume
from pliant.config import Config
from pliant.messages import topics
from pliant.messages.types import (
    PASSED_OVER,
    WORLD_FRAME_ID,
    CameraStream,
    Extrema,
    Header,
    Image,
    Keyframe,
    MapKeyframe,
    MapUpdate,
)
from pliant.recording.measured import imu_in
from pliant_services.runtime.link_images import clearance, receive_images, whole
from pliant_services.runtime.monitor import Monitor

_Kept: TypeAlias = tuple[bytes, bytes]
"""A frame's image as a JPEG, and its mask."""

_JPEG_QUALITY = 95
"""The image gives the mesh its colours alone: a tenth of the bytes, in 2 ms."""


def run(bus: Bus, config: Config, monitor: Monitor) -> None:
    """Map until the tracks end."""

    def start() -> tuple[Header, FrameMapper, dict[int, _Kept], bool, bool]:
        stream = receive_one(bus, topics.STREAM, CameraStream)
        # In the order of the sender, which waits for its readers after some messages.  A recording
        # of an earlier release has no topic of samples.
        has_samples, later = bus.reads(topics.IMU), stream.sensors_last
        samples = imu_in(bus.receive(topics.IMU) if has_samples and not later else ())
        known: list[MapKeyframe] = []
        if bus.reads(topics.MAP_KNOWN):
            known += receive(bus, topics.MAP_KNOWN, MapKeyframe)
        parameters, sigma = config.bundle_adjustment, stream.focal_sigma
        mapper = mapper_for(stream.camera, parameters, config.seed, sigma, known)
        mapper.add_samples(samples)
        return stream, mapper, {}, has_samples and later, has_samples and stream.imu_by_frame

    # waiting: images and masks of the frames from which a map may yet start, by frame number.
    # later: samples come after the last frame.   by_frame: others precede each frame.
    last, mapper, waiting, later, by_frame = resume(bus, start)
    extrema = receive(bus, topics.EXTREMA, Extrema)
    pieces = bus.receive(topics.IMU) if later else iter(())
    worker = AdjustmentWorker()
    for image, tracks in join(receive_images(bus, mapped_only=True), extrema):
        if by_frame:
            mapper.add_samples(imu_in(islice(pieces, 1)))
        entire = cache(partial(whole, image))
        if tracks.missing:
            delta = mapper.skip(tracks.frame)
        elif image.unplaced:
            delta = mapper.skip(tracks.frame, PASSED_OVER)
        elif image.unmapped:
            with monitor.stage("tracked pose"):
                frame = Frame.of_tracks(tracks.frame, tracks.stamp_ns, tracks)
                delta = mapper.only_localise(frame, PASSED_OVER)
        else:
            worker.hand_over(mapper.global_adjustment, tracks.frame)
            covered = clearance(image)
            grey = filled(image.grey, covered)
            with monitor.stage("maxima"):
                seen = FrameExtrema.of(tracks, maxima_of(grey, config.tracking, covered))
            frame = Frame(tracks.frame, tracks.stamp_ns, seen, grey, partial(_colour, entire))
            delta = mapper.process(frame, monitor.stage)
        bus.publish(topics.MAP_UPDATE, _update(tracks, delta))
        keyframes = mapper.publish_keyframes()
        if tracks.frame in delta.keyframe_frames:
            waiting[tracks.frame] = _kept(entire())
        bus.publish(topics.KEYFRAME, _keyframe(image, keyframes, delta, waiting))
        needed = mapper.waiting_frames
        if tracks.frame in needed:
            waiting[tracks.frame] = _kept(entire())
        waiting = {frame: waiting[frame] for frame in needed}
        monitor.report(
            tracks,
            note=delta.reason,
            state=delta.state,
            inliers=delta.inliers,
            points=mapper.point_count,
        )
        last = Header(frame=tracks.frame, stamp_ns=tracks.stamp_ns, frame_id=tracks.frame_id)
        worker.start(mapper.global_adjustment)
        bus.checkpoint(tracks.frame, (last, mapper, waiting, later, by_frame))
    mapper.add_samples(imu_in(pieces))
    with monitor.stage("finish"):
        final = mapper.finish()
    bus.publish(topics.MAP_FINAL, _update(last, final))
    keyframes = _keyframe(last, mapper.publish_keyframes(), final, waiting)
    bus.publish(topics.KEYFRAME_FINAL, keyframes)
    for number, kept in enumerate(mapper.kept()):
        header = Header(frame=number, stamp_ns=0, frame_id=WORLD_FRAME_ID)
        bus.publish(topics.MAP_KEPT, MapKeyframe.of(header, kept))
    monitor.report(last, note="", points=mapper.point_count, **mapper.counters)


class AdjustmentWorker:
    """Runs global bundle adjustment in a thread, in parallel with tracking; kernels run outside
    Python's lock.

    It is no state: after a restart it starts the mapper's job again.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "whole map")
        self._job: AdjustmentJob | None = None
        self._result: Future[AdjustmentResult] | None = None

    def start(self, adjustment: GlobalAdjustment) -> None:
        """Start the job that the mapper has requested."""
        job = adjustment.job
        if job is not None and job is not self._job:
            self._result = self._thread.submit(find_moves, job)
        self._job = job

    def hand_over(self, adjustment: GlobalAdjustment, frame: int) -> None:
        """Give the mapper the result of its job, where it needs that now."""
        if self._result is None or adjustment.job is not self._job:
            return
        if adjustment.is_due(frame):
            adjustment.result, self._result = self._result.result(), None


def _keyframe(
    header: Header, delta: KeyframeDelta, update: MapDelta, waiting: dict[int, _Kept]
) -> Keyframe:
    """The changes of keyframes.  Images that wait are done with once a map starts."""
    if delta.new < 0:
        return Keyframe.of(header, delta)
    moved = zip(update.keyframe_ids.tolist(), update.keyframe_frames.tolist(), strict=True)
    images = {keyframe: waiting[frame] for keyframe, frame in moved if frame in waiting}
    waiting.clear()
    jpeg, mask = images.pop(delta.new, (b"", b""))
    masked = any(earlier for _, earlier in images.values())
    return Keyframe.of(
        header,
        delta,
        jpeg=jpeg,
        earlier_ids=tuple(images),
        earlier_jpegs=tuple(earlier for earlier, _ in images.values()),
        mask=mask,
        earlier_masks=tuple(earlier for _, earlier in images.values()) if masked else (),
    )


def _colour(entire: Callable[[], Image]) -> U8 | None:
    colour = entire().colour
    return colour if colour.size else None


def _kept(image: Image) -> _Kept:
    pixels = image.colour[..., ::-1] if image.colour.size else image.grey
    quality = [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY]
    return cv2.imencode(".jpg", pixels, quality)[1].tobytes(), image.mask


def _update(header: Header, delta: MapDelta) -> MapUpdate:
    return MapUpdate.of(header, delta, frame_id=WORLD_FRAME_ID)


def warm_up() -> None:
    """Start a map, extend it, lose some tracks and then all, find them again, close a loop."""
    frames, n = 11, 400
    camera = PinholeCamera(width=320, height=240, fx=300.0, fy=300.0, cx=159.5, cy=119.5)
    generator = np.random.default_rng(0)
    points = generator.uniform((-2.0, -1.5, 3.0), (2.0, 1.5, 8.0), (n, 3))
    kappas = generator.uniform(1.0, 100.0, n).astype(np.float32)
    grey = generator.integers(0, 256, (240, 320), np.uint8)
    colour = np.repeat(grey[:, :, None], 3, axis=2)
    parameters = MappingParameters()
    known = SelfCalibration.of(camera, parameters.calibration).with_readout(0.11, 0.01)
    mapper = Mapper(camera, parameters, seed=0, calibration=known)
    for frame in range(frames):
        step = min(frame, frames - 2)
        turned = points @ so3_exp(np.array([0.0, 0.01 * step, 0.0])).T
        px = camera.project(turned - (0.1 * step, 0.02 * step, 0.0)).astype(np.float32)
        tracked = (np.arange(n) % frames != frame) & (frame < frames - 1)
        tracks = FrameExtrema(
            ids=np.flatnonzero(tracked),
            points_px=px[tracked],
            ages=np.full(int(tracked.sum()), frame, np.int32),
            kappas=kappas[tracked],
            states=np.zeros(int(tracked.sum()), np.uint8),
            maxima=np.column_stack([px, kappas]),
            dominant_flow=np.eye(2, 3),
        )
        mapper.process(Frame(frame, 33_333_333 * frame, tracks, grey, colour))
    none = np.zeros((0, 2), np.int64)
    loop = Loop(old=0, new=5, S_old_new=np.eye(4), rows=none.astype(np.int32), ids=none)
    mapper.global_adjustment.loops.append(loop)
    mapper.finish()
    # Kernels that few frames need: for a pose without a prediction, and merged points.
    px = camera.project(points).astype(np.float32)
    plane = camera.normalise(px)
    pose_by_ransac(points, plane, generator, gate=0.1, samples=1)
    pairs = Pairs(xyz_a=points, xyz_b=points, seen_a=plane, seen_b=plane)
    similarity_by_ransac(pairs, generator, gate=0.1, samples=1)
    keyframe = KeyframeOfMap(
        id=0, frame=0, segment=0, T_world_camera=np.eye(4), rows=np.zeros(1, np.int32),
        points_px=px[:1], rolled_px=px[:1],
    )  # fmt: skip
    keyframe.follow_aliases(Landmarks())
    assert mapper.atlas.active is not None
    segment, none = mapper.atlas.active.segment, np.zeros(0, np.int32)
    sparsify(segment, 1000, WindowParameters(kept_per_keyframe=1), none, whole=1)
    sparsify(segment, 1, WindowParameters(kept_per_keyframe=n), none, whole=1)
    maxima_of(grey, TrackingParameters())
    seen, places = describe(grey), PlaceIndex()
    places.add(0, seen)
    places.query(seen)
    match(seen, seen)
