"""Starts the services of a run as forks of one process, which has loaded all that they need.

A service that starts as a program imports hundreds of modules and loads compiled kernels, as the
others do: four seconds of CPU for a run.  A fork has them already, and shares their memory.

It imports modules until the first request, and what else a service needs when it is requested: so
the first ones start while the server loads the rest.

The server leaves as soon as all services are started.  They become children of the launcher then,
which has made itself their reaper (``PR_SET_CHILD_SUBREAPER``).  So it gets their exit codes and
signals as those of programs that it starts.  Where the server dies, or the system has no such call,
the launcher starts services as programs; so it does with those that it starts again after a crash.

The fork server of multiprocessing stays the parent instead: if it is killed, all exit codes are
lost, and services would be started again that still run.
"""

import ctypes
import gc
import importlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Generator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from pathlib import Path
from typing import IO, Any

from pliant.errors import PliantError
from pliant.programs import PYTHON

_MODULE = "pliant_services.runtime.fork_server"
_SET_CHILD_SUBREAPER = 36  # of prctl.h
_LONGEST = 1 << 16
"""Bytes of a request."""
_SHOWN = 4096
"""Bytes of a service's command line that ``ps`` shows at most."""
_PATIENCE_S = 60.0
_LEAVING_S = 5.0
_LOOK_S = 0.002
_LOADED_OBJECTS = 50_000  # new objects before garbage is looked for, as in host.py


class ForkedProcess:
    """A process of the fork server, with the part of ``subprocess.Popen`` that a launcher uses.

    It becomes a child of this process when the server is closed; before that it cannot be reaped.
    """

    def __init__(self, pid: int, stdin: IO[bytes], stdout: IO[bytes]) -> None:
        self.pid, self.stdin, self.stdout = pid, stdin, stdout
        self.returncode: int | Any = None  # as subprocess has it: an exit code once it has ended
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
    """The launcher's side of the server; close it when all services are started."""

    def __init__(self, services: Sequence[str]) -> None:
        """Start a server that imports the modules of these services; returns at once."""
        self._process: subprocess.Popen[bytes] | None = None
        if not _reap_orphans(True):
            return
        self._link, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._link.settimeout(_PATIENCE_S)
        with theirs:
            self._process = subprocess.Popen(
                # The last word is room: forks show their own command line there.
                [*PYTHON, "-m", _MODULE, *services, " " * _SHOWN],
                stdin=theirs.fileno(),  # it ends when the launcher is gone
                stdout=subprocess.PIPE,  # as in its forks: Python asks once whether it can seek
                stderr=subprocess.STDOUT,  # what is wrong, a service started as a program reports
                start_new_session=True,  # Ctrl-C reaches the launcher alone
            )

    def load(self, services: Sequence[str]) -> None:
        """Load the modules and compiled kernels of these services; returns at once."""
        if self._process is not None:
            try:
                self._link.send(json.dumps({"load": list(services)}).encode())
            except OSError:
                self.close()

    def start(self, arguments: Sequence[str]) -> ForkedProcess | None:
        """Start ``pliant`` with these arguments; None if it has to be started as a program."""
        if self._process is None:
            return None
        with ExitStack() as ours, ExitStack() as theirs:
            stdin, written = os.pipe()
            theirs.callback(os.close, stdin)
            writing = ours.enter_context(open(written, "wb", buffering=0))
            read, stdout = os.pipe()
            theirs.callback(os.close, stdout)
            reading = ours.enter_context(open(read, "rb"))
            try:
                request = json.dumps({"start": list(arguments)}).encode()
                socket.send_fds(self._link, [request], [stdin, stdout])
                pid = int(self._link.recv(_LONGEST))
            except (OSError, ValueError):  # it has died: it sends nothing
                self.close()
                return None
            with suppress(OSError):  # killed in the meantime
                writing.write(b"\n")  # a fork waits for this, so one that is not known here ends
            ours.pop_all()
            return ForkedProcess(pid, writing, reading)

    def close(self) -> None:
        """End the server; the services become children of this process.  May be called again."""
        if self._process is None:
            return
        self._link.close()
        self._process.kill()
        self._process.wait()
        assert self._process.stdout is not None
        self._process.stdout.close()
        self._process = None
        _reap_orphans(False)

    def __enter__(self) -> "ForkServer":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


_ahead: list[ForkServer] = []


@contextmanager
def started_ahead(services: Sequence[str]) -> Generator[None]:
    """Have a server before it is known with which options services start: reading these takes as
    long as a third of its imports."""
    with ForkServer(services) as server:
        _ahead.append(server)
        try:
            yield
        finally:
            _ahead.clear()


def server_for(services: Sequence[str]) -> ForkServer:
    """The server that was started ahead, or a new one."""
    return _ahead.pop() if _ahead else ForkServer(services)


def _reap_orphans(wanted: bool) -> bool:
    """Whether descendants whose parent ends become our children from now on, as wanted."""
    if sys.platform != "linux":
        return False
    return ctypes.CDLL(None).prctl(_SET_CHILD_SUBREAPER, int(wanted), 0, 0, 0) == 0


def _serve(services: Sequence[str]) -> None:
    """Import; load kernels and fork when requested, until the launcher has closed its end.

    Returns in each fork, with its command line in ``sys.argv``.
    """
    usual = gc.get_threshold()
    gc.set_threshold(_LOADED_OBJECTS)
    link = socket.socket(fileno=os.dup(0))
    host = importlib.import_module("pliant_services.runtime.host")
    processes = importlib.import_module("pliant_services.processes")
    commands = importlib.import_module("pliant_services.cli.commands")
    with suppress(PliantError):  # none has this name: what forks need to read theirs is imported
        commands.app(["service", "", "--connect", ""], standalone_mode=False)
    modules = [processes.BY_NAME[name].module for name in processes.in_order_of_start(services)]
    while True:
        if modules and not select.select([link], [], [], 0.0)[0]:
            importlib.import_module(modules.pop(0))
            continue
        modules.clear()
        data, files, _, _ = socket.recv_fds(link, _LONGEST, 2)
        if not data:
            os._exit(0)
        request = json.loads(data)
        for name in request.get("load", ()):
            host.load_kernels(name)
        gc.freeze()  # else a fork that looks for garbage writes to all these pages
        if "start" not in request:
            continue
        if not _is_alone():
            os._exit(1)  # a fork would lack the threads, and keep what they have locked
        pid = os.fork()
        if pid == 0:
            link.close()
            _become(request["start"], *files)
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
    """Become a session with these files and arguments, once the launcher knows of this process."""
    os.setsid()
    for file, place in ((stdin, 0), (stdout, 1), (stdout, 2)):
        os.dup2(file, place)
    os.close(stdin)
    os.close(stdout)
    if not os.read(0, 1):
        os._exit(0)
    sys.argv = ["pliant", *arguments]
    _show([*PYTHON, "-m", "pliant_services.cli", *arguments])


def _show(command: Sequence[str]) -> None:
    """Have ``ps`` show this command line in place of the server's."""
    with suppress(OSError, ValueError, IndexError):
        fields = Path("/proc/self/stat").read_text().rpartition(")")[2].split()
        start, end = int(fields[45]), int(fields[46])  # arg_start and arg_end of proc(5)
        words = b"\0".join(os.fsencode(word) for word in command)[: end - start - 1]
        with open("/proc/self/mem", "r+b", buffering=0) as memory:
            memory.seek(start)
            memory.write(words.ljust(end - start, b"\0"))


if __name__ == "__main__":
    _serve(sys.argv[1:-1])
    importlib.import_module("pliant_services.cli").main()
