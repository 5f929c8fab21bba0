"""The data of a run for browsers: all from the beginning, up to a memory limit."""

import threading
from collections import deque
from collections.abc import Generator
from contextlib import contextmanager
from typing import Any

import numpy as np

_TAKE_S = 0.1
_BATCH_BYTES = 1 << 24


class RerunData:
    """Parts of a Rerun stream, each a small ``.rrd`` file, which may be joined.

    The oldest are dropped where they need too much memory, but never what stays for the whole run.
    """

    def __init__(self, stream: Any, *, most_bytes: int) -> None:
        """stream: a ``rerun.RecordingStream``, of which all comes here from now on."""
        self._encoded = stream.binary_stream()
        self._most_bytes = most_bytes
        self._kept: list[tuple[int, bytes]] = []
        self._passing: deque[tuple[int, bytes]] = deque()
        self._passing_bytes = 0
        self._parts = 0
        self._is_over = False
        self._taking = threading.RLock()
        self._changed = threading.Condition()
        threading.Thread(target=self._go_on, daemon=True).start()

    @contextmanager
    def staying(self) -> Generator[None]:
        """Data that is logged inside is never dropped."""
        with self._taking:
            self.take()
            yield
            self.take(stays=True)

    def take(self, *, stays: bool = False) -> None:
        """Take what was logged so far."""
        with self._taking:
            part = self._encoded.read()
            with self._changed:
                if part:
                    self._put(part, stays)
                self._changed.notify_all()

    def _put(self, part: bytes, stays: bool) -> None:
        item = self._parts, part
        self._parts += 1
        if stays:
            self._kept.append(item)
            return
        self._passing.append(item)
        self._passing_bytes += len(part)
        while self._passing_bytes > self._most_bytes and len(self._passing) > 1:
            self._passing_bytes -= len(self._passing.popleft()[1])

    def since(self, number: int) -> list[tuple[int, bytes]] | None:
        """The next parts from this number on, each with its number: no more than a slow browser may
        hold, which are not dropped meanwhile.  Waits for one; None if none comes."""
        with self._changed:
            self._changed.wait_for(lambda: self._is_over or self._parts > number)
            parts = [item for item in (*self._kept, *self._passing) if item[0] >= number]
        sizes = np.cumsum([len(part) for _, part in sorted(parts)])
        return sorted(parts)[: int(np.searchsorted(sizes, _BATCH_BYTES)) + 1] or None

    def close(self) -> None:
        """Nothing more comes."""
        self.take()
        with self._changed:
            self._is_over = True
            self._changed.notify_all()

    def _go_on(self) -> None:
        while not self._is_over:
            self.take()
            with self._changed:
                self._changed.wait_for(lambda: self._is_over, _TAKE_S)
