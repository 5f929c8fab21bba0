"""One topic's incoming messages: in order, each once, whatever the network did.

A message that was taken before (sent again after a restart) is skipped and counted.  One that comes
too early is skipped too, and requested again.  A state machine: no socket, no clock.
"""

import sys
from collections import deque
from dataclasses import dataclass, field

from pliant.bus.base import Received

_WHY_CHARACTERS = 120


@dataclass
class Inbox:
    """The messages of one topic that wait to be taken.

    taken: messages taken so far, and so the number of the next.     limit, limit_bytes: of waiting
    messages; one alone may be larger.  A sender never has more than its window on the way, so more
    are foreign.
    repeated, early, refused: counts of skipped messages.     why: reason of the last refusal.
    gap: something is missing and must be requested.
    """

    limit: int
    limit_bytes: int = sys.maxsize
    taken: int = 0
    repeated: int = 0
    early: int = 0
    refused: int = 0
    why: str = ""
    gap: bool = False
    waiting: deque[Received] = field(default_factory=deque[Received])
    _bytes: int = 0

    @property
    def next_sequence(self) -> int:
        """The number of the message that fits behind those that wait."""
        return self.taken + len(self.waiting)

    def is_next(self, sequence: int, size: int) -> bool:
        """Whether a message with this number and size in bytes is the one to ``put``; others are
        counted."""
        if sequence < self.next_sequence:
            self.repeated += 1
        elif sequence > self.next_sequence:
            self.early += 1
            self.gap = True
        elif self.waiting and (
            len(self.waiting) >= self.limit or self._bytes + size > self.limit_bytes
        ):
            self.refuse("beyond its credit")
        else:
            return True
        return False

    def refuse(self, why: str) -> None:
        """Count a message that is not from a bus of ours."""
        self.refused += 1
        self.why = why[:_WHY_CHARACTERS]

    def refuse_first(self, why: str) -> None:
        """The first that waits is not what it must be: what really has its number comes again."""
        self.refuse(why)
        self.waiting.clear()
        self._bytes = 0
        self.gap = True

    def put(self, received: Received) -> None:
        """Append the next message."""
        self.waiting.append(received)
        self._bytes += len(received.data)
        self.gap = False

    def take(self) -> Received:
        """The next message."""
        received = self.waiting.popleft()
        self._bytes -= len(received.data)
        self.taken += 1
        return received

    def start_from(self, taken: int) -> None:
        """Continue after ``taken`` messages; what waited will come again."""
        self.taken = taken
        self.waiting.clear()
        self._bytes = 0
        self.gap = False
