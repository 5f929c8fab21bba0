"""A bus that feeds a service from lists or a recording, and keeps what it publishes.

The service cannot tell it from the real one, and it needs no process, port or clock.
"""

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any

from pliant.bus.base import Received
from pliant.messages import codec
from pliant.messages.topics import Topic
from pliant.messages.types import Header, StreamEnd


class ReplayBus:
    """Inputs by topic; what the service published is in ``outputs``, in order."""

    def __init__(
        self,
        inputs: Mapping[Topic, Iterable[Header]],
        *,
        through_codec: bool = True,
        on_publish: Callable[[Topic, Header], None] | None = None,
    ) -> None:
        """``through_codec`` sends each message through its bytes, as between processes.

        ``on_publish`` takes what the service publishes instead of ``outputs``, which would grow.
        """
        self._on_publish = on_publish
        self.outputs: dict[Topic, list[Header]] = {}
        self.ended: list[Topic] = []
        self.cut_off: list[Topic] = []
        """Those of them that were not complete."""
        self.acknowledged = self._given = 0
        """Messages that ``receive_any`` gave and ``acknowledge`` vouched for."""
        self.waited_s: Mapping[str, float] = {}
        self._inputs = {topic: iter(messages) for topic, messages in inputs.items()}
        self._through_codec = through_codec

    def reads(self, topic: Topic) -> bool:
        """Whether the topic was given."""
        return topic in self._inputs

    def receive(self, topic: Topic) -> Iterator[Header]:
        """Every message given for the topic; KeyError for a topic that was not given."""
        for message in self._inputs[topic]:
            yield self._wire(topic, message)

    def is_waiting(self, topic: Topic) -> bool:
        """Never: there is time for everything."""
        return False

    def receive_any(self, *, timeout_s: float | None = None) -> Iterator[Received | None]:
        """Every message of every topic, one topic after the other, each closed by its end."""
        arrival = 0
        for topic, messages in self._inputs.items():
            sequence = 0
            for message in messages:
                self._given = arrival + 1
                yield Received(topic, arrival, sequence, False, codec.encode(message))
                arrival, sequence = arrival + 1, sequence + 1
            closing = StreamEnd(
                frame=sequence,
                stamp_ns=0,
                frame_id="",
                topic=topic.key,
                messages=sequence,
                complete=True,
            )
            self._given = arrival + 1
            yield Received(topic, arrival, sequence, True, codec.encode(closing))
            arrival += 1

    def start_from(self, taken: Mapping[str, int], ended: Collection[str]) -> None:
        """Nothing: a replay begins at its beginning."""

    def acknowledge(self) -> None:
        """Note how many messages the observer has vouched for."""
        self.acknowledged = self._given

    def untaken(self, topic: Topic, reader: str) -> int:
        """None: there is time for everything."""
        return 0

    def wait_until_taken(self, topic: Topic) -> None:
        """Nothing: there is time for everything."""

    def publish(
        self,
        topic: Topic,
        message: Header,
        *,
        live: bool = False,
        may_lag: Collection[str] = (),
    ) -> None:
        """Keep the message.  Raises ValueError after the topic's end, as no reader would see it."""
        if topic in self.ended:
            raise ValueError(f"{topic.key} was published after its end")
        if self._on_publish is not None:
            self._on_publish(topic, message)
            return
        self.outputs.setdefault(topic, []).append(self._wire(topic, message))

    def end(self, topic: Topic, *, complete: bool = True) -> None:
        """Note that the topic was closed."""
        self.ended.append(topic)
        if not complete:
            self.cut_off.append(topic)

    def restore(self) -> Any | None:
        """Nothing: a replay begins at its beginning."""
        return None

    def checkpoint(self, frame: int, state: Any) -> None:
        """Keep nothing."""

    def _wire(self, topic: Topic, message: Header) -> Header:
        if not self._through_codec:
            return message
        return codec.decode(topic.message, codec.encode(message), max_bytes=topic.max_bytes)
