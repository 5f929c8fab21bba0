"""Live mode: which frames a slow bundle adjustment maps, and that nobody waits for it."""

import threading
from collections import deque
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from itertools import chain
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from pliant.algorithms.tracks import FrameTracks
from pliant.bus.base import join, receive, receive_one
from pliant.bus.replay_bus import ReplayBus
from pliant.bus.session import free_endpoint, open_router
from pliant.bus.zenoh_bus import ZenohBus
from pliant.config import BusParameters, Config, IngestParameters, load_config
from pliant.datasets.base import SourceFrame
from pliant.datasets.calibration import Calibration
from pliant.messages import topics
from pliant.messages.topics import Topic
from pliant.messages.types import CameraStream, Extrema, Header, Image
from pliant.state import load_state, save_state
from pliant_services.nodes import ingest
from pliant_services.profiles import PROFILES
from pliant_services.runtime.host import lags
from pliant_services.runtime.keeping_up import Drops, MappingPace, readers_that_may_lag
from pliant_services.runtime.link_images import receive_images
from pliant_services.runtime.monitor import SilentMonitor

FLEET = ("ingest", "tracking", "bundle_adjustment")
LAG_S = 0.1
STEP_NS = 40_000_000  # the third image after one is late
MAPPED = 3
PATIENCE_S = 30.0
CALIBRATION = Calibration(model="pinhole", width=24, height=16, fx=20.0, fy=20.0, cx=12.0, cy=8.0)
IMAGE = Image(
    frame=0,
    stamp_ns=0,
    frame_id="camera",
    grey=np.zeros((2, 2), np.uint8),
    colour=np.zeros((0, 0, 3), np.uint8),
)


LIMITS = IngestParameters(mapping_lag_s=LAG_S, pose_lag_s=2.0 * LAG_S)


def pace_of(window: int, lag_messages: int = 128) -> MappingPace:
    return MappingPace.of(BusParameters(window=window, lag_messages=lag_messages))


def decide(pace: MappingPace, begin: int, waiting: Sequence[int], missing: str = "") -> str:
    """What becomes of frames, when so many of those before them wait: m, they are mapped; p, they
    get a pose; -, they do not."""
    decisions = ""
    for frame, wait in enumerate(waiting, begin):
        image = replace(IMAGE, frame=frame, stamp_ns=frame * STEP_NS, missing=missing)
        image = pace.mark(image, wait, LIMITS)
        decisions += "m" if not image.unmapped else "-" if image.unplaced else "p"
    return decisions


def test_frames_are_mapped_while_what_waits_is_young_or_none_is_to_be_mapped() -> None:
    pace = pace_of(17)
    assert decide(pace, 0, [0, 1, 2, 3, 4, 5]) == "mmmpp-"
    assert decide(pace, 6, [4, 5]) == "p-"  # the third of them waits
    assert decide(pace, 8, [5, 1, 2, 3]) == "mmmp"  # none waits that is to be mapped
    assert decide(pace, 12, [0] * 5) == "mmmmm"
    assert pace.counters == {"unmapped": 3 + 2 + 1, "unplaced": 2}


def test_what_came_so_long_ago_that_no_stamp_is_kept_is_late() -> None:
    assert decide(pace_of(4, lag_messages=5), 0, [0, 1, 2, 2, 2, 6]) == "mmmmm-"


def test_no_more_wait_to_be_mapped_than_there_is_credit_for() -> None:
    assert decide(pace_of(3), 0, [0, 1, 2, 3]) == "mmpp"


def test_frames_without_pixels_are_not_to_be_mapped_and_not_counted() -> None:
    pace = pace_of(17)
    assert decide(pace, 0, [0, 1, 2, 3, 4], missing="dropped") == "mmmmm"
    assert (pace.last, pace.unmapped) == (-1, 0)
    assert decide(pace, 5, [5, 6]) == "m-"


def test_who_is_started_again_decides_as_before() -> None:
    pace = pace_of(17)
    decide(pace, 0, range(5))
    again = MappingPace(*load_state(save_state(tuple(vars(pace).values()))))
    assert decide(again, 5, [5, 2, 6]) == decide(pace, 5, [5, 2, 6]) == "-m-"
    assert again == pace


@dataclass
class Camera:
    """Gives a frame when it is told to.  All are the same JPEG."""

    frames: int
    due: threading.Semaphore
    came: threading.Semaphore = field(default_factory=lambda: threading.Semaphore(0))
    name: str = "camera"
    is_live: bool = True
    frame_count: int | None = None
    ground_truth_path: Path | None = None
    calibration: Calibration = CALIBRATION

    def __iter__(self) -> Iterator[SourceFrame]:
        jpeg = cv2.imencode(".jpg", np.zeros((16, 24), np.uint8))[1].tobytes()
        for index in range(self.frames):
            assert self.due.acquire(timeout=PATIENCE_S)
            yield SourceFrame(index=index, stamp_ns=index * STEP_NS, encoding="jpeg", data=jpeg)
            self.came.release()


def bus_of(endpoint: str, service: str, config: Config, **how: object) -> ZenohBus:
    return ZenohBus(
        endpoints=[endpoint],
        session="test",
        service=service,
        inputs=how.get("inputs", {}),  # type: ignore[arg-type]
        outputs=how.get("outputs", {}),  # type: ignore[arg-type]
        window=config.bus.window,
        lags=lags(config, FLEET),
    )


@pytest.mark.parametrize(
    ("link_images", "lag_s"),
    [("raw", LAG_S), ("jpeg", LAG_S), ("raw", 1e9)],
    ids=["late", "late, over a link", "as many as there is credit for"],
)
def test_tracking_continues_while_bundle_adjustment_is_stopped(
    link_images: str, lag_s: float
) -> None:
    """It has taken an image, and not its tracks.  Far more than a window of frames come.

    The camera gives the next image when tracking has sent the tracks of the last one.
    """
    frames, window = 40, 4
    settings = [f"bus.window={window}", f"ingest.mapping_lag_s={lag_s}"]
    config = load_config(overrides=[*settings, f"bus.link_images={link_images}"])
    due = threading.Semaphore(1)
    failures: list[BaseException] = []
    tracked: list[Image] = []
    all_tracked = threading.Event()
    endpoint = free_endpoint()
    router = open_router(endpoint)
    images = {topics.STREAM: "ingest", topics.IMAGE: "ingest"}
    tracks = {topics.EXTREMA: "tracking"}

    def send() -> None:
        outputs: dict[Topic, Sequence[str]] = dict.fromkeys(images, FLEET[1:])
        unread = (topics.CLIP, topics.IMU, topics.GPS, topics.MAP_KNOWN, topics.SOURCE)
        outputs |= dict.fromkeys((*unread, topics.DEPTH), ())
        try:
            with bus_of(endpoint, "ingest", config, outputs=outputs) as bus:
                ingest.run(bus, config, SilentMonitor(), Camera(frames, due), lambda: False)
                bus.end_all()
        except BaseException as error:
            failures.append(error)

    def track(bus: ZenohBus) -> None:
        receive_one(bus, topics.STREAM, CameraStream)
        for image in receive_images(bus):
            extrema = Extrema.of(image, FrameTracks.empty())
            bus.publish(topics.EXTREMA, extrema, may_lag=readers_that_may_lag(image))
            tracked.append(image)
            due.release()
        all_tracked.set()
        bus.end_all()  # which waits for credit

    outputs = dict.fromkeys(tracks, FLEET[2:])
    with (
        bus_of(endpoint, "tracking", config, inputs=images, outputs=outputs) as fast,
        bus_of(endpoint, "bundle_adjustment", config, inputs=images | tracks) as slow,
    ):
        sender = threading.Thread(target=send, daemon=True)
        tracker = threading.Thread(target=track, args=(fast,), daemon=True)
        sender.start()
        receive_one(slow, topics.STREAM, CameraStream)
        taken = receive_images(slow, mapped_only=True)
        first = next(taken)
        tracker.start()
        all_tracked.wait(PATIENCE_S)
        assert [image.frame for image in tracked] == list(range(frames))
        assert all(image.grey.shape == (16, 24) for image in tracked)
        mapped = [image.frame for image in tracked if not image.unmapped]
        assert mapped == list(range(len(mapped)))
        assert MAPPED <= len(mapped) <= window
        rest = join(chain([first], taken), receive(slow, topics.EXTREMA, Extrema))
        assert [image.unmapped for image, _ in rest] == [image.unmapped for image in tracked]
        tracker.join(PATIENCE_S)
    sender.join(PATIENCE_S)
    router.close()
    assert not failures, failures


class OneReader(ReplayBus):
    """A bus whose only reader takes an image when it is told to, and has credit for a window."""

    def __init__(self, window: int) -> None:
        super().__init__({})
        self._window = window
        self._waiting: deque[Image] = deque()
        self._changed = threading.Condition()
        self._most: int | None = None  # that may wait before the ingest goes on
        self.reported = -1

    def publish(self, topic: Topic, message: Header, **how: Any) -> None:
        super().publish(topic, message, **how)
        if isinstance(message, Image):
            with self._changed:
                self._wait_for(self._window - 1)
                self._waiting.append(message)
                self._changed.notify_all()

    def wait_until_taken(self, topic: Topic) -> None:
        with self._changed:
            self._wait_for(0)

    def _wait_for(self, most: int) -> None:
        self._most = most
        self._changed.notify_all()
        assert self._changed.wait_for(lambda: len(self._waiting) <= most, PATIENCE_S)
        self._most = None

    def take(self) -> Image:
        """The next image that has pixels."""
        with self._changed:
            while True:
                assert self._changed.wait_for(lambda: self._waiting, PATIENCE_S)
                image = self._waiting.popleft()
                self._changed.notify_all()
                if not image.missing:
                    return image

    def report(self, frame: int) -> None:
        """The ingest is done with a frame."""
        with self._changed:
            self.reported = frame
            self._changed.notify_all()

    def settle(self, newest: int) -> None:
        """Wait until the ingest is done with this frame, or waits for the reader."""

        def settled() -> bool:
            held_up = self._most is not None and len(self._waiting) > self._most
            return held_up or self.reported == newest

        with self._changed:
            assert self._changed.wait_for(settled, PATIENCE_S)


def test_an_image_is_at_most_two_of_the_readers_frame_times_old_when_it_is_taken() -> None:
    """Two come while the reader works on one: so four at most are newer than the one it takes."""
    frames, config = 80, Config()
    camera, bus = Camera(frames, threading.Semaphore(0)), OneReader(config.bus.window)

    class Reporter(SilentMonitor):
        def report(self, header: Header, *, note: str = "", **counters: float) -> None:
            bus.report(header.frame)

    arguments = (bus, config, Reporter(), camera, lambda: False)
    sender = threading.Thread(target=ingest.run, args=arguments, daemon=True)
    sender.start()
    newer: list[int] = []
    for newest in range(frames):
        camera.due.release()
        assert camera.came.acquire(timeout=PATIENCE_S)
        bus.settle(newest)
        if newest % 2 == 1:
            newer.append(newest - bus.take().frame)
    assert max(newer) <= 4
    while sender.is_alive() and bus.reported < frames - 1:
        bus.take()
    sender.join(PATIENCE_S)


def test_only_who_reads_what_is_passed_over_may_lag() -> None:
    config = Config()
    assert lags(config, PROFILES["deformable"]) == {}
    assert lags(config, PROFILES["rigid"]).keys() == {"bundle_adjustment"}
    assert lags(config, PROFILES["deformable-map"]).keys() == {
        "bundle_adjustment",
        "deformable_mapping",
        "surfels",
    }


def test_the_longest_wait_is_the_reason_for_dropped_images() -> None:
    drops = Drops()
    waits = [("", {}), ("d", {"recorder": 0.5}), ("", {"tracking": 0.75, "recorder": 0.5})]
    waits += [("d", waits[-1][1]), ("d", waits[-1][1]), ("", waits[-1][1])]  # of nobody
    waits += [("", {"tracking": 9.0, "recorder": 0.5})]  # waited for, and nothing dropped
    for dropped, waited_s in waits:
        drops.take(dropped=bool(dropped), waited_s=waited_s)
    assert drops.counters == {
        "dropped_for_tracking": 1,
        "waited_for_tracking_s": 0.75,
        "dropped_for_ingest": 2,
    }


def test_frames_without_pixels_take_no_room_either() -> None:
    assert not readers_that_may_lag(IMAGE)
    assert "bundle_adjustment" in readers_that_may_lag(replace(IMAGE, unmapped=True))
    assert "bundle_adjustment" in readers_that_may_lag(replace(IMAGE, missing="dropped"))
    assert "tracking" not in readers_that_may_lag(replace(IMAGE, unmapped=True))
