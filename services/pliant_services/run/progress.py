"""The progress of a run: a bar on a terminal, a few lines elsewhere."""

import sys
import threading
from collections.abc import Sequence

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from rich.progress import Progress as RichProgress

from pliant.algorithms.map_delta import LOST, TRACKING, WAITING
from pliant.datasets.static_mask import static_line
from pliant.messages.types import Status
from pliant_services.processes import BY_NAME

_SHOWN_A_SECOND = 4
"""Drawing the bar takes more than reading the reports of a frame."""

_STATES = {WAITING: "starting", TRACKING: "tracking", LOST: "lost"}


class _Console(Console):
    """A console that falls silent if its output is closed: the run continues."""

    def on_broken_pipe(self) -> None:
        self.quiet = True


class Progress:
    """Follows the status messages of a run.  Everything goes to stderr."""

    def __init__(self, frames: int | None) -> None:
        self._console = _Console(stderr=True)
        self._lock = threading.Lock()
        self._counters: dict[str, float] = {}
        self._static = ""
        self._bar = RichProgress(
            TextColumn("{task.fields[state]:>9}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]} {task.fields[detail]}"),
            console=self._console,
            refresh_per_second=_SHOWN_A_SECOND,
            disable=not sys.stderr.isatty(),
            transient=True,
        )
        self._task = self._bar.add_task("run", total=frames, state="starting", rate="", detail="")

    def say(self, line: str) -> None:
        """One line for the user."""
        try:
            self._bar.console.print(line, highlight=False, markup=False, soft_wrap=True)
        except OSError:
            self._console.quiet = True

    def on_status(self, status: Status) -> None:
        """Take in a status; called from the bus' thread."""
        with self._lock:
            self._counters.update(zip(status.counters, status.values.tolist(), strict=True))
            static = static_line(self._counters)
            if static != self._static:
                self._static = static
                self.say(static or "the static area has changed: nothing is masked any more")
            if self._bar.disable:
                return
            if status.service == "surfels":
                self._show(status, "following", self._surfels())
            elif status.service == "bundle_adjustment":
                state = _STATES.get(int(self._counters.get("state", WAITING)), "")
                self._show(status, state, self._mapped())

    def _show(self, status: Status, state: str, detail: str) -> None:
        speed = self._bar.tasks[0].speed  # rich sums over a thousand updates
        self._bar.update(
            self._task,
            completed=status.frame + 1,
            state=state,
            rate=f"{speed:.1f} fps" if speed else "",
            detail=detail + (f" ({status.note})" if status.note else ""),
        )

    def _mapped(self) -> str:
        counters = self._counters
        unmapped = counters.get("unmapped", 0)
        dropped = counters.get("dropped", 0) + counters.get("broken", 0)
        return (
            f"{counters.get('tracks', 0):.0f} tracks, {counters.get('inliers', 0):.0f} mapped, "
            f"{counters.get('points', 0):.0f} points"
            + (f", {dropped:.0f} dropped" if dropped else "")
            + (f", {unmapped:.0f} not mapped" if unmapped else "")
        )

    def _surfels(self) -> str:
        alive, every = self._counters["alive"], self._counters["surfels"]
        return f"{alive:.0f} of {every:.0f} surfels alive"

    def on_rest(self, names: Sequence[str]) -> None:
        """Report the services that still work after the last frame."""
        doing = [BY_NAME[name].finishing for name in names if BY_NAME[name].finishing]
        detail = f"{(*doing, 'closing the recording')[0]} ..."
        with self._lock:
            self._bar.update(self._task, state="finishing", rate="", detail=detail)

    def __enter__(self) -> "Progress":
        self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._bar.stop()
