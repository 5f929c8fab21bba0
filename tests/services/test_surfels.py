"""The surfel service on the in-memory bus: one message a frame, whatever comes."""

from dataclasses import replace

import numpy as np
import pytest
from restarting import Restarted, Stopping

from pliant.algorithms.surfels.surfel_frame import SurfelState
from pliant.bus.replay_bus import ReplayBus
from pliant.config import Config, load_config
from pliant.datasets import open_source
from pliant.datasets.source_spec import SourceSpec
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import WAITING_FOR_DEPTH, Depth, Header, Image, Surfels
from pliant_services.nodes import ingest, surfels
from pliant_services.runtime.monitor import SilentMonitor

FRAMES = 5
INPUTS = (topics.STREAM, topics.IMAGE, topics.DEPTH)
Messages = dict[Topic, list[Header]]


@pytest.fixture(scope="module")
def config() -> Config:
    return load_config(None, ["surfels.max_surfels=60"])


@pytest.fixture(scope="module")
def ingested(config: Config) -> Messages:
    bus = ReplayBus({})
    dataset = open_source(SourceSpec(location=f"built-in:tiny?frames={FRAMES}", depth="all"))
    ingest.run(bus, config, SilentMonitor(), dataset, stopping=lambda: False)
    return bus.outputs


def follow(config: Config, inputs: Messages, bus: ReplayBus | None = None) -> list[Surfels]:
    bus = bus or ReplayBus({topic: inputs[topic] for topic in INPUTS})
    surfels.run(bus, config, SilentMonitor())
    return [m for m in bus.outputs[topics.SURFELS] if isinstance(m, Surfels)]


def with_depth(inputs: Messages, data: dict[int, bytes]) -> Messages:
    depths = [replace(m, data=data.get(m.frame, b"")) for m in depths_of(inputs)]
    return {**inputs, topics.DEPTH: list(depths)}


def depths_of(inputs: Messages) -> list[Depth]:
    return [m for m in inputs[topics.DEPTH] if isinstance(m, Depth)]


def without_pixels(image: Header) -> Image:
    assert isinstance(image, Image)
    return replace(image, grey=np.zeros((0, 0), np.uint8), missing="dropped")


def test_one_message_a_frame_and_the_same_again(config: Config, ingested: Messages) -> None:
    first = depths_of(ingested)[0].data
    inputs = with_depth(ingested, {0: first})
    followed = follow(config, inputs)
    assert [m.frame for m in followed] == list(range(FRAMES))
    assert [m.stamp_ns for m in followed] == [m.stamp_ns for m in inputs[topics.IMAGE]]
    assert len(followed[0].ids) == 60
    assert not any(m.missing or m.lost or m.note for m in followed)
    assert all((m.state == SurfelState.TRACKED).sum() > 45 for m in followed)
    again = follow(config, inputs)
    assert [codec.encode(m) for m in again] == [codec.encode(m) for m in followed]
    for message in followed:
        back = codec.decode(Surfels, codec.encode(message))
        np.testing.assert_array_equal(back.tangents, message.tangents)


def test_surfels_start_with_the_first_depth_map_that_is_one(
    config: Config, ingested: Messages
) -> None:
    good = depths_of(ingested)[2].data
    followed = follow(config, with_depth(ingested, {1: b"no image", 2: good}))
    assert [m.missing for m in followed] == [WAITING_FOR_DEPTH] * 2 + [""] * 3
    assert followed[1].note.startswith("frame 1: its depth map")
    assert [len(m.ids) for m in followed] == [0, 0, 60, 60, 60]
    assert followed[1].lost


def test_frames_without_pixels_are_passed_over(config: Config, ingested: Messages) -> None:
    inputs = with_depth(ingested, {0: depths_of(ingested)[0].data})
    images = list(inputs[topics.IMAGE])
    images[2] = without_pixels(images[2])
    followed = follow(config, {**inputs, topics.IMAGE: images})
    assert [m.missing for m in followed] == ["", "", "dropped", "", ""]
    assert len(followed[2].ids) == 0
    np.testing.assert_array_equal(followed[3].ids, followed[1].ids)
    assert (followed[4].state == SurfelState.TRACKED).sum() > 45


def test_a_black_frame_loses_no_surfel_and_leaves_no_nan(
    config: Config, ingested: Messages
) -> None:
    inputs = with_depth(ingested, {0: depths_of(ingested)[0].data})
    images = list(inputs[topics.IMAGE])
    assert isinstance(images[2], Image)
    images[2] = replace(images[2], grey=np.zeros_like(images[2].grey))
    followed = follow(config, {**inputs, topics.IMAGE: images})
    assert (followed[2].state != SurfelState.TRACKED).all()
    assert followed[2].lost
    np.testing.assert_array_equal(followed[2].positions, followed[1].positions)
    assert (followed[4].state == SurfelState.TRACKED).sum() > 45
    for message in followed:
        for name in ("positions", "tangents", "zncc", "sigma", "points_px", "gains", "biases"):
            assert np.isfinite(getattr(message, name)).all()


def test_a_surfel_is_lost_by_the_stamps_of_frames_without_pixels_too(ingested: Messages) -> None:
    config = load_config(None, ["surfels.max_surfels=60", "surfels.lost_after_s=0.05"])
    inputs = with_depth(ingested, {0: depths_of(ingested)[0].data})
    images = list(inputs[topics.IMAGE])
    assert isinstance(images[2], Image)
    images[2] = replace(images[2], grey=np.zeros_like(images[2].grey))
    for dropped in (False, True):
        if dropped:
            images[1] = without_pixels(images[1])
        state = follow(config, {**inputs, topics.IMAGE: images})[2].state
        assert len(state) == 60
        assert (state == SurfelState.LOST).all() == dropped


def test_a_restarted_service_continues_with_the_same_bytes(
    config: Config, ingested: Messages
) -> None:
    inputs = with_depth(ingested, {n: depths_of(ingested)[n].data for n in (0, 3)})
    stopping = Stopping({topic: inputs[topic] for topic in INPUTS}, 1)
    whole = follow(config, inputs, stopping)
    rest = {topic: inputs[topic][2:] for topic in (topics.IMAGE, topics.DEPTH)}
    continued = follow(config, inputs, Restarted({topics.STREAM: [], **rest}, stopping.state))
    assert [codec.encode(m) for m in continued] == [codec.encode(m) for m in whole[2:]]
