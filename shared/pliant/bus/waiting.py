"""What a service waits for, and for how long by now: for people, nobody's output depends on it."""

from dataclasses import dataclass

_WORTH_TELLING_S = 2.0  # shorter waits are what flow control is


@dataclass
class Waiting:
    """The wait that a service is in, if it is in one.  No clock: the time is handed in."""

    text: str = ""
    since: float = 0.0

    def begin(self, text: str, now: float) -> None:
        """The service waits for this; the same wait goes on where it did not end in between."""
        if not self.text:
            self.since = now
        self.text = text

    def end(self) -> None:
        """What it waited for has come."""
        self.text = ""

    def told(self, now: float) -> str:
        """The wait in words, with its length once that is long; "" without one."""
        waited_s = now - self.since
        if not self.text or waited_s < _WORTH_TELLING_S:
            return self.text
        return f"{self.text}, for {waited_s:.0f} s"
