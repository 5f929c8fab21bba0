"""Live mode with a bundle adjustment that is too slow: does tracking keep its rate?"""

import os
import signal
import tempfile
import threading
import time
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from benchmarks.endurance import forth_and_back
from benchmarks.table import markdown
from pliant.algorithms.map_delta import WAITING
from pliant.config import config_yaml, load_config
from pliant.datasets.builtin import builtin_folder
from pliant.datasets.source_spec import SourceSpec
from pliant.messages.types import Status
from pliant.results.folder import prepare
from pliant_services.profiles import PROFILES
from pliant_services.run.command import RunRequest, service_arguments
from pliant_services.runtime import kernels as warm_up
from pliant_services.runtime.launcher import Fleet

SERVICES = PROFILES["points"]
_PERIOD_S = 0.1
_NEAR_FRAMES = 3  # as far as bundle adjustment is behind tracking when it is well
_WAIT_S = 1.0


@dataclass
class _Phase:
    """A part of the run.  tracked, mapped, placed, dropped: frames that were.

    placed: they got a pose as they came, mapped or not.

    largest_lag: frames that bundle adjustment was behind tracking.
    """

    name: str
    start_s: float
    end_s: float = 0.0
    tracked: int = 0
    mapped: int = 0
    placed: int = 0
    dropped: int = 0
    largest_lag: int = 0

    def row(self) -> Sequence[str]:
        spent_s = self.end_s - self.start_s
        rates = (f"{n / spent_s:.1f}" for n in (self.tracked, self.placed, self.mapped))
        counts = (self.dropped, self.largest_lag)
        return (self.name, *rates, *map(str, counts))


@dataclass
class _Watch:
    """Follows the run.  near_s: when a frame was mapped near the one that was just tracked, after
    bundle adjustment had been slow.
    """

    phases: list[_Phase] = field(default_factory=list[_Phase])
    frame: int = -1
    mapped: int = -1
    near_s: float = 0.0
    changed: threading.Condition = field(default_factory=threading.Condition)

    def on_status(self, status: Status) -> None:
        with self.changed:
            phase = self.phases[-1] if self.phases else _Phase("", 0.0)
            maps = False
            counters = dict(zip(status.counters, status.values.tolist(), strict=True))
            if status.service == "tracking":
                self.frame = status.frame
                phase.tracked += counters["maxima"] > 0
                phase.dropped += counters["maxima"] == 0
            elif status.service == "bundle_adjustment":
                self.mapped = status.frame
                maps = counters.get("state", WAITING) != WAITING and "maxima" in status.stages
                phase.mapped += maps
                phase.placed += counters.get("inliers", 0) > 0
            lag = self.frame - self.mapped
            phase.largest_lag = max(phase.largest_lag, lag)
            if maps and not self.near_s and len(self.phases) == 3 and lag <= _NEAR_FRAMES:
                self.near_s = time.monotonic()
            self.changed.notify_all()

    def begin(self, name: str, frame: int, fleet: Fleet) -> None:
        """Begin a phase once tracking has told of a frame."""
        with self.changed:
            while self.frame < frame:
                fleet.raise_if_died()
                self.changed.wait(_WAIT_S)
            now = time.monotonic()
            if self.phases:
                self.phases[-1].end_s = now
            self.phases.append(_Phase(name, now))


def measure(
    source: str, frames: int, fps: float, slowdown: float, overrides: Sequence[str]
) -> Iterator[str]:
    """Rates before, while and after bundle adjustment has so small a share of the time only.

    The frames are the source's, forth and back, at so many a second.
    """
    warm_up.compile_kernels(print)
    config = load_config(overrides=["ingest.mode=live", "recorder.images=false", *overrides])
    watch = _Watch()
    quarter = frames // 4
    with tempfile.TemporaryDirectory(prefix="pliant-slow-") as folder:
        endless = forth_and_back(builtin_folder(source), Path(folder) / "source", frames, fps)
        request, output = (
            RunRequest(source=SourceSpec(location=str(endless))),
            Path(folder) / "output",
        )
        prepare(output, config_yaml(config))
        fleet = Fleet(SERVICES, log_folder=output / "logs", on_status=watch.on_status)
        try:
            fleet.start(lambda name: service_arguments(name, request, output))
            watch.begin("as it is", quarter, fleet)
            watch.begin(f"{slowdown:g} times slower", 2 * quarter, fleet)
            with _slow(fleet.pids["bundle_adjustment"], slowdown):
                watch.begin("as it is again", 3 * quarter, fleet)
            watch.begin("", frames - 2, fleet)
            fleet.end_source()
            fleet.wait()
        finally:
            fleet.close()
    before, slow, after, _ = watch.phases
    heading = (
        "bundle adjustment",
        "tracked/s",
        "with a pose/s",
        "mapped/s",
        "dropped",
        "most behind",
    )
    yield markdown(heading, [phase.row() for phase in (before, slow, after)])
    share = slow.tracked / (slow.end_s - slow.start_s)
    share /= before.tracked / (before.end_s - before.start_s)
    yield f"tracking keeps {100.0 * share:.1f} % of its rate"
    caught_up = f"{watch.near_s - after.start_s:.2f} s" if watch.near_s else "never"
    yield f"mapping is within {_NEAR_FRAMES} frames of tracking again after: {caught_up}"


class _slow:  # noqa: N801 (a context manager)
    """Lets a process run for one part in ``slowdown`` of the time, and as it is afterwards.

    With an infinite one it stands still.
    """

    def __init__(self, pid: int, slowdown: float) -> None:
        self._pid = pid
        self._runs_s = _PERIOD_S / slowdown
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._hold_up)

    def __enter__(self) -> None:
        self._thread.start()

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()

    def _hold_up(self) -> None:
        with suppress(ProcessLookupError):
            while not self._over.is_set():
                os.kill(self._pid, signal.SIGSTOP)
                self._over.wait(_PERIOD_S - self._runs_s)
                if self._runs_s > 0.0:
                    os.kill(self._pid, signal.SIGCONT)
                self._over.wait(self._runs_s)
            os.kill(self._pid, signal.SIGCONT)
