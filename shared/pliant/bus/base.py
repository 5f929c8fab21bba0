"""The protocol that a service sees, and the join of topics by frame number.

A service is a Kahn process: it reads each topic in order, by frame number and never by arrival, and
so its outputs depend on its inputs alone.
"""

from collections.abc import Callable, Collection, Iterator, Mapping
from dataclasses import dataclass
from typing import Any, Protocol, TypeVar

from pliant.errors import BusError
from pliant.messages.topics import Topic
from pliant.messages.types import Header


class OfFrame(Protocol):
    """Something that belongs to a frame."""

    @property
    def frame(self) -> int:
        """Its number."""
        ...


_M = TypeVar("_M", bound=Header)
_A = TypeVar("_A", bound=OfFrame)
_B = TypeVar("_B", bound=OfFrame)
_S = TypeVar("_S")


class Bus(Protocol):
    """Messages in and out of one service."""

    def reads(self, topic: Topic) -> bool:
        """Whether a service of this session publishes the topic for this service."""
        ...

    def receive(self, topic: Topic) -> Iterator[Header]:
        """Every message of a topic in order, until its end.  Blocks while there is none.

        Taking a message gives the sender credit for another, so a service that has to wait for
        something else continues taking, and holds what it has taken.
        """
        ...

    def is_waiting(self, topic: Topic) -> bool:
        """Whether a message of the topic, or its end, has come that was not taken yet.

        Only what live mode may pass over may depend on it: it is a matter of timing.
        """
        ...

    def untaken(self, topic: Topic, reader: str) -> int:
        """How many messages of a topic its reader has yet to take; 0 where it reads none.

        Only what live mode may pass over may depend on it: it is a matter of timing.
        """
        ...

    def wait_until_taken(self, topic: Topic) -> None:
        """Block until all readers of a topic, but those that may lag, have taken all of it."""
        ...

    @property
    def waited_s(self) -> Mapping[str, float]:
        """How long each reader was waited for so far, by its name: a matter of timing, too."""
        ...

    def publish(
        self,
        topic: Topic,
        message: Header,
        *,
        live: bool = False,
        may_lag: Collection[str] = (),
    ) -> None:
        """Send one message.  Blocks while a required reader is a whole window behind.

        live: from now on, a reader that stands still does not delay the others before that.
        may_lag: readers that may be further behind with it: it takes no room in their window.
        """
        ...

    def end(self, topic: Topic, *, complete: bool = True) -> None:
        """Close a topic: readers end after the messages sent before.

        complete: False where more would have come.
        """
        ...

    def restore(self) -> Any | None:
        """The state that ``checkpoint`` kept before this service died; None at a first start.

        Topics continue from where they were then.
        """
        ...

    def checkpoint(self, frame: int, state: Any) -> None:
        """Keep the state as it is after a frame, now and then: ``state`` must be all there is."""
        ...


@dataclass(frozen=True)
class Received:
    """A message as it came off the wire.  ``arrival`` counts over all inputs.

    message: what is in it (a StreamEnd for an end), once it has been decoded.
    """

    topic: Topic
    arrival: int
    sequence: int
    is_end: bool
    data: bytes
    message: Header | None = None


@dataclass(frozen=True)
class Window:
    """How much of a topic a sender keeps for a reader that acknowledges seldom: it waits beyond.

    A message larger than ``size`` bytes is sent once nothing else is kept.
    """

    messages: int
    size: int


class ObserverBus(Protocol):
    """The bus of the recorder, the one service whose output may depend on arrival."""

    def receive_any(self, *, timeout_s: float | None = None) -> Iterator[Received | None]:
        """Messages of all inputs in order of arrival, ends included, until all have ended.

        None whenever nothing has come for ``timeout_s``.  Vouches for nothing: see
        ``acknowledge``.
        """
        ...

    def start_from(self, taken: Mapping[str, int], ended: Collection[str]) -> None:
        """Continue after what an earlier start of this service has kept, by topic key."""
        ...

    def acknowledge(self) -> None:
        """All messages received so far are on the disk: senders need not keep them any longer."""
        ...


def resume(bus: Bus, start: Callable[[], _S]) -> _S:
    """The state to continue from: the last checkpoint's, or that of ``start`` at a first start."""
    state: _S | None = bus.restore()
    return start() if state is None else state


def receive_one(bus: Bus, topic: Topic, message: type[_M]) -> _M:
    """The single message of a topic that carries just one, read to the topic's end.

    Raises BusError if the topic carried none or several.
    """
    everything = list(receive(bus, topic, message))
    if len(everything) != 1:
        raise BusError(f"{topic.key} carried {len(everything)} messages, expected one")
    return everything[0]


def receive(bus: Bus, topic: Topic, message: type[_M]) -> Iterator[_M]:
    """``bus.receive`` with the message's type known to the reader."""
    for received in bus.receive(topic):
        assert isinstance(received, message)
        yield received


def join(first: Iterator[_A], second: Iterator[_B]) -> Iterator[tuple[_A, _B]]:
    """Pair two per-frame topics by frame number, and read both to their end.

    Every per-frame topic carries one message for every frame, so numbers that differ mean that a
    message was lost or sent twice: BusError, never a guess.
    """
    for a in first:
        b = next(second, None)
        if b is None or a.frame != b.frame:
            met = "its end" if b is None else str(b.frame)
            raise BusError(
                f"frame numbers do not match: {a.frame} of one topic, {met} of the other"
            )
        yield a, b
    for b in second:
        raise BusError(f"frame numbers do not match: {b.frame} of one topic, the end of the other")
