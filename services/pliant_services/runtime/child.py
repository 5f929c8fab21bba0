"""One service's process as its launcher sees it."""

import signal
import subprocess
import threading
import time
from collections import deque
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path

from pliant.exit_codes import DONE, INCOMPLETE
from pliant.files import append
from pliant_services.runtime.fork_server import ForkedProcess

_LAST_WORDS = 12  # lines of a service's log that are shown when it dies
_POLL_S = 0.05
_PATIENCE_S = 5.0  # for a process that has left its session, and takes long to end


@dataclass
class Child:
    """Its output goes to its log, and the last lines are kept here: the log may be on the disk
    that is full."""

    name: str
    process: subprocess.Popen[bytes] | ForkedProcess
    log: Path
    lines: deque[str] = field(default_factory=lambda: deque[str](maxlen=_LAST_WORDS))

    def __post_init__(self) -> None:
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()

    @property
    def failed(self) -> bool:
        """Whether it has ended, and not as it should."""
        return self.process.poll() not in (None, DONE, INCOMPLETE)

    @property
    def crashed(self) -> bool:
        """Whether it died of a fault of its own or a signal, not of something a user can mend."""
        words = self.last_words() if self.failed else []
        return self.failed and not (words and words[-1].startswith("pliant: "))

    def last_words(self) -> list[str]:
        """The last lines that it printed."""
        self._reader.join(1.0)  # what it said last may still be in the pipe
        return [line for line in tuple(self.lines) if line]

    def close(self) -> None:
        """Let go of the pipes of a process that has ended."""
        self._reader.join(1.0)
        for pipe in (self.process.stdin, self.process.stdout):
            if pipe is not None:
                with suppress(OSError):
                    pipe.close()

    def _read(self) -> None:
        assert self.process.stdout is not None
        try:
            log = append(self.log)
        except OSError:
            log = None
        for line in self.process.stdout:
            self.lines.append(line.decode(errors="replace").rstrip())
            if log is not None:
                with suppress(OSError):
                    log.write(line)
        if log is not None:
            log.close()

    def obituary(self) -> str:
        """The service and the cause of its end: its own one-line error, or its last output."""
        words, code = self.last_words(), self.process.returncode
        if words and words[-1].startswith("pliant: "):
            return f"{self.name}: {words[-1].removeprefix('pliant: ')}"
        if code >= 0:
            how = f"ended with code {code}"
        else:
            known = {s.value: s.name for s in signal.Signals}
            how = f"was killed by {known.get(-code, f'signal {-code}')}"
            how += " (is the memory full?)" if -code == signal.SIGKILL else ""
        text = "\n".join(words)
        return f"{self.name} {how}; log: {self.log}" + (f":\n{text}" if text else "")


def first_to_fail(children: Sequence[Child]) -> Child | None:
    """Which of the services has failed by itself; None if none has failed.

    One death makes others complain that it went away.  It left the session before they heard of
    it, but its process may end after theirs: then that is waited for.
    """
    deadline = time.monotonic() + _PATIENCE_S
    while True:
        running = any(child.process.poll() is None for child in children)
        failed = [child for child in children if child.failed]  # who ends in between is in it
        for child in failed:
            if "went away" not in " ".join(child.last_words()):
                return child
        if not failed or not running or time.monotonic() > deadline:
            return failed[0] if failed else None
        time.sleep(_POLL_S)
