"""Ingest: frames from a source, rectified once for all services.

in   an image folder, a video, a camera, a built-in sequence
out  camera/stream   once: the camera
     camera/clip     before the first frame: the file of a video, where that is smaller than frames
     imu/samples     before the first frame: the inertial samples of the source, where it has any;
                     of a live source, which hears them meanwhile, before each frame and after the
                     last: those since the frame before
     gps/fixes       before the first frame, or after the last: its satellite fixes
     map/known       before the first frame: the keyframes of a map of earlier sessions
     camera/source   every frame: its bytes as they came
     camera/image    every frame: rectified; empty where it was dropped or does not decode; over a
                     link as ``link_images`` says; what is mapped of it, as ``keeping_up`` says
     camera/depth    every frame: the bytes of its depth map, where it has one that a service reads
"""

import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from functools import partial
from itertools import chain, islice
from typing import Any

from pliant.bus.base import Bus, resume
from pliant.config import Config
from pliant.datasets.base import Dataset, SourceFrame
from pliant.datasets.calibration import calibration_yaml
from pliant.datasets.clip import Clip, clip_of
from pliant.datasets.measured.base import NOTHING, HearsSensors, Measurements
from pliant.datasets.measured.found import hearing
from pliant.datasets.rectifier import Rectifier, rectified
from pliant.datasets.static_mask import static_counters
from pliant.datasets.working_size import SmallerImages
from pliant.errors import DatasetError, SourceLostError
from pliant.messages import topics
from pliant.messages.types import (
    BROKEN,
    CAMERA_FRAME_ID,
    CAPTURED,
    CameraStream,
    Depth,
    Image,
    SourceImage,
)
from pliant.recording.map_file import MapFile
from pliant.recording.measured import gps_pieces, imu_piece, imu_pieces
from pliant_services.runtime.keeping_up import (
    Drops,
    MappingPace,
    images_that_wait,
    readers_that_may_lag,
)
from pliant_services.runtime.link_images import Sender
from pliant_services.runtime.monitor import Monitor


def run(
    bus: Bus,
    config: Config,
    monitor: Monitor,
    dataset: Dataset,
    stopping: Callable[[], bool],
    known: MapFile | None = None,
    measured: Measurements = NOTHING,
) -> None:
    """Publish until the source ends or ``stopping()``.

    known: a map of earlier sessions.   measured: what other sensors of the source measured.
    Raises SourceLostError if the source fails after its first frame; what came before is sent.
    """
    live, hears = plays_live(dataset, config), hearing(dataset)
    hears_imu = hears is not None and hears.has_imu
    rectifier = Rectifier(dataset.calibration)
    link = Sender(config.bus, dataset.calibration)
    clip = _clip(dataset, config)
    checksum = clip.checksum() if clip is not None else -1

    def start() -> tuple[Any, ...]:
        stream = _stream(dataset, rectifier, known, live=live)
        stream = replace(stream, sensors_last=hears is not None, imu_by_frame=hears_imu)
        bus.publish(topics.STREAM, stream)
        bus.end(topics.STREAM)  # its readers wait for its end before the first frame
        for piece in clip.pieces() if clip is not None else ():
            bus.publish(topics.CLIP, piece)
        bus.end(topics.CLIP)
        if hears is None:
            for samples in imu_pieces(measured.imu):
                bus.publish(topics.IMU, samples)
            bus.end(topics.IMU)
            _publish_fixes(bus, measured)
        for keyframe in known.keyframes() if known is not None else ():
            bus.publish(topics.MAP_KNOWN, keyframe)
        bus.end(topics.MAP_KNOWN)
        return 0, 0, 0, tuple(vars(MappingPace.of(config.bus)).values()), ({},), checksum

    frames = None if live else begun(every(dataset, stopping))  # while readers start
    begin, dropped, broken, *kept, sent = resume(bus, start)
    if sent != checksum:  # taken up again with another file
        clip = None
    pace, drops = MappingPace(*kept[0]), Drops(*kept[1])
    image: Image | None = None
    counters: dict[str, float] = {}
    try:
        ready = partial(bus.wait_until_taken, topics.IMAGE)
        for source in frames or newest(dataset, stopping, ready):
            if source.index < begin:  # sent before we were started again
                continue
            drops.take(dropped=source.dropped, waited_s=bus.waited_s)
            with monitor.stage("rectify"):
                source = link.source(source)
                image = rectified(source, rectifier)
            if live:
                image = replace(image, live=True)
                image = pace.mark(image, images_that_wait(bus), config.ingest)
            dropped += source.dropped
            broken += image.missing.startswith(BROKEN)
            if clip is not None and not clip.is_as_it_was():
                clip = None  # the file now differs from what was sent
            bus.publish(topics.SOURCE, _source_message(source, image, clip is not None))
            may_lag = readers_that_may_lag(image)
            if hears is not None and hears_imu:  # those so far: a replay has the same ones
                piece = imu_piece(hears.next_imu(), image.frame)
                bus.publish(topics.IMU, piece, may_lag=may_lag)
            bus.publish(topics.IMAGE, link.image(image, source), live=live, may_lag=may_lag)
            bus.publish(topics.DEPTH, _depth_message(source), may_lag=may_lag)
            counters = {"dropped": dropped, "broken": broken, **pace.counters}
            counters |= static_counters(dataset)
            counters |= {CAPTURED: source.captured_s} if live else {}
            monitor.report(image, note="", **counters, **drops.counters)
            kept = (tuple(vars(pace).values()), (drops.counters,))
            bus.checkpoint(image.frame, (image.frame + 1, dropped, broken, *kept, sent))
    except DatasetError as error:
        if image is None:
            raise
        counters |= drops.counters
        monitor.report(image, note=str(error), **counters)
        _publish_heard(bus, hears, image.frame, complete=False)
        raise SourceLostError(str(error)) from None
    _publish_heard(bus, hears, -1 if image is None else image.frame, complete=True)


def _publish_fixes(bus: Bus, measured: Measurements, *, complete: bool = True) -> None:
    for fixes in gps_pieces(measured.gps):
        bus.publish(topics.GPS, fixes)
    bus.end(topics.GPS, complete=complete)


def _publish_heard(bus: Bus, hears: HearsSensors | None, last: int, *, complete: bool) -> None:
    """What other sensors of a live source have measured since the last frame."""
    if hears is None:
        return
    bus.end(topics.IMAGE, complete=complete)  # its readers read what follows once it has ended
    while hears.has_imu and len((samples := hears.next_imu()).stamps_ns):
        last += 1
        bus.publish(topics.IMU, imu_piece(samples, last))
    bus.end(topics.IMU, complete=complete)
    _publish_fixes(bus, hears.heard(), complete=complete)


def plays_live(dataset: Dataset, config: Config) -> bool:
    """Whether the newest frame wins, and others are passed over."""
    return dataset.is_live if config.ingest.mode == "auto" else config.ingest.mode == "live"


def every(dataset: Dataset, stopping: Callable[[], bool]) -> Iterator[SourceFrame]:
    """Lossless: every frame, at the pace of the slowest reader."""
    for frame in dataset:
        if stopping():
            return
        yield frame


def begun(frames: Iterator[SourceFrame]) -> Iterator[SourceFrame]:
    """The frames, the first of which is read now: a source may look far ahead for it."""
    return chain([*islice(frames, 1)], frames)


def newest(
    dataset: Dataset, stopping: Callable[[], bool], ready: Callable[[], None] = lambda: None
) -> Iterator[SourceFrame]:
    """Live: the newest frame wins; those passed over come out without data, to be counted.

    ready: returns when readers are, and only then the newest is chosen: no image waits in front of
    them but the one that they take next.  A source that is not a camera is played at the pace of
    its own time stamps, once its first frame is read and readers are ready.
    """
    frames = iter(dataset)
    if not dataset.is_live:
        frames = begun(frames)
        ready()
    slot: list[SourceFrame] = []
    failure: list[BaseException] = []
    changed = threading.Condition()
    finished = threading.Event()

    def capture() -> None:
        try:
            play()
        except BaseException as error:
            failure.append(error)
        finally:
            finished.set()
            with changed:
                changed.notify()

    def play() -> None:
        start_s, first_ns = time.monotonic(), None
        started_s = time.time()
        for frame in frames:
            first_ns = frame.stamp_ns if first_ns is None else first_ns
            captured_s = time.time()
            if not dataset.is_live:
                after_s = (frame.stamp_ns - first_ns) * 1e-9
                captured_s = started_s + after_s
                finished.wait(max(0.0, start_s + after_s - time.monotonic()))
            if finished.is_set():
                return
            frame = replace(frame, captured_s=captured_s)
            with changed:
                if slot:  # passed over: only its number and time are kept
                    slot[-1] = slot[-1].without_data()
                slot.append(frame)
                changed.notify()

    threading.Thread(target=capture, daemon=True).start()
    try:
        while True:
            with changed:
                changed.wait_for(lambda: slot or finished.is_set(), timeout=1.0)
            if slot:
                ready()
            with changed:
                came, slot[:] = slot[:], []
                over = finished.is_set()
            yield from came
            if stopping():
                return
            if over and not slot:
                if failure:
                    raise failure[0]
                return
    finally:
        finished.set()


def _stream(
    dataset: Dataset, rectifier: Rectifier, known: MapFile | None, *, live: bool
) -> CameraStream:
    camera = rectifier.camera
    size = dataset.source_size if isinstance(dataset, SmallerImages) else (0, 0)
    return CameraStream(
        frame=0,
        stamp_ns=0,
        frame_id=CAMERA_FRAME_ID,
        source=dataset.name,
        mode="live" if live else "lossless",
        frames=dataset.frame_count if dataset.frame_count is not None else -1,
        calibration=calibration_yaml(dataset.calibration),
        width=camera.width,
        height=camera.height,
        fx=camera.fx,
        fy=camera.fy,
        cx=camera.cx,
        cy=camera.cy,
        scale_is_metric=known is not None and known.header.metric,
        z_is_up=known is not None and known.header.level,
        focal_sigma=dataset.calibration.focal_sigma,
        source_width=size[0],
        source_height=size[1],
    )


def _clip(dataset: Dataset, config: Config) -> Clip | None:
    """The video whose file is recorded instead of raw frames: of JPEGs for a link it is none."""
    wanted = config.recorder.images and config.recorder.clip and config.bus.link_images != "jpeg"
    return clip_of(dataset) if wanted else None


def _source_message(source: SourceFrame, image: Image, of_clip: bool) -> SourceImage:
    return SourceImage(
        frame=source.index,
        stamp_ns=source.stamp_ns,
        frame_id=CAMERA_FRAME_ID,
        encoding=source.encoding,
        width=source.width,
        height=source.height,
        data=source.data,
        made_from=source.made_from,
        unmapped=image.unmapped,
        unplaced=image.unplaced,
        clip_frame=source.clip_frame if of_clip else -1,
        mask=source.mask,
        source_frame=source.number,
    )


def _depth_message(source: SourceFrame) -> Depth:
    return Depth(
        frame=source.index,
        stamp_ns=source.stamp_ns,
        frame_id=CAMERA_FRAME_ID,
        data=source.depth,
    )
