"""The clock of a service: algorithms and services never read one, they are handed a stopwatch."""

import resource
import time
from collections.abc import Generator
from contextlib import AbstractContextManager, contextmanager, nullcontext
from typing import Protocol

import numpy as np

from pliant.bus.base import Bus
from pliant.messages import topics
from pliant.messages.types import REPORTED, Header, Status


class Monitor(Protocol):
    """The reports of a service on itself."""

    def stage(self, stage: str) -> AbstractContextManager[object]:
        """Time a stage of the current frame: ``with monitor.stage("curvature"): ...``."""
        ...

    def report(self, header: Header, *, note: str = "", **counters: float) -> None:
        """Close a frame: send its times and counters, and a line for the user."""
        ...


class SilentMonitor:
    """Measures nothing: for tests and replays."""

    def stage(self, stage: str) -> AbstractContextManager[object]:
        """Do nothing."""
        return nullcontext()

    def report(self, header: Header, *, note: str = "", **counters: float) -> None:
        """Do nothing."""


class StatusMonitor:
    """Measures stages and publishes one Status a frame."""

    def __init__(self, bus: Bus, service: str) -> None:
        self._bus = bus
        self._service = service
        self._topic = topics.status(service)
        self._seconds: dict[str, float] = {}

    @contextmanager
    def stage(self, stage: str) -> Generator[None]:
        """Add the time spent inside to the stage."""
        start = time.perf_counter()
        try:
            yield
        finally:
            spent = time.perf_counter() - start
            self._seconds[stage] = self._seconds.get(stage, 0.0) + spent

    def report(self, header: Header, *, note: str = "", **counters: float) -> None:
        """Publish the frame's status and begin the next frame."""
        counters[REPORTED] = time.time()
        counters["cpu_seconds"] = time.process_time()
        counters["peak_memory_mib"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024.0
        message = Status(
            frame=header.frame,
            stamp_ns=header.stamp_ns,
            frame_id="",
            service=self._service,
            note=note,
            stages=tuple(self._seconds),
            seconds=np.array(list(self._seconds.values()), np.float64),
            counters=tuple(counters),
            values=np.array(list(counters.values()), np.float64),
        )
        self._bus.publish(self._topic, message)
        self._seconds = {}
