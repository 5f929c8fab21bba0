"""Joining topics by frame number, and the bus that replays."""

from collections.abc import Iterator

import numpy as np
import pytest

from pliant.bus.base import join, receive, receive_one
from pliant.bus.replay_bus import ReplayBus
from pliant.errors import BusError
from pliant.messages import topics
from pliant.messages.types import Header, Image


def headers(*frames: int) -> Iterator[Header]:
    return iter([Header(frame=f, stamp_ns=f, frame_id="") for f in frames])


def image(frame: int) -> Image:
    return Image(
        frame=frame,
        stamp_ns=frame,
        frame_id="camera",
        grey=np.zeros((2, 3), np.uint8),
        colour=np.zeros((0, 0, 3), np.uint8),
    )


def test_join_pairs_by_frame() -> None:
    pairs = [(a.frame, b.frame) for a, b in join(headers(0, 1, 2), headers(0, 1, 2))]
    assert pairs == [(0, 0), (1, 1), (2, 2)]


@pytest.mark.parametrize("second", [(0, 2), (0, 0), (1,), (0, 1), (0, 1, 2, 3)])
def test_a_gap_or_a_repetition_is_never_guessed_over(second: tuple[int, ...]) -> None:
    with pytest.raises(BusError, match="do not match"):
        list(join(headers(0, 1, 2), headers(*second)))


def test_what_is_published_went_through_the_wire() -> None:
    bus = ReplayBus({topics.IMAGE: [image(0), image(1)]})
    for message in receive(bus, topics.IMAGE, Image):
        bus.publish(topics.IMAGE, message)
    bus.end(topics.IMAGE)
    sent = bus.outputs[topics.IMAGE]
    assert [m.frame for m in sent] == [0, 1]
    assert isinstance(sent[0], Image)
    assert sent[0].grey.flags.writeable  # else numba compiles every kernel twice
    with pytest.raises(ValueError, match="after its end"):
        bus.publish(topics.IMAGE, image(2))


@pytest.mark.parametrize("count", [0, 2])
def test_a_topic_of_one_message_carries_one(count: int) -> None:
    bus = ReplayBus({topics.IMAGE: [image(n) for n in range(count)]})
    with pytest.raises(BusError, match="expected one"):
        receive_one(bus, topics.IMAGE, Image)
