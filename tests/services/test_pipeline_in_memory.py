"""Each service alone on the in-memory bus: one message a frame, and the same bytes every time."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from pliant.algorithms.geometry import pose_to_matrix, transform
from pliant.algorithms.map_delta import TRACKING, WAITING
from pliant.algorithms.slam.atlas.known_places import Comparisons
from pliant.bus.replay_bus import ReplayBus
from pliant.config import Config, load_config
from pliant.datasets import open_source
from pliant.map_history import MapHistory
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import (
    PASSED_OVER,
    CameraStream,
    Extrema,
    Header,
    Image,
    Keyframe,
    MapUpdate,
)
from pliant_services.nodes import bundle_adjustment, ingest, tracking
from pliant_services.processes import BY_NAME
from pliant_services.runtime.monitor import SilentMonitor

FRAMES = 25
PROCESS = BY_NAME["bundle_adjustment"]


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config()


@pytest.fixture(scope="module")
def ingested(config: Config) -> dict[Topic, list[Header]]:
    bus = ReplayBus({})
    dataset = open_source(f"built-in:tiny?frames={FRAMES}")
    ingest.run(bus, config, SilentMonitor(), dataset, stopping=lambda: False)
    return bus.outputs


@pytest.fixture(scope="module")
def tracked(config: Config, ingested: dict[Topic, list[Header]]) -> list[Header]:
    return track(config, ingested)


def track(config: Config, inputs: dict[Topic, list[Header]]) -> list[Header]:
    bus = ReplayBus({topic: inputs[topic] for topic in (topics.STREAM, topics.IMAGE)})
    tracking.run(bus, config, SilentMonitor())
    return bus.outputs[topics.EXTREMA]


def adjust(
    config: Config,
    inputs: dict[Topic, list[Header]],
    tracks: list[Header],
    monitor: SilentMonitor | None = None,
) -> dict[Topic, list[Header]]:
    bus = ReplayBus(
        {
            topics.STREAM: inputs[topics.STREAM],
            topics.IMAGE: inputs[topics.IMAGE],
            topics.EXTREMA: tracks,
        }
    )
    bundle_adjustment.run(bus, config, monitor or SilentMonitor())
    return bus.outputs


class LastReport(SilentMonitor):
    """What was counted last."""

    def report(self, header: Header, *, note: str = "", **counters: float) -> None:
        self.counters = counters


def wire(messages: list[Header]) -> list[bytes]:
    return [codec.encode(message) for message in messages]


def without_pixels(image: Header) -> Image:
    return Image(
        frame=image.frame,
        stamp_ns=image.stamp_ns,
        frame_id=image.frame_id,
        grey=np.zeros((0, 0), np.uint8),
        colour=np.zeros((0, 0, 3), np.uint8),
        missing="dropped",
    )


def test_ingest_sends_every_frame_once(ingested: dict[Topic, list[Header]]) -> None:
    for topic in (topics.SOURCE, topics.IMAGE):
        assert [m.frame for m in ingested[topic]] == list(range(FRAMES))
    assert len(ingested[topics.STREAM]) == 1


def test_tracking_sends_one_message_a_frame_and_the_same_again(
    config: Config, ingested: dict[Topic, list[Header]], tracked: list[Header]
) -> None:
    assert [m.frame for m in tracked] == list(range(FRAMES))
    assert all(isinstance(m, Extrema) and len(m.ids) > 500 for m in tracked)
    assert wire(track(config, ingested)) == wire(tracked)


def test_bundle_adjustment_sends_one_update_a_frame_and_the_same_again(
    config: Config, ingested: dict[Topic, list[Header]], tracked: list[Header]
) -> None:
    first = adjust(config, ingested, tracked)
    assert [m.frame for m in first[topics.MAP_UPDATE]] == list(range(FRAMES))
    assert len(first[topics.MAP_FINAL]) == 1
    bundle_topics = PROCESS.outputs
    again = adjust(config, ingested, tracked)
    for topic in bundle_topics:
        assert wire(again[topic]) == wire(first[topic])


def test_the_last_report_counts_place_comparisons(
    config: Config, ingested: dict[Topic, list[Header]], tracked: list[Header]
) -> None:
    last = LastReport()
    adjust(config, ingested, tracked, last)
    assert Comparisons().counters.keys() <= last.counters.keys()


def test_another_seed_is_another_run_and_as_good(
    ingested: dict[Topic, list[Header]], tracked: list[Header]
) -> None:
    updates = adjust(load_config(seed=1), ingested, tracked)[topics.MAP_UPDATE]
    last = updates[-1]
    assert isinstance(last, MapUpdate)
    assert last.state == TRACKING
    assert last.inliers > 300


def test_updates_fold_to_a_pose_for_every_frame(
    config: Config, ingested: dict[Topic, list[Header]], tracked: list[Header]
) -> None:
    outputs = adjust(config, ingested, tracked)
    history = MapHistory()
    for update in outputs[topics.MAP_UPDATE]:
        assert isinstance(update, MapUpdate)
        history.apply(update, frame=update.frame, stamp_ns=update.stamp_ns)
    final = outputs[topics.MAP_FINAL][0]
    assert isinstance(final, MapUpdate)
    history.apply(final, frame=final.frame, stamp_ns=final.stamp_ns, final=True)
    assert list(history.final()) == list(range(FRAMES))
    known = history.points()
    assert len(known) > 500
    assert np.isfinite(known.positions).all()


def test_every_keyframe_is_published_when_new_and_when_settled(
    config: Config, ingested: dict[Topic, list[Header]], tracked: list[Header]
) -> None:
    small = config.bundle_adjustment.window.model_copy(update={"keyframes": 3})
    mapping = config.bundle_adjustment.model_copy(update={"window": small})
    outputs = adjust(config.model_copy(update={"bundle_adjustment": mapping}), ingested, tracked)
    told = [*outputs[topics.KEYFRAME], *outputs[topics.KEYFRAME_FINAL]]
    assert [m.frame for m in told] == [*range(FRAMES), FRAMES - 1]
    history = MapHistory()
    settled: list[int] = []
    pictured: list[int] = []  # also those from which the map started
    for update, keyframe in zip(
        [*outputs[topics.MAP_UPDATE], *outputs[topics.MAP_FINAL]], told, strict=True
    ):
        assert isinstance(update, MapUpdate)
        assert isinstance(keyframe, Keyframe)
        history.take(update, update.frame)
        assert len(keyframe.point_ids) == int(keyframe.counts.sum())
        assert (keyframe.new >= 0) == bool(keyframe.jpeg) == (~keyframe.settled).any()
        rows, points = history.points_of(keyframe.point_ids)
        assert len(rows) == len(keyframe.point_ids)  # all of them are points of the map now
        settled += keyframe.keyframe_ids[keyframe.settled].tolist()
        for number, jpeg in keyframe.images().items():
            pictured.append(number)
            pixels = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_UNCHANGED)
            image = ingested[topics.IMAGE][history.keyframes[number].frame]
            assert isinstance(image, Image)
            assert pixels.shape == image.grey.shape  # this sequence has no colours
            assert np.abs(pixels.astype(int) - image.grey).mean() < 4.0
        if keyframe.new < 0:
            continue
        assert history.keyframes[keyframe.new].frame == keyframe.frame
        # Where the points are seen is where they project to.
        T = np.linalg.inv(pose_to_matrix(history.keyframes[keyframe.new].pose_world_camera))
        stream = ingested[topics.STREAM][0]
        assert isinstance(stream, CameraStream)
        last = slice(-int(keyframe.counts[-1]), None)
        projected = stream.camera.project(transform(T, points.positions[last]))
        assert np.median(np.abs(projected - keyframe.points_px[last])) < 0.5
    assert settled == pictured == sorted(history.keyframes)
    assert len(told[0].images()) == 0  # type: ignore[attr-defined]
    assert max(len(m.images()) for m in told) > 2  # type: ignore[attr-defined]
    assert len(settled) > 3
    assert any(m.settled.any() for m in outputs[topics.KEYFRAME])  # type: ignore[attr-defined]


def test_a_frame_without_pixels_gets_empty_messages_and_loses_nothing(
    config: Config, ingested: dict[Topic, list[Header]]
) -> None:
    images = list(ingested[topics.IMAGE])
    gaps = (0, 18, 19)
    for gap in gaps:
        images[gap] = without_pixels(images[gap])
    inputs = {**ingested, topics.IMAGE: images}
    tracks = track(config, inputs)
    updates = adjust(config, inputs, tracks)[topics.MAP_UPDATE]
    assert [m.frame for m in updates] == list(range(FRAMES))
    for gap in gaps:
        message, update = tracks[gap], updates[gap]
        assert isinstance(message, Extrema)
        assert isinstance(update, MapUpdate)
        assert message.missing == "dropped"
        assert len(message.ids) == update.inliers == 0
    last = updates[-1]
    assert isinstance(last, MapUpdate)
    assert last.state == TRACKING
    assert last.segment == 0


def test_frames_that_are_not_mapped_are_localised_all_the_same(
    config: Config, ingested: dict[Topic, list[Header]], tracked: list[Header]
) -> None:
    images = list(ingested[topics.IMAGE])
    over, unplaced = {*range(1, 12, 2), 18, 19, 20, 21}, {20}
    for frame in over:
        marks = {"unmapped": True, "unplaced": frame in unplaced}
        images[frame] = replace(images[frame], **marks)  # type: ignore[arg-type]
    inputs = {**ingested, topics.IMAGE: images}
    tracks = track(config, inputs)
    assert wire(tracks) == wire(tracked)
    outputs = adjust(config, inputs, tracks)
    updates = [m for m in outputs[topics.MAP_UPDATE] if isinstance(m, MapUpdate)]
    assert [m.frame for m in updates] == list(range(FRAMES))
    begun = next(m.frame for m in updates if m.state == TRACKING)
    late = {m.frame for m in updates if m.reason == PASSED_OVER}
    assert late == unplaced | {frame for frame in over if frame < begun}
    posed = {frame for m in updates for frame in m.pose_frames.tolist()}
    assert posed == set(range(FRAMES)) - unplaced
    assert not over & {
        frame for m in updates for frame in m.keyframe_frames.tolist() if frame > begun
    }
    assert updates[-1].state == TRACKING
    assert updates[-1].segment == 0


def test_a_video_without_texture_starts_no_map_with_a_reason(
    config: Config, ingested: dict[Topic, list[Header]]
) -> None:
    black = [
        Image(
            frame=image.frame,
            stamp_ns=image.stamp_ns,
            frame_id=image.frame_id,
            grey=np.zeros((240, 320), np.uint8),
            colour=np.zeros((0, 0, 3), np.uint8),
        )
        for image in ingested[topics.IMAGE]
    ]
    inputs = {**ingested, topics.IMAGE: black}
    updates = adjust(config, inputs, track(config, inputs))[topics.MAP_UPDATE]
    assert len(updates) == FRAMES
    for update in updates:
        assert isinstance(update, MapUpdate)
        assert update.state == WAITING
    assert "black" in updates[-1].reason
