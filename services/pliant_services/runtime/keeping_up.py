"""Live mode: a slow bundle adjustment passes over frames, and the others keep their rate.

The ingest alone decides which frames, and its word is recorded with them: so what comes of them
stays a function of the messages, in a replay, too.
"""

from collections import deque
from collections.abc import Collection
from dataclasses import dataclass

from pliant.bus.base import Bus
from pliant.messages import topics
from pliant.messages.types import Image
from pliant_services.processes import PROCESSES

_MAPPING = "bundle_adjustment"
_MAY_LAG = tuple(process.name for process in PROCESSES if process.may_lag)


@dataclass
class MappingPace:
    """Which frames bundle adjustment is to pass over.

    stamps_ns: of the last frames, as many as may wait to be mapped.     last: the number of the
    last frame that it is to map.     passed: how many it passes over.
    """

    stamps_ns: deque[int]
    last: int = -1
    passed: int = 0

    def passes_over(self, image: Image, waiting: int, lag_s: float) -> bool:
        """Decide on the next frame, when so many of those before it wait for bundle adjustment.

        It is mapped while all that wait are younger than ``lag_s``, and whenever none waits that
        is to be mapped: so one at a time where mapping takes longer than that, evenly spaced and
        never far behind.
        """
        oldest_ns = self.stamps_ns[-waiting] if 0 < waiting <= len(self.stamps_ns) else -1
        late = waiting > 0 and (oldest_ns < 0 or image.stamp_ns - oldest_ns >= lag_s * 1e9)
        full = waiting >= (self.stamps_ns.maxlen or 0)
        self.stamps_ns.append(image.stamp_ns)
        if image.missing:
            return False
        if (late or full) and self.last >= image.frame - waiting:
            self.passed += 1
            return True
        self.last = image.frame
        return False


def images_that_wait(bus: Bus) -> int:
    """How many images bundle adjustment has yet to take: a matter of timing."""
    return bus.untaken(topics.IMAGE, _MAPPING)


def readers_that_may_lag(image: Image) -> Collection[str]:
    """Those that do nothing with a frame, or wait for those that do: it takes no room with them."""
    return _MAY_LAG if image.unmapped or image.missing else ()
