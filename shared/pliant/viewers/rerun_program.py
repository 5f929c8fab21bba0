"""Rerun's own program, listening on this machine alone: the library's servers listen to all."""

import os
import signal
import socket
import subprocess
import time
from collections.abc import Sequence
from contextlib import suppress

from pliant.errors import ResultError
from pliant.programs import PYTHON

LOOPBACK = "127.0.0.1"
_UP_S = 60.0
_GONE_S = 30.0
_LOOK_S = 0.05


class RerunProgram:
    """A viewer or a server of Rerun's in a process of its own."""

    def __init__(self, ports: Sequence[int], arguments: Sequence[str]) -> None:
        """Start it and wait until it listens.

        ports: those that it listens on; the first one takes the data.    arguments: the rest.
        Raises ResultError if a port is taken, or the program does not come up.
        """
        for port in ports:
            if listens(port):
                raise ResultError(
                    f"port {port} is in use, perhaps by another viewer: close it, or choose "
                    "another --web-port"
                )
        self.ports = ports
        command = [*PYTHON, "-m", "rerun", "--bind", LOOPBACK, "--port", str(ports[0])]
        self._process = subprocess.Popen(
            [*command, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # a window stays when we leave, and Ctrl-C is not for it
        )
        try:
            self._wait_until_up(ports)
        except BaseException:  # also Ctrl-C: nothing else would end it
            self.close()
            raise

    def _wait_until_up(self, ports: Sequence[int]) -> None:
        deadline = time.monotonic() + _UP_S
        while not all(listens(port) for port in ports):
            if self._process.poll() is not None or time.monotonic() > deadline:
                raise ResultError(
                    "Rerun does not start: `python -m rerun` shows why; --save FILE.rrd needs no "
                    "viewer"
                )
            time.sleep(_LOOK_S)

    def close(self) -> None:
        """End it, and what it started: its ports are free then."""
        with suppress(ProcessLookupError):
            os.killpg(self._process.pid, signal.SIGKILL)
        self._process.wait()
        # The server is its child, for which this process cannot wait: on a busy machine it may
        # still take connections.
        deadline = time.monotonic() + _GONE_S
        while any(listens(port) for port in self.ports) and time.monotonic() < deadline:
            time.sleep(_LOOK_S)


def address_of(port: int) -> str:
    """Where the program takes data."""
    return f"rerun+http://{LOOPBACK}:{port}/proxy"


def free_port(preferred: int | None = None) -> int:
    """A port of this machine that is free now: this one, or else another."""
    if preferred is not None and not listens(preferred):
        return preferred
    with socket.create_server((LOOPBACK, 0)) as probe:
        return int(probe.getsockname()[1])


def listens(port: int) -> bool:
    """Whether something on this machine takes connections at a port."""
    try:
        socket.create_connection((LOOPBACK, port), timeout=1.0).close()
    except OSError:
        return False
    return True
