"""One ``pliant run`` of a batch: a process of its own, that can be cut off and goes on later."""

import os
import select
import signal
import subprocess
import sys
from contextlib import suppress
from pathlib import Path


class OneRun:
    """What it says goes to its log."""

    def __init__(self, arguments: list[str], log: Path) -> None:
        """arguments: of ``pliant run``.  Raises OSError where the log cannot be written."""
        command = [sys.executable, "-m", "pliant_services.cli", "run", *arguments]
        with log.open("w", encoding="utf-8") as file:
            self._process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=file,
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C is the batch's to deal with
            )
        self._log = log

    def wait(self) -> int:
        """Its exit code; negative where it was cut off."""
        return self._process.wait()

    def last_words(self) -> str:
        """The last line that it said."""
        lines = self._log.read_text(encoding="utf-8", errors="replace").split("\n")
        return next((line for line in reversed(lines) if line.strip()), "").removeprefix("pliant: ")

    def cut_off(self) -> None:
        """End it and its services as a power cut does: ``--resume`` goes on exactly there.

        Ctrl-C would end the stream instead: what was recorded then has an end, and is no beginning.
        """
        services = self._children()
        self._process.kill()
        for handle in services:
            with suppress(ProcessLookupError):
                signal.pidfd_send_signal(handle, signal.SIGKILL)
        for handle in services:
            select.select([handle], [], [])  # nobody writes there any more
            os.close(handle)

    def _children(self) -> list[int]:
        number = self._process.pid
        try:
            listed = Path(f"/proc/{number}/task/{number}/children").read_text()
        except OSError:
            return []
        handles: list[int] = []
        for child in listed.split():
            with suppress(ProcessLookupError):
                handles.append(os.pidfd_open(int(child)))
        return handles
