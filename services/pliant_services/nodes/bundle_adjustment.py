"""Bundle adjustment: where the camera is and what it sees, from tracks alone.

in   camera/stream    once
     camera/image     every frame: colours, and patches for re-acquisition; in live mode, whether
                      to pass over the frame
     tracks/extrema   every frame
out  map/update       one per frame: pose, points, keyframes, corrections of earlier poses
     map/final        one, after the last frame: the last corrections
     map/keyframe     one per frame: a new keyframe with its image, observations of those that leave
                      (as a map starts: the images of all keyframes that it starts from)
     map/keyframe_final   one, after the last frame: observations of those still in the window
"""

import cv2

from pliant.algorithms.map_delta import WAITING, MapDelta
from pliant.algorithms.mapping.mapper import Mapper
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
    MapUpdate,
)
from pliant_services.runtime.link_images import receive_images
from pliant_services.runtime.monitor import Monitor

_JPEG_QUALITY = 95
"""The image gives the mesh its colours alone: a tenth of the bytes, in 2 ms."""


def run(bus: Bus, config: Config, monitor: Monitor) -> None:
    """Map until the tracks end."""

    def start() -> tuple[Header, Mapper, dict[int, bytes]]:
        stream = receive_one(bus, topics.STREAM, CameraStream)
        return stream, Mapper(stream.camera, config.bundle_adjustment, config.seed), {}

    # waiting: images of the frames from which a map may yet start, by frame number.
    last, mapper, waiting = resume(bus, start)
    extrema = receive(bus, topics.EXTREMA, Extrema)
    for image, tracks in join(receive_images(bus, mapped_only=True), extrema):
        if tracks.missing:
            delta = mapper.skip(tracks.frame)
        elif image.unmapped:
            delta = mapper.skip(tracks.frame, PASSED_OVER)
        else:
            colour = image.colour if image.colour.size else None
            delta = mapper.process(tracks.frame, tracks, image.grey, colour, monitor.stage)
        bus.publish(topics.MAP_UPDATE, _update(tracks, delta))
        bus.publish(topics.KEYFRAME, _keyframe(image, mapper, delta, waiting))
        if delta.state == WAITING and not (tracks.missing or image.unmapped):
            waiting[tracks.frame] = _jpeg(image)
            if len(waiting) > config.bundle_adjustment.start.max_frames:
                del waiting[min(waiting)]
        monitor.report(
            tracks,
            note=delta.reason,
            state=delta.state,
            inliers=delta.inliers,
            points=mapper.point_count,
        )
        last = Header(frame=tracks.frame, stamp_ns=tracks.stamp_ns, frame_id=tracks.frame_id)
        bus.checkpoint(tracks.frame, (last, mapper, waiting))
    with monitor.stage("finish"):
        final = mapper.finish()
    bus.publish(topics.MAP_FINAL, _update(last, final))
    bus.publish(topics.KEYFRAME_FINAL, Keyframe.of(last, mapper.publish_keyframes()))
    monitor.report(last, points=mapper.point_count)


def _keyframe(
    image: Image, mapper: Mapper, update: MapDelta, waiting: dict[int, bytes]
) -> Keyframe:
    """What the frame changed in keyframes.  Images that wait are done with once a map starts."""
    delta = mapper.publish_keyframes()
    if delta.new < 0:
        return Keyframe.of(image, delta)
    moved = zip(update.keyframe_ids.tolist(), update.keyframe_frames.tolist(), strict=True)
    earlier = [(keyframe, waiting[frame]) for keyframe, frame in moved if frame in waiting]
    waiting.clear()
    return Keyframe.of(
        image,
        delta,
        jpeg=_jpeg(image),
        earlier_ids=tuple(keyframe for keyframe, _ in earlier),
        earlier_jpegs=tuple(jpeg for _, jpeg in earlier),
    )


def _jpeg(image: Image) -> bytes:
    pixels = image.colour[..., ::-1] if image.colour.size else image.grey
    return cv2.imencode(".jpg", pixels, [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])[1].tobytes()


def _update(header: Header, delta: MapDelta) -> MapUpdate:
    return MapUpdate.of(header, delta, frame_id=WORLD_FRAME_ID)
