"""One topic's outgoing messages: numbers, credit, and the messages kept for repetition.

A reader reports two counts.  ``taken``: messages that it has taken; the sender never has more than
a window of messages on the way to the slowest reader, besides those with which it may lag.
``safe``: messages that it will never request again, whatever happens; later ones are kept here.  A
reader without a lasting state reports safe = taken; one that restarts from a checkpoint, that
checkpoint's position; the recorder, what is on its disk.  A state machine: no socket, no clock.
"""

import sys
from bisect import bisect_left
from collections import deque
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

from pliant.bus.base import Window
from pliant.errors import BusError

_AT_ONCE_BYTES = 8 << 20
"""Of messages that are sent again, before newer ones go out."""


@dataclass
class Reader:
    """The reports of a required reader.  incarnation: which start of it; -1 before its first
    report.

    received: messages that it has, of which it has taken some.
    light: numbers of the messages that take no room in its window, among those that it may request.
    """

    incarnation: int = -1
    received: int = 0
    taken: int = 0
    safe: int = 0
    light: deque[int] = field(default_factory=deque[int])


@dataclass(frozen=True)
class Numbered:
    """A message with its sequence number.  before: bytes of all messages that came before it."""

    sequence: int
    kind: int
    payload: bytes
    before: int = 0


class Outbox:
    """Messages of one topic, from the oldest that a reader may still request to the newest."""

    def __init__(
        self,
        topic: str,
        readers: Sequence[str],
        *,
        window: int,
        window_bytes: int = sys.maxsize,
        windows: Mapping[str, Window] | None = None,
        lags: Mapping[str, Window] | None = None,
    ) -> None:
        """window, window_bytes: on the way to a reader; one larger goes alone.

        windows: of readers that make safe seldom, by name, what is kept for each of them.
        lags: of readers with messages that take no room in the window, what may be on the way to
        them with these.
        """
        self.topic = topic
        self.readers = {name: Reader() for name in readers}
        self.sent = 0
        self.refused = 0
        """Credits that no reader of ours can have given."""
        self._bytes = 0  # of all messages so far
        self._window, self._window_bytes = window, window_bytes
        self._windows = {name: w for name, w in (windows or {}).items() if name in self.readers}
        self._lags = {name: lag for name, lag in (lags or {}).items() if name in self.readers}
        self._kept: deque[Numbered] = deque()
        self.asking: set[str] = set()
        """Readers that want something sent again."""

    def add(self, kind: int, payload: bytes, may_lag: Collection[str] = ()) -> Numbered:
        """Number a message and keep it."""
        message = Numbered(self.sent, kind, payload, self._bytes)
        for name in self._lags:
            if name in may_lag:
                self.readers[name].light.append(message.sequence)
        self.sent += 1
        self._bytes += len(payload)
        if self.readers:
            self._kept.append(message)
        return message

    def start_from(self, sequence: int) -> None:
        """Continue from a number, as after a restart.  Nothing may have been added yet."""
        self.sent = sequence

    def credit(
        self,
        name: str,
        incarnation: int,
        taken: int,
        safe: int,
        left: Collection[int] = (),
        *,
        received: int = 0,
    ) -> bool:
        """A reader's counts, which never fall but in another incarnation of it.

        left: incarnations of it that are here no more.  A later start has a lower number where the
        clock was set back, so it is one that has left which gives way.
        Returns whether the reader is another incarnation than before.
        """
        reader = self.readers.get(name)
        if reader is None:
            return False
        before = reader.incarnation
        if incarnation != before and incarnation in left:
            return False  # what it said comes late
        if incarnation < before and before not in left:
            return False
        came_back = 0 <= before != incarnation
        if incarnation != before:
            reader.incarnation, reader.taken, reader.safe = incarnation, taken, min(safe, taken)
        else:
            reader.taken = max(reader.taken, taken)
            reader.safe = max(reader.safe, min(safe, reader.taken))
        reader.received = max(reader.taken, received)
        while reader.light and reader.light[0] < reader.safe:
            reader.light.popleft()
        floor = self.safe()
        while self._kept and self._kept[0].sequence < floor:
            self._kept.popleft()
        return came_back

    def safe(self) -> int:
        """How many messages no reader will ever request again."""
        return min((reader.safe for reader in self.readers.values()), default=self.sent)

    def not_safe(self) -> list[str]:
        """The readers that may request sent messages again."""
        return [name for name, reader in self.readers.items() if reader.safe < self.sent]

    def silent(self) -> list[str]:
        """The readers that have not reported their counts."""
        return [name for name, reader in self.readers.items() if reader.incarnation < 0]

    def behind(self) -> list[str]:
        """The readers, but those that may lag, that have yet to take some of what was sent."""
        return [name for name in self.readers if name not in self._lags and self.untaken(name)]

    def full(self, size: int = 0, may_lag: Collection[str] = ()) -> list[str]:
        """The readers without credit for one more message of that many bytes."""
        lacking = [name for name in self.readers if self._is_behind(name, size, may_lag)]
        for name, window in self._windows.items():
            safe = self.readers[name].safe
            waiting = self.sent - safe
            too_large = waiting > 0 and self._bytes_from(safe) + size > window.size
            if (waiting >= window.messages or too_large) and name not in lacking:
                lacking.append(name)
        return lacking

    def _is_behind(self, name: str, size: int, may_lag: Collection[str]) -> bool:
        reader, behind = self.readers[name], self.untaken(name)
        on_the_way = self._bytes_from(reader.taken) + size if behind else 0
        if name not in may_lag or name not in self._lags:
            return behind - self._light(reader) >= self._window or on_the_way > self._window_bytes
        lag = self._lags[name]
        return on_the_way > lag.size or behind >= max(lag.messages, self._window)

    def _bytes_from(self, sequence: int) -> int:
        """Bytes kept of the messages from a number on: in every send, so no sum over them."""
        if not self._kept:
            return 0
        return self._bytes - self._kept[max(0, sequence - self._kept[0].sequence)].before

    def untaken(self, name: str) -> int:
        """Messages that a reader has not taken; 0 for who reads none."""
        reader = self.readers.get(name)
        return 0 if reader is None else max(0, self.sent - reader.taken)

    def _light(self, reader: Reader) -> int:
        """Number of those that do not count towards its window."""
        return len(reader.light) - bisect_left(reader.light, reader.taken)

    def on_the_way(self) -> int:
        """Messages that the slowest required reader has not taken."""
        slowest = min((reader.taken for reader in self.readers.values()), default=self.sent)
        return max(0, self.sent - slowest)

    def kept(self) -> int:
        """Messages held here: at most a window and what the slowest checkpoint lies behind."""
        return len(self._kept)

    def take_requested(self) -> tuple[Numbered, ...]:
        """The messages that readers have requested and still lack, once; the first of them where
        they are many, so that newer ones are not delayed.

        By their latest report: delayed reports arrive together, and after the last of them the
        first may request a message that is no longer kept.  Raises BusError.
        """
        received = [self.readers[name].received for name in self.asking]
        self.asking.clear()
        missing = self.again(min(received, default=self.sent))
        enough = _AT_ONCE_BYTES + min((message.before for message in missing), default=0)
        return tuple(message for message in missing if message.before < enough)

    def again(self, sequence: int) -> tuple[Numbered, ...]:
        """Everything from a number on.  Raises BusError if it is not kept any more."""
        if sequence >= self.sent:
            return ()
        if not self._kept or self._kept[0].sequence > sequence:
            oldest = self._kept[0].sequence if self._kept else self.sent
            raise BusError(
                f"{self.topic}: a reader requests message {sequence}, but the oldest kept is "
                f"{oldest}: it restarted without its checkpoint"
            )
        return tuple(message for message in self._kept if message.sequence >= sequence)
