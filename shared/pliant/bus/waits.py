"""How a service's thread waits for readers and for messages, and its reports of that.

Waits are limited: for a peer that is away no longer than our patience, and not at all once a
thread of the bus has failed or the session is over.
"""

import threading
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field

from pliant.bus.links import InLink, OutLink, first_arrived
from pliant.bus.peers import Peers
from pliant.errors import BusError

TICK_S = 1.0
_LAST_CREDITS_S = 2.0
_SEEING_OFF_S = 5.0
_WORTH_TELLING_S = 2.0  # shorter waits are what flow control is


@dataclass
class Waiting:
    """The wait that a service is in, if it is in one, for people.  The time is handed in."""

    text: str = ""
    since: float = 0.0

    def begin(self, text: str, now: float) -> None:
        """The service waits for this; the same wait continues where it did not end in between."""
        if not self.text:
            self.since = now
        self.text = text

    def end(self) -> None:
        """The wait is over."""
        self.text = ""

    def description(self, now: float) -> str:
        """A description of the wait, with its length if it is long; "" without one."""
        waited_s = now - self.since
        if not self.text or waited_s < _WORTH_TELLING_S:
            return self.text
        return f"{self.text}, for {waited_s:.0f} s"


@dataclass
class Waits:
    """All waits of a service.

    changed: the bus's lock, notified of every change.     patience_s: how long a peer may be away.
    interrupted: whether Ctrl-C has come where it raises nothing.
    spent_s: how long each reader was waited for so far, by its name.
    """

    changed: threading.Condition
    peers: Peers
    patience_s: float
    interrupted: Callable[[], bool]
    now: Waiting = field(default_factory=Waiting)
    spent_s: dict[str, float] = field(default_factory=dict[str, float])

    def for_readers(self, output: OutLink, lacking: Callable[[], list[str]]) -> None:
        """Wait while there is a reader that is not here or lacks something.  Raises BusError."""
        readers = output.box.readers.keys()
        with self.changed:
            while True:
                self.peers.raise_if_refused()
                here = self.peers.seen(readers)
                names = lacking() if here else self.peers.missing(readers)
                if here and not names:
                    self.now.end()
                    return
                began = time.monotonic()
                patience_s = max(self.patience_s, _LAST_CREDITS_S)  # credits may be on the way
                lost = self.peers.lost(readers, patience_s=patience_s, now=began)
                if here and lost:
                    raise BusError(
                        f"{lost[0]} went away with {output.box.on_the_way()} unread messages of "
                        f"{output.topic.key}"
                    )
                whom = self.peers.absent(readers) or ", ".join(names)
                self.now.begin(f"{whom} to take {output.topic.key}", began)
                # Those who are there already are seen within a tick.
                if not here and began - self.now.since >= TICK_S and self.interrupted():
                    raise KeyboardInterrupt
                self.changed.wait(TICK_S)
                spent_s = time.monotonic() - began
                for name in names:
                    self.spent_s[name] = self.spent_s.get(name, 0.0) + spent_s

    def for_message(self, entries: Sequence[InLink], deadline: float | None) -> InLink | None:
        """The input whose message came first; None if none comes in time.  Raises BusError."""
        with self.changed:
            self.peers.raise_if_failed()
            while not any(entry.box.waiting for entry in entries):
                self.peers.raise_if_refused()
                senders = [entry.sender for entry in entries]
                now = time.monotonic()
                lost = self.peers.lost(senders, patience_s=self.patience_s, now=now)
                if lost:
                    keys = ", ".join(e.topic.key for e in entries if e.sender == lost[0])
                    raise BusError(f"{lost[0]} went away before the end of {keys}")
                if deadline is not None and now >= deadline:
                    return None
                for entry in entries:
                    entry.wanted = True
                whom = self.peers.absent(senders) or ", ".join(dict.fromkeys(senders))
                what = entries[0].topic.key if len(entries) == 1 else f"{len(entries)} topics"
                self.now.begin(f"{what} from {whom}", now)
                self.changed.wait(TICK_S if deadline is None else min(TICK_S, deadline - now))
            return first_arrived(entries)

    def for_departures(self, senders: Collection[str]) -> None:
        """Wait until all of them have left, some seconds at most."""
        deadline = time.monotonic() + _SEEING_OFF_S
        with self.changed:
            while len(self.peers.missing(senders)) < len(senders):
                if time.monotonic() >= deadline:
                    return
                self.changed.wait(TICK_S)  # the keeper repeats our counts meanwhile
