"""Surfels: tracks small independent patches of a deforming surface, from an initial depth.

in   camera/stream    once
     camera/image     every frame
     camera/depth     every frame: empty, or a depth map: the first one starts the surfels
     tracks/extrema   every frame, where tracking runs: where surfels may have gone
     map/update, map/keyframe   every frame, where bundle adjustment runs: depths for births
     map/deforming    every frame, where deformable mapping runs: better ones, and the camera
out  surfels/state    one per frame: all surfels, and the camera; empty without pixels
"""

from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from pliant.algorithms.arrays import F32, F64
from pliant.algorithms.camera import PinholeCamera
from pliant.algorithms.image.masks import glaring
from pliant.algorithms.surfels.depth_maps import agree, contradiction
from pliant.algorithms.surfels.parameters import SurfelParameters
from pliant.algorithms.surfels.prediction import predict
from pliant.algorithms.surfels.surfel_frame import SurfelFrame, SurfelState
from pliant.algorithms.surfels.surfel_tracker import SurfelTracker
from pliant.algorithms.surfels.window_follower import WindowFollower
from pliant.algorithms.tracks import FrameTracks
from pliant.bus.base import Bus, join, receive, receive_one, resume
from pliant.config import Config
from pliant.datasets.base import BrokenFrame
from pliant.datasets.calibration import calibration_from_yaml
from pliant.datasets.depth import DepthRectifier
from pliant.errors import ConfigError
from pliant.map_depth import MapDepth, MapView, view_of_window
from pliant.messages import topics
from pliant.messages.types import (
    CONTRADICTED,
    WAITING_FOR_DEPTH,
    WORLD_FRAME_ID,
    CameraStream,
    DeformingLandmarks,
    Depth,
    Extrema,
    Image,
    Keyframe,
    MapUpdate,
    Surfels,
)
from pliant_services.runtime.link_images import clearance, receive_images
from pliant_services.runtime.monitor import Monitor

_FLAT_DEPTH = 1.0


@dataclass(frozen=True)
class _Heard:
    """The inputs of one frame.  tracks, update, keyframe, deforming: where a service publishes
    them."""

    image: Image
    depth: Depth
    tracks: Extrema | None = None
    update: MapUpdate | None = None
    keyframe: Keyframe | None = None
    deforming: DeformingLandmarks | None = None

    @property
    def frame(self) -> int:
        return self.image.frame


@dataclass
class _State:
    """map_depth: if surfels are created on our own map.    stamp_ns, tracks, points_px: of the
    last frame with pixels.    ratio, segment: units of the surfels by one of the map, and the
    segment of the map, when surfels were last born on it."""

    stream: CameraStream
    tracker: SurfelTracker
    map_depth: MapDepth | None
    started: bool
    stamp_ns: int
    tracks: FrameTracks | None
    points_px: F32
    ratio: float = 1.0
    segment: int = -1
    follower: WindowFollower = field(default_factory=WindowFollower)


def run(bus: Bus, config: Config, monitor: Monitor) -> None:
    """Follow surfels until the images end."""
    _check(bus, config)

    def start() -> tuple[Any, ...]:
        stream = receive_one(bus, topics.STREAM, CameraStream)
        uses_map = config.surfels.depth_from == "map"
        map_depth = MapDepth(stream.camera, config.surfels) if uses_map else None
        nothing = np.zeros((0, 2), np.float32)
        return stream, SurfelTracker(config.surfels), map_depth, False, 0, None, nothing

    state = _State(*resume(bus, start))
    rectifier = DepthRectifier(calibration_from_yaml(state.stream.calibration))
    for heard in _hear(bus):
        image, missing = heard.image, heard.image.missing
        frame, metres, note = SurfelFrame.empty(), None, ""
        view = _look_at_map(state, heard, config)
        if heard.depth.data and not missing and config.surfels.depth_from == "sensor":
            try:
                metres = rectifier.rectify(image.frame, heard.depth.data)
            except BrokenFrame as error:
                note = str(error)
        if not missing and state.started:
            with monitor.stage("track"):
                interval_s = 1e-9 * (image.stamp_ns - state.stamp_ns)
                prediction = _prediction(state, heard)
                frame = state.tracker.track(image.grey, interval_s, prediction, metres)
                if metres is not None and (problem := contradiction(metres, frame)):
                    note = f"{CONTRADICTED}: {problem}"
                frame = _place(state, heard, frame)
            if view is not None:
                with monitor.stage("births"):
                    frame, note = _add(state, heard, frame, view, config)
        elif not missing:
            with monitor.stage("start"):
                frame, missing = _start(state, heard, metres, view, config)
        if state.started and not missing:
            state.follower.note(image.frame, image.stamp_ns, frame)
        if not heard.image.missing:
            state.stamp_ns = image.stamp_ns
            state.tracks, state.points_px = heard.tracks, frame.points_px
        message = Surfels.of(image, frame, frame_id=WORLD_FRAME_ID, missing=missing, note=note)
        bus.publish(topics.SURFELS, message)
        monitor.report(
            image,
            note=missing or note or ("tracking is lost" if frame.lost else ""),
            surfels=len(frame.ids),
            alive=int(np.count_nonzero(frame.state == SurfelState.TRACKED)),
        )
        bus.checkpoint(image.frame, tuple(vars(state).values()))


def _check(bus: Bus, config: Config) -> None:
    """Raise ConfigError if the configuration needs a topic that no service publishes."""
    if config.surfels.depth_from == "map" and not bus.reads(topics.KEYFRAME):
        raise ConfigError(
            "surfels.depth_from=map: no service of this session publishes "
            f"{topics.KEYFRAME.key}, which it needs"
        )


def _hear(bus: Bus) -> Iterator[_Heard]:
    """Everything for each frame, whatever the fleet makes."""
    pairs = join(map(_unmasked, receive_images(bus)), receive(bus, topics.DEPTH, Depth))
    heard = (_Heard(image, depth) for image, depth in pairs)
    if bus.reads(topics.EXTREMA):
        extrema = receive(bus, topics.EXTREMA, Extrema)
        heard = (replace(h, tracks=tracks) for h, tracks in join(heard, extrema))
    if bus.reads(topics.KEYFRAME):
        updates = receive(bus, topics.MAP_UPDATE, MapUpdate)
        heard = (replace(h, update=update) for h, update in join(heard, updates))
        keyframes = receive(bus, topics.KEYFRAME, Keyframe)
        heard = (replace(h, keyframe=keyframe) for h, keyframe in join(heard, keyframes))
    if bus.reads(topics.MAP_DEFORMING):
        deforming = receive(bus, topics.MAP_DEFORMING, DeformingLandmarks)
        heard = (replace(h, deforming=found) for h, found in join(heard, deforming))
    return heard


def _unmasked(image: Image) -> Image:
    """The image with what its mask covers as surfels leave it out."""
    return image if image.missing else replace(image, grey=glaring(image.grey, clearance(image)))


def _prediction(state: _State, heard: _Heard) -> F64 | None:
    if state.tracks is None or heard.tracks is None:
        return None
    return predict(state.points_px, state.tracks, heard.tracks)


def _look_at_map(state: _State, heard: _Heard, config: Config) -> MapView | None:
    """What Pliant's own map knows of this frame, with or without pixels.

    While the scene deforms a rigid map is wrong: that of the last seconds counts.
    """
    if state.map_depth is None or heard.update is None or heard.keyframe is None:
        return None
    p = config.surfels
    max_sigma = p.map_birth_sigma if state.started else p.map_sigma
    view = state.map_depth.take(heard.update, heard.keyframe, heard.frame, max_sigma=max_sigma)
    if heard.deforming is None:
        return view
    if state.follower.judge(heard.deforming):
        return view_of_window(heard.deforming, state.stream.camera, heard.update.segment)
    return None if state.follower.deforms else view


def _start(
    state: _State, heard: _Heard, metres: F64 | None, view: MapView | None, config: Config
) -> tuple[SurfelFrame, str]:
    """Surfels where there is depth for this frame, and else what is waited for."""
    image, T_world_camera, missing = heard.image.grey, None, WAITING_FOR_DEPTH
    if config.surfels.depth_from == "flat":
        metres = np.full(image.shape, _FLAT_DEPTH)
    elif view is not None:
        # From here on world and scale are those of the map as it is now, whatever it learns later.
        metres, T_world_camera, state.segment = view.depth, view.T_world_camera, view.segment
    elif state.map_depth is not None:
        missing = f"{WAITING_FOR_DEPTH} from the map: {state.map_depth.problem}"
    if metres is None:
        return SurfelFrame.empty(), missing
    frame = state.tracker.start(image, metres, state.stream.camera, T_world_camera)
    if frame.lost:
        return SurfelFrame.empty(), f"{WAITING_FOR_DEPTH} where there is texture"
    state.started = True
    return frame, ""


def _place(state: _State, heard: _Heard, frame: SurfelFrame) -> SurfelFrame:
    """The frame with its camera by the last trusted window, if it has one."""
    if heard.deforming is None or frame.lost:
        return frame
    T_world_camera = state.follower.camera(heard.frame, heard.deforming)
    return frame if T_world_camera is None else state.tracker.place(T_world_camera)


def _add(
    state: _State, heard: _Heard, frame: SurfelFrame, view: MapView, config: Config
) -> tuple[SurfelFrame, str]:
    """Create surfels on a later keyframe of our own map; otherwise return the reason why not."""
    image = heard.image.grey
    if frame.lost:
        # No surfels are left to compare with.  For the same map the last ratio holds.
        if view.segment != state.segment:
            state.ratio, state.segment = 1.0, view.segment
        T_world_camera = view.T_world_camera.copy()
        T_world_camera[:3, 3] *= state.ratio
        return state.tracker.add(image, state.ratio * view.depth, T_world_camera), ""
    state.segment = view.segment
    if state.follower.deforms and heard.deforming is not None:
        state.ratio = state.follower.place(state.tracker, frame, heard.deforming)
        return state.tracker.add(image, state.ratio * view.depth), ""
    found = agree(view.depth, frame, config.surfels.patch_px)
    if found.depth is None:
        return frame, f"no surfels are created on the map: {found.problem}"
    state.ratio = found.ratio
    return state.tracker.add(image, found.depth), ""


def warm_up() -> None:
    """Follow a few through two small images, with a static camera and a moving one."""
    camera = PinholeCamera(width=96, height=72, fx=90.0, fy=90.0, cx=47.5, cy=35.5)
    image = np.random.default_rng(0).integers(0, 200, (72, 96), np.uint8)
    depth, nothing = np.ones((72, 96)), FrameTracks.empty()
    still = SurfelParameters(camera="static", max_surfels=20)
    for parameters in (still, still.model_copy(update={"camera": "moving"})):
        tracker = SurfelTracker(parameters)
        first = tracker.start(image, depth, camera)
        tracker.track(image, 1.0, predict(first.points_px, nothing, nothing), depth)
