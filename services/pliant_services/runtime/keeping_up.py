"""Live mode: a slow bundle adjustment maps only some frames; all frames keep their rate.

The ingest alone selects these frames, and its decision is recorded with them.  So the output is a
function of the messages, in a replay, too.
"""

from collections import deque
from collections.abc import Collection, Mapping
from dataclasses import dataclass, field, replace
from math import inf

from pliant.bus.base import Bus
from pliant.config import BusParameters, IngestParameters
from pliant.messages import topics
from pliant.messages.types import Image
from pliant_services.processes import PROCESSES

_INGEST = "ingest"  # its own work took too long: no reader was waited for
_MAPPING = "bundle_adjustment"
_MAY_LAG = tuple(process.name for process in PROCESSES if process.may_lag)


@dataclass
class MappingPace:
    """Decides for each frame whether bundle adjustment maps it, only localises it, or neither.

    room: how many images may wait to be mapped.   stamps_ns: of the last frames, as many as may
    wait for bundle adjustment.   last: the number of the last frame that it is to map.
    unmapped, unplaced: how many it does not map, and how many of them it does not localise either.
    """

    room: int
    stamps_ns: deque[int]
    last: int = -1
    unmapped: int = 0
    unplaced: int = 0

    @staticmethod
    def of(config: BusParameters) -> "MappingPace":
        """At the first frame."""
        # One less than there is credit for: the tracks of a frame are taken after its image.
        most = max(config.window, config.lag_messages)
        return MappingPace(config.window - 1, deque[int](maxlen=most))

    @property
    def counters(self) -> dict[str, float]:
        """Counts for the status of the service."""
        return {"unmapped": self.unmapped, "unplaced": self.unplaced}

    def mark(self, image: Image, waiting: int, limits: IngestParameters) -> Image:
        """Decide on the next frame, while that many earlier ones wait for bundle adjustment.

        It is mapped while all that wait are younger than ``mapping_lag_s``, and whenever none waits
        that is to be mapped: so one at a time where mapping takes longer than that, evenly spaced
        and never far behind.  The others are localised while all that wait are younger than
        ``pose_lag_s``.
        """
        age_s = self._oldest_s(image.stamp_ns, waiting)
        self.stamps_ns.append(image.stamp_ns)
        if image.missing:
            return image
        behind = age_s >= limits.mapping_lag_s or waiting >= self.room
        if not behind or self.last < image.frame - waiting:
            self.last = image.frame
            return image
        unplaced = age_s >= limits.pose_lag_s
        self.unmapped += 1
        self.unplaced += unplaced
        return replace(image, unmapped=True, unplaced=unplaced)

    def _oldest_s(self, stamp_ns: int, waiting: int) -> float:
        """How much older than this the oldest is of the frames that wait; -inf where none does."""
        if waiting == 0:
            return -inf
        if waiting > len(self.stamps_ns):
            return inf
        return 1e-9 * (stamp_ns - self.stamps_ns[-waiting])


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
    """Readers that ignore a frame, or wait for those: it does not count in their windows."""
    return _MAY_LAG if image.unmapped or image.missing else ()
