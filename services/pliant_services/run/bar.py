"""A bar on a terminal.  Only those load it: Rich takes as long as all of a run's own modules."""

from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, TextColumn
from rich.progress import Progress as RichProgress

_SHOWN_A_SECOND = 4
"""Drawing the bar takes more than reading the reports of a frame."""


class _Console(Console):
    """A console that falls silent if its output is closed: the run continues."""

    def on_broken_pipe(self) -> None:
        self.quiet = True


class Bar:
    """Frames done, with the state of the run beside them, on stderr."""

    def __init__(self, frames: int | None) -> None:
        self._console = _Console(stderr=True)
        self._rich = RichProgress(
            TextColumn("{task.fields[state]:>9}"),
            BarColumn(bar_width=24),
            MofNCompleteColumn(),
            TextColumn("{task.fields[rate]} {task.fields[detail]}"),
            console=self._console,
            refresh_per_second=_SHOWN_A_SECOND,
            transient=True,
        )
        self._task = self._rich.add_task("run", total=frames, state="starting", rate="", detail="")
        self._rich.start()

    def say(self, line: str) -> None:
        """One line above the bar."""
        try:
            self._console.print(line, highlight=False, markup=False, soft_wrap=True)
        except OSError:
            self._console.quiet = True

    def show(self, state: str, detail: str, *, frame: int | None = None) -> None:
        """Update the bar; frame: the last that is done."""
        speed = self._rich.tasks[0].speed  # rich sums over a thousand updates
        self._rich.update(
            self._task,
            completed=None if frame is None else frame + 1,
            state=state,
            rate=f"{speed:.1f} fps" if speed and frame is not None else "",
            detail=detail,
        )

    def close(self) -> None:
        """Remove the bar."""
        self._rich.stop()
