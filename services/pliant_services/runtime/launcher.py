"""Supervises one run: starts the services in order, watches them, stops them cleanly.

The launcher hosts the router, so that a run needs no other program; every service is a process of
its own.  When the source ends, or on Ctrl-C, the end of the stream passes through the services.
Each exits once it has read everything, so no message is lost.
"""

import os
import signal
import subprocess
import threading
import time
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path

import zenoh

from pliant.bus.base import Received
from pliant.bus.links import received
from pliant.bus.peers import service_of
from pliant.bus.session import LocalRouter
from pliant.errors import BusError, MessageError, PliantError
from pliant.messages import codec, topics
from pliant.messages.topics import Topic
from pliant.messages.types import Status
from pliant.programs import PYTHON
from pliant_services.processes import BY_NAME, in_order_of_start
from pliant_services.runtime.child import Child, first_to_fail
from pliant_services.runtime.fork_server import ForkServer
from pliant_services.runtime.relay import Relay

READY_TIMEOUT_S = 120.0
STOP_TIMEOUT_S = 5.0
_POLL_S = 0.05
MOST_DEATHS = 3  # of one service at the same frame


class ServiceDiedError(PliantError):
    """A service ended with an error; the text has its name and last words.

    crashed: by a fault of its own, or a signal; its log has more.
    """

    def __init__(self, text: str, *, crashed: bool) -> None:
        super().__init__(text)
        self.crashed = crashed


class Fleet:
    """The running services of one session."""

    def __init__(
        self,
        services: Sequence[str],
        *,
        log_folder: Path,
        on_status: Callable[[Status], None],
        port: int | None = None,
        state: Path | None = None,
        server: ForkServer | None = None,
    ) -> None:
        """Start the router.  ``port``: of it on loopback; else it is at a Unix socket where that
        works.  ``state``: folder of checkpoints; with it, services that die are started again.
        ``server``: forks the services, and may have been started earlier.
        Raises BusError when the port is in use."""
        self._services = tuple(services)
        self._log_folder = log_folder
        self._children: list[Child] = []
        self._state = state
        self._gave_up = False
        self._arguments: Callable[[str], Sequence[str]] = lambda name: ()
        self._frames: dict[str, int] = {}  # that each service reported last
        self._deaths: dict[str, tuple[int, int]] = {}  # by service: at which frame, how often
        self.session = f"run-{os.getpid()}"
        self._local = LocalRouter(port)
        self.endpoint, self.note = self._local.endpoint, self._local.note
        self._server = server or ForkServer(services)
        self._router = self._local.session
        self._relay = Relay(self._router, self.session)
        self._ready: set[str] = set()
        prefix = f"pliant/{self.session}"
        status = topics.status("*")

        def on_ready(sample: zenoh.Sample) -> None:
            if sample.kind == zenoh.SampleKind.PUT:
                self._ready.add(service_of(str(sample.key_expr)))

        def on_sample(sample: zenoh.Sample) -> None:
            heard = received(status, sample)
            if heard is None or heard.is_end:
                return
            with suppress(MessageError):  # not from a service of ours
                message = codec.decode(Status, heard.data, views=True)
                if message.service in self._services:
                    self._frames[message.service] = message.frame
                    on_status(message)

        self._held = [
            self._router.liveliness().declare_subscriber(
                f"{prefix}/ready/**", on_ready, history=True
            ),
            self._router.declare_subscriber(f"{prefix}/{status.key}", on_sample),
        ]

    def start(self, arguments: Callable[[str], Sequence[str]]) -> None:
        """Start every service, and wait until all have announced themselves.

        ``arguments`` gives the further command line of each.  Raises ServiceDiedError, BusError.
        """
        self._arguments = arguments
        for name in self._services:
            (self._log_folder / f"{name}.log").unlink(missing_ok=True)
        for name in in_order_of_start(self._services):
            self._server.load([name])
            self._children.append(self._spawn(name))  # one by one: a Ctrl-C leaves none behind
        self._server.close()
        deadline = time.monotonic() + READY_TIMEOUT_S
        while not self._ready >= set(self._services):
            self._all_left()  # who dies now is started again, too
            if time.monotonic() > deadline:
                missing = sorted(set(self._services) - self._ready)
                raise BusError(
                    f"{', '.join(missing)} did not start within {READY_TIMEOUT_S:.0f} s: they may "
                    f"still compile kernels (then run again); logs: {self._log_folder}"
                )
            time.sleep(_POLL_S)

    @contextmanager
    def listening(self, topic: Topic, on_message: Callable[[Received], None]) -> Generator[None]:
        """Forward the messages of a topic as they come, possibly twice; no service waits."""

        def on_sample(sample: zenoh.Sample) -> None:
            heard = received(topic, sample)
            if heard is not None:
                on_message(heard)

        key = f"pliant/{self.session}/{topic.key}"
        declared = self._router.declare_subscriber(key, on_sample)
        try:
            yield
        finally:
            declared.undeclare()

    def wait_for_viewer(self, timeout_s: float) -> bool:
        """Wait until there is a viewer, or the time is over."""
        return self._relay.wait_for_viewer(timeout_s)

    def wait_for_last_viewer(self, timeout_s: float) -> bool:
        """Wait until there is no viewer, or the time is over."""
        return self._relay.wait_for_last_viewer(timeout_s)

    @property
    def pids(self) -> dict[str, int]:
        """Process ids by name, of those that have been started."""
        return {child.name: child.process.pid for child in self._children}

    def wait(self, on_rest: Callable[[Sequence[str]], None] = lambda names: None) -> None:
        """Wait until every service has left by itself.

        on_rest: is given, again and again, the names of those that are still there once one has
        left.

        Raises ServiceDiedError when one fails, or, where services are started again, when one dies
        three times of the same frame.
        """
        while not self._all_left():
            rest = [child.name for child in self._children if child.process.poll() is None]
            if len(rest) < len(self._children):
                on_rest(rest)
            time.sleep(_POLL_S)

    def give_up(self) -> None:
        """Restart no service from now on."""
        self._gave_up = True

    def end_source(self) -> None:
        """Request the ingest to end the stream after the present frame; the others follow."""
        for child in self._children:
            if child.name == "ingest" and child.process.poll() is None:
                child.process.send_signal(signal.SIGINT)

    def close(self) -> None:
        """Stop whatever still runs: SIGINT first, SIGKILL after five seconds; then the router.

        Takes no more than that long, and cannot be interrupted: nothing may be left behind.
        """
        with _uninterrupted():
            self._server.close()
            running = [child for child in self._children if child.process.poll() is None]
            for child in running:
                child.process.send_signal(signal.SIGINT)
            deadline = time.monotonic() + STOP_TIMEOUT_S
            for child in running:
                try:
                    child.process.wait(max(0.0, deadline - time.monotonic()))
                except subprocess.TimeoutExpired:
                    child.process.kill()
                    child.process.wait()
            for child in self._children:
                child.close()
            self._relay.close()
            with suppress(zenoh.ZError):  # a viewer that was stopped does not answer: let it be
                self._local.close()

    def _spawn(self, name: str) -> Child:
        patience = [] if self._state is not None else ["--patience", "0"]  # who dies is not awaited
        arguments = [
            *("service", name, "--connect", self.endpoint, "--session", self.session),
            *("--fleet", ",".join(self._services), "--with-launcher", *patience),
            *(("--state", str(self._state)) if self._state is not None else ()),
            *self._arguments(name),
        ]
        process = self._server.start(arguments) or subprocess.Popen(
            [*PYTHON, "-m", "pliant_services.cli", *arguments],
            stdin=subprocess.PIPE,  # never written: it closes when the launcher is gone
            stdout=subprocess.PIPE,
            stderr=subprocess.STDOUT,
            start_new_session=True,  # Ctrl-C reaches the launcher alone
        )
        return Child(name, process, self._log_folder / f"{name}.log")

    def _all_left(self) -> bool:
        """Whether every service has left by itself; those that crashed start again, if they may.

        Raises ServiceDiedError.
        """
        over = all(child.process.poll() is not None for child in self._children)
        if self._state is None or self._gave_up:
            self.raise_if_died()
            return over
        if all(c.process.poll() == 0 for c in self._children if BY_NAME[c.name].observer):
            return over  # all is on the disk: a service that dies now has no effect
        for index, child in enumerate(self._children):
            if child.failed:
                self._restart_or_raise(index, child)
                over = False  # also where all had died at once
        return over

    def _restart_or_raise(self, index: int, child: Child) -> None:
        if not child.crashed:
            raise ServiceDiedError(child.obituary(), crashed=False)
        frame = self._frames.get(child.name, max(self._frames.values(), default=-1)) + 1
        last, times = self._deaths.get(child.name, (-1, 0))
        times = times + 1 if frame == last else 1
        self._deaths[child.name] = (frame, times)
        if times >= MOST_DEATHS:
            raise ServiceDiedError(
                f"frame {frame} killed {child.name} {times} times: {child.obituary()}",
                crashed=True,
            )
        child.close()
        self._children[index] = self._spawn(child.name)

    def raise_if_died(self) -> None:
        """Raise ServiceDiedError if a service has failed."""
        first = first_to_fail(self._children)
        if first is not None:
            raise ServiceDiedError(first.obituary(), crashed=first.crashed)


@contextmanager
def _uninterrupted() -> Generator[None]:
    """Ignore Ctrl-C and its like; a thread that is not the main one cannot be interrupted."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    kinds = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
    before = [signal.signal(kind, signal.SIG_IGN) for kind in kinds]
    try:
        yield
    finally:
        for kind, handler in zip(kinds, before, strict=True):
            signal.signal(kind, handler)
