"""Starts the services of a run as forks of one process, which imports and loads all that they need.

A service that starts by itself imports some 500 modules and loads its compiled kernels, as the
others do: four seconds of CPU for a run.  A fork has them already, and shares their memory.

The server leaves as soon as all services are started.  They become children of the launcher then,
which is their reaper (``PR_SET_CHILD_SUBREAPER``): it sees every exit code and signal as those of
processes that it has started itself.  A server that dies or cannot be has no effect: what it has
not started, the launcher starts as programs, and so whatever is started again later.

multiprocessing has a fork server, too.  It stays the parent of its processes and reports how they
ended, so nobody learns that once it is killed, and restarts would meet services that still run.
"""

import ctypes
import gc
import json
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Sequence
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import IO

_MODULE = "pliant_services.runtime.fork_server"
_SET_CHILD_SUBREAPER = 36  # of prctl.h
_LONGEST = 1 << 16
"""Bytes of a request."""
_SHOWN = 4096
"""Bytes of a service's command that ``ps`` shows."""
_PATIENCE_S = 60.0
_LEAVING_S = 5.0
_LOOK_S = 0.002
_LOADED_OBJECTS = 50_000  # as in host.py


class ForkedProcess:
    """A process of the fork server, with the part of ``subprocess.Popen`` that a launcher uses.

    It is a child of this process once the server has left: only then ``poll`` may be called.
    """

    def __init__(self, pid: int, stdin: IO[bytes], stdout: IO[bytes]) -> None:
        self.pid, self.stdin, self.stdout = pid, stdin, stdout
        self.returncode: int | None = None
        self._reaping = threading.Lock()

    def poll(self) -> int | None:
        """Its exit code, negative for a signal; None while it runs."""
        with self._reaping:
            if self.returncode is None:
                pid, status = os.waitpid(self.pid, os.WNOHANG)
                self.returncode = os.waitstatus_to_exitcode(status) if pid else None
            return self.returncode

    def wait(self, timeout: float | None = None) -> int:
        """Its exit code.  Raises subprocess.TimeoutExpired."""
        deadline = None if timeout is None else time.monotonic() + timeout
        while (code := self.poll()) is None:
            if deadline is not None and time.monotonic() >= deadline:
                raise subprocess.TimeoutExpired(_MODULE, timeout or 0.0)
            time.sleep(_LOOK_S)
        return code

    def send_signal(self, kind: int) -> None:
        """Send a signal unless it has ended."""
        if self.poll() is None:
            os.kill(self.pid, kind)

    def kill(self) -> None:
        """Send SIGKILL unless it has ended."""
        self.send_signal(signal.SIGKILL)


class ForkServer:
    """The launcher's side.  Closed once all is started, or by leaving its context."""

    def __init__(self, services: Sequence[str]) -> None:
        """Start a server that imports the modules of these services; returns at once."""
        self._process: subprocess.Popen[bytes] | None = None
        if not _reaps_orphans(True):
            return
        self._link, others = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._link.settimeout(_PATIENCE_S)
        with others:
            self._process = subprocess.Popen(
                # The last word is room: forks show their own command there.
                [sys.executable, "-m", _MODULE, *services, " " * _SHOWN],
                stdin=others,  # it ends when the launcher is gone
                stdout=subprocess.PIPE,  # as its forks have: Python asks once whether it can seek
                stderr=subprocess.STDOUT,
                start_new_session=True,  # Ctrl-C reaches the launcher alone
            )

    def load(self, services: Sequence[str]) -> None:
        """Load the kernels of these services, which are compiled; returns at once."""
        if self._process is not None:
            try:
                self._link.send(json.dumps(list(services)).encode())
            except OSError:
                self.close()

    def start(self, arguments: Sequence[str]) -> ForkedProcess | None:
        """Start ``pliant`` with these arguments; None where that takes a program of its own."""
        if self._process is None:
            return None
        with ExitStack() as own, ExitStack() as given:
            stdin, writing = _pipe(given, own, writes=True)
            stdout, reading = _pipe(given, own, writes=False)
            try:
                request = json.dumps({"arguments": list(arguments)}).encode()
                socket.send_fds(self._link, [request], [stdin, stdout])
                pid = int(self._link.recv(_LONGEST))
            except (OSError, ValueError):  # it has died: nothing is left to be read
                self.close()
                return None
            with suppress(OSError):  # it has died already
                writing.write(b"\n")  # the fork waits for it: one that we know nothing of ends
            own.pop_all()
            return ForkedProcess(pid, writing, reading)

    def close(self) -> None:
        """End the server; what it has started becomes ours.  May be called again."""
        if self._process is not None:
            self._link.close()
            self._process.kill()
            self._process.wait()
            self._process = None
            _reaps_orphans(False)

    def __enter__(self) -> "ForkServer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _pipe(given: ExitStack, own: ExitStack, *, writes: bool) -> tuple[int, IO[bytes]]:
    """The end of a new pipe for a service, and ours, which we write to, or read."""
    read, write = os.pipe()
    theirs, ours = (read, write) if writes else (write, read)
    given.callback(os.close, theirs)
    return theirs, own.enter_context(open(ours, "wb" if writes else "rb", buffering=0 if writes else -1))


def _reaps_orphans(does: bool) -> bool:
    """Have processes of ours whose parent ends become our children; False where none can."""
    if sys.platform != "linux":
        return False
    return ctypes.CDLL(None).prctl(_SET_CHILD_SUBREAPER, int(does), 0, 0, 0) == 0


def _serve(services: Sequence[str]) -> None:
    """Import; then load kernels and fork as requested, until the launcher has closed its end.

    Returns in a fork, whose command line is ``sys.argv``.
    """
    usual = gc.get_threshold()
    gc.set_threshold(_LOADED_OBJECTS)
    link = socket.socket(fileno=os.dup(0))
    import importlib

    from pliant_services.cli import commands, service  # noqa: F401
    from pliant_services.runtime import host, session_end  # noqa: F401
    from pliant_services.processes import BY_NAME

    for name in services:
        importlib.import_module(BY_NAME[name].module)
    while True:
        data, files, _, _ = socket.recv_fds(link, _LONGEST, 2)
        if not data:
            os._exit(0)
        request = json.loads(data)
        if isinstance(request, list):
            for name in request:
                host.loaded(name)
            gc.freeze()  # a fork that looks for garbage does not write to all of these pages
            continue
        if not _is_alone():
            os._exit(1)  # a fork would miss threads, and what they have locked
        pid = os.fork()
        if pid == 0:
            link.close()
            _become(request["arguments"], *files)
            gc.set_threshold(*usual)
            return
        for file in files:
            os.close(file)
        link.send(str(pid).encode())


def _is_alone() -> bool:
    """Whether this process has one thread; those that have been joined may take a while to end."""
    deadline = time.monotonic() + _LEAVING_S
    while len(os.listdir("/proc/self/task")) > 1:
        if time.monotonic() > deadline:
            return False
        time.sleep(_LOOK_S)
    return True


def _become(arguments: Sequence[str], stdin: int, stdout: int) -> None:
    """Be a session of its own with these files and arguments, once the launcher knows of us."""
    os.setsid()
    for file, place in ((stdin, 0), (stdout, 1), (stdout, 2)):
        os.dup2(file, place)
    os.close(stdin)
    os.close(stdout)
    if not os.read(0, 1):
        os._exit(0)
    sys.argv = ["pliant", *arguments]
    _show([sys.executable, "-m", "pliant_services.cli", *arguments])


def _show(command: Sequence[str]) -> None:
    """Have ``ps`` show a command line: it is written over the one that the server was given."""
    with suppress(OSError, ValueError, IndexError):
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        start, end = int(fields[45]), int(fields[46])
        words = b"\0".join(os.fsencode(word) for word in command)[: end - start - 1]
        with open("/proc/self/mem", "r+b", buffering=0) as memory:
            memory.seek(start)
            memory.write(words.ljust(end - start, b"\0"))


if __name__ == "__main__":
    _serve(sys.argv[1:-1])
    from pliant_services.cli import main

    main()
