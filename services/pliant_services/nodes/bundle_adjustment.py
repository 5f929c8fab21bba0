"""Bundle adjustment: where the camera is and what it sees, from tracks alone.

in   camera/stream    once
     map/known        before the first frame: a map of earlier sessions, to go on in
     camera/image     every frame: colours, and for re-acquisition patches and maxima of curvature;
                      in live mode, whether to pass over the frame
     tracks/extrema   every frame
out  map/update       one per frame: pose, points, keyframes, corrections of earlier poses
     map/final        one, after the last frame: the last corrections
     map/keyframe     one per frame: a new keyframe with its image, observations of those that leave
                      (as a map starts: the images of all keyframes that it starts from)
     map/keyframe_final   one, after the last frame: observations of those still in the window
     map/kept         after that: each keyframe of the map with all that was known, for sessions to
                      come

The whole map is adjusted in a thread beside the frames, see ``whole_map.py``.
"""

from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeAlias

import cv2

from pliant.algorithms.image.masks import filled
from pliant.algorithms.map_delta import KeyframeDelta, MapDelta
from pliant.algorithms.mapping.localiser import Localiser
from pliant.algorithms.mapping.mapper import Mapper
from pliant.algorithms.mapping.trial import TrialMapper, mapper_for
from pliant.algorithms.mapping.whole_map import Answer, Question, WholeMap, find_moves
from pliant.algorithms.tracking.maxima import maxima_of
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
from pliant_services.runtime.link_images import clearance, receive_images
from pliant_services.runtime.monitor import Monitor

_Kept: TypeAlias = tuple[bytes, bytes]
"""Of a frame: its image as a JPEG, and its mask."""

_JPEG_QUALITY = 95
"""The image gives the mesh its colours alone: a tenth of the bytes, in 2 ms."""


def run(bus: Bus, config: Config, monitor: Monitor) -> None:
    """Map until the tracks end."""

    def start() -> tuple[Header, Mapper | TrialMapper | Localiser, dict[int, _Kept]]:
        stream = receive_one(bus, topics.STREAM, CameraStream)
        known: list[MapKeyframe] = []
        if bus.reads(topics.MAP_KNOWN):
            known += receive(bus, topics.MAP_KNOWN, MapKeyframe)
        parameters, sigma = config.bundle_adjustment, stream.focal_sigma
        return stream, mapper_for(stream.camera, parameters, config.seed, sigma, known), {}

    # waiting: images and masks of the frames from which a map may yet start, by frame number.
    last, mapper, waiting = resume(bus, start)
    extrema = receive(bus, topics.EXTREMA, Extrema)
    beside = Beside()
    for image, tracks in join(receive_images(bus, mapped_only=True), extrema):
        beside.answer(mapper.whole_map, tracks.frame)
        if tracks.missing:
            delta = mapper.skip(tracks.frame)
        elif image.unmapped:
            delta = mapper.skip(tracks.frame, PASSED_OVER)
        else:
            colour = image.colour if image.colour.size else None
            covered = clearance(image)
            grey = filled(image.grey, covered)
            with monitor.stage("maxima"):
                seen = FrameExtrema.of(tracks, maxima_of(grey, config.tracking, covered))
            delta = mapper.process(tracks.frame, tracks.stamp_ns, seen, grey, colour, monitor.stage)
        bus.publish(topics.MAP_UPDATE, _update(tracks, delta))
        keyframes = mapper.publish_keyframes()
        if tracks.frame in delta.keyframe_frames:
            waiting[tracks.frame] = _jpeg(image), image.mask
        bus.publish(topics.KEYFRAME, _keyframe(image, keyframes, delta, waiting))
        needed = mapper.waiting_frames
        if tracks.frame in needed:
            waiting[tracks.frame] = _jpeg(image), image.mask
        waiting = {frame: waiting[frame] for frame in needed}
        monitor.report(
            tracks,
            note=delta.reason,
            state=delta.state,
            inliers=delta.inliers,
            points=mapper.point_count,
        )
        last = Header(frame=tracks.frame, stamp_ns=tracks.stamp_ns, frame_id=tracks.frame_id)
        beside.ask(mapper.whole_map)
        bus.checkpoint(tracks.frame, (last, mapper, waiting))
    with monitor.stage("finish"):
        final = mapper.finish()
    bus.publish(topics.MAP_FINAL, _update(last, final))
    keyframes = _keyframe(last, mapper.publish_keyframes(), final, waiting)
    bus.publish(topics.KEYFRAME_FINAL, keyframes)
    for number, kept in enumerate(mapper.kept()):
        header = Header(frame=number, stamp_ns=0, frame_id=WORLD_FRAME_ID)
        bus.publish(topics.MAP_KEPT, MapKeyframe.of(header, kept))
    monitor.report(last, points=mapper.point_count)


class Beside:
    """Adjusts the whole map in a thread beside the frames; kernels run outside Python's lock.

    It is no state: after a restart the mapper's question is asked again.
    """

    def __init__(self) -> None:
        self._thread = ThreadPoolExecutor(1, "whole map")
        self._asked: Question | None = None
        self._found: Future[Answer] | None = None

    def ask(self, whole_map: WholeMap) -> None:
        """Begin with what the mapper has asked."""
        question = whole_map.question
        if question is not None and question is not self._asked:
            self._found = self._thread.submit(find_moves, question)
        self._asked = question

    def answer(self, whole_map: WholeMap, frame: int) -> None:
        """Hand over what was found, where the mapper needs it now."""
        if self._found is None or whole_map.question is not self._asked:
            return
        if whole_map.is_due(frame):
            whole_map.answer, self._found = self._found.result(), None


def _keyframe(
    header: Header, delta: KeyframeDelta, update: MapDelta, waiting: dict[int, _Kept]
) -> Keyframe:
    """What changed in keyframes.  Images that wait are done with once a map starts."""
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


def _jpeg(image: Image) -> bytes:
    pixels = image.colour[..., ::-1] if image.colour.size else image.grey
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def _update(header: Header, delta: MapDelta) -> MapUpdate:
    return MapUpdate.of(header, delta, frame_id=WORLD_FRAME_ID)
