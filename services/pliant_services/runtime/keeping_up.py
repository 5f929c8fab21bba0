"""Live mode: a slow bundle adjustment passes over frames, and the others keep their rate.

The ingest alone decides which frames, and its word is recorded with them: so what comes of them
stays a function of the messages, in a replay, too.
"""

from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field

from pliant.bus.base import Bus
from pliant.messages import topics
from pliant.messages.types import Image
from pliant_services.processes import PROCESSES

_INGEST = "ingest"  # its own work took so long: nobody was waited for
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


@dataclass
class Drops:
    """Why images are dropped: who was waited for while they came, and for how long.

    counters: images by reader, and seconds.     waiting: dropped since the last that was not.
    before_s: how long each reader had been waited for when that one was chosen.
    """

    counters: dict[str, float] = field(default_factory=dict[str, float])
    waiting: int = 0
    before_s: dict[str, float] = field(default_factory=dict[str, float])

    def take(self, *, dropped: bool, waited_s: Mapping[str, float]) -> None:
        """Count the next frame.  waited_s: how long each reader was waited for so far."""
        if dropped:
            self.waiting += 1
            return
        if self.waiting:
            spent_s = {name: s - self.before_s.get(name, 0.0) for name, s in waited_s.items()}
            name = max(spent_s, key=spent_s.__getitem__, default="")
            if spent_s.get(name, 0.0) > 0.0:
                self._add(f"dropped_for_{name}", self.waiting)
                self._add(f"waited_for_{name}_s", spent_s[name])
            else:
                self._add(f"dropped_for_{_INGEST}", self.waiting)
        self.waiting, self.before_s = 0, dict(waited_s)

    def _add(self, key: str, value: float) -> None:
        self.counters[key] = self.counters.get(key, 0.0) + value


def images_that_wait(bus: Bus) -> int:
    """How many images bundle adjustment has yet to take: a matter of timing."""
    return bus.untaken(topics.IMAGE, _MAPPING)


def readers_that_may_lag(image: Image) -> Collection[str]:
    """Those that do nothing with a frame, or wait for those that do: it takes no room with them."""
    return _MAY_LAG if image.unmapped or image.missing else ()
