"""The progress of a run: a bar on a terminal, a few lines elsewhere."""

import sys
import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING

from pliant.algorithms.map_delta import LOST, TRACKING, WAITING
from pliant.datasets.static_mask import static_line
from pliant.messages.types import Status
from pliant_services.processes import BY_NAME

if TYPE_CHECKING:
    from pliant_services.run.bar import Bar

_STATES = {WAITING: "starting", TRACKING: "tracking", LOST: "lost"}


class Progress:
    """Follows the status messages of a run.  Everything goes to stderr.  With it, there is a bar
    where that is a terminal."""

    def __init__(self, frames: int | None) -> None:
        self._frames = frames
        self._bar: Bar | None = None
        self._is_closed = False
        self._lock = threading.Lock()
        self._counters: dict[str, float] = {}
        self._static = ""

    def say(self, line: str) -> None:
        """One line for the user."""
        if self._bar is not None:
            self._bar.say(line)
        elif not self._is_closed:
            try:
                print(line, file=sys.stderr, flush=True)
            except OSError:
                self._is_closed = True

    def on_status(self, status: Status) -> None:
        """Take in a status; called from the bus' thread."""
        with self._lock:
            self._counters.update(zip(status.counters, status.values.tolist(), strict=True))
            static = static_line(self._counters)
            if static != self._static:
                self._static = static
                self.say(static or "the static area has changed: nothing is masked any more")
            if self._bar is None:
                return
            if status.service == "surfels":
                state, detail = "following", self._surfels()
            elif status.service == "bundle_adjustment":
                state = _STATES.get(int(self._counters.get("state", WAITING)), "")
                detail = self._mapped()
            else:
                return
            note = f" ({status.note})" if status.note else ""
            self._bar.show(state, detail + note, frame=status.frame)

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
            if self._bar is not None:
                self._bar.show("finishing", detail)

    def __enter__(self) -> "Progress":
        if sys.stderr.isatty():
            from pliant_services.run.bar import Bar

            self._bar = Bar(self._frames)
        return self

    def __exit__(self, *_: object) -> None:
        with self._lock:
            bar, self._bar = self._bar, None
        if bar is not None:
            bar.close()
