"""The keeper of a bus: a thread that reports counts once a second, and sends requested messages
again.

If it fails, the service's own thread raises the error at its next use of the bus.
"""

import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

from pliant.bus.checkpoints import Checkpoints, Place
from pliant.bus.faults import FaultLog
from pliant.bus.health import health_key, health_of
from pliant.bus.links import IF_OLD, NOTHING, NOW, InLink, OutLink, Shared
from pliant.bus.waits import TICK_S, Waiting
from pliant.messages import codec

_ASK_AGAIN_S = 0.1  # a requested message takes a while; nonsense requests nothing


@dataclass
class Keeper:
    """Speaks for its service, in parallel with the service's own thread.

    restored: the service's position is valid; before that nothing is reported.
    on_tick: called once a second.     on_fault: called with one line about skipped messages.
    """

    shared: Shared
    waiting: Waiting
    inputs: Mapping[str, InLink]
    outputs: Mapping[str, OutLink]
    checkpoints: Checkpoints | None
    restored: bool
    on_tick: Callable[[], None]
    on_fault: Callable[[str], None]
    _closing: bool = False
    _greeting: bool = False  # a peer appeared: report our counts
    _done: bool = False
    _strangers_reported: int = 0
    _place: Place = field(default_factory=lambda: Place(-1, {}, {}))

    def __post_init__(self) -> None:
        self._fault_log = FaultLog(self.shared.peers.service)
        self._thread = threading.Thread(target=self._run, daemon=True)

    def start(self) -> None:
        """Start the thread."""
        self._thread.start()

    def stop(self) -> None:
        """Report nothing more."""
        self._closing = True
        self.shared.wake.set()
        self._thread.join()

    def begin(self) -> None:
        """The service's position is known: messages that it takes from now on count."""
        self.restored = True
        self.greet()

    def greet(self) -> None:
        """Report our counts, soon."""
        self._greeting = True
        self.shared.wake.set()

    def report(self, entry: InLink, request: int = NOTHING) -> None:
        """Report our counts to a sender."""
        if self.restored:  # before that, what we took is not ours
            entry.report(self.shared.peers.incarnation, request)

    def all_is_safe(self) -> None:
        """We are done: no sender needs to keep anything for us."""
        self._done = True
        with self.shared.changed:
            for entry in self.inputs.values():
                entry.safe = entry.box.taken
        for entry in self.inputs.values():
            self.report(entry)

    def report_faults(self) -> None:
        """Report what, and who, was passed over since the last call."""
        inputs = {key: entry.box for key, entry in self.inputs.items()}
        outputs = {key: output.box for key, output in self.outputs.items()}
        with self.shared.changed:
            faults = [self._fault_log.line(inputs, outputs), *self._strangers()]
        for fault in filter(None, faults):
            self.on_fault(fault)

    def _strangers(self) -> list[str]:
        strangers = list(self.shared.peers.strangers.values())
        reported, self._strangers_reported = self._strangers_reported, len(strangers)
        return strangers[reported:]

    def _run(self) -> None:
        try:
            self._keep()
        except Exception as error:  # whatever it is: the service's thread raises it
            with self.shared.changed:
                self.shared.peers.failure = error
                self.shared.changed.notify_all()

    def _keep(self) -> None:
        wake = self.shared.wake
        last_tick = time.monotonic()
        while not self._closing:
            gap = any(entry.box.gap for entry in self.inputs.values())
            soon = gap or self.shared.dropping
            pause_s = _ASK_AGAIN_S if soon else last_tick + TICK_S - time.monotonic()
            wake.wait(max(0.0, pause_s))
            wake.clear()
            tick = time.monotonic() - last_tick >= TICK_S
            last_tick = time.monotonic() if tick else last_tick
            if self._closing:
                return
            if tick:
                self._report_health()
                self.on_tick()
            if not self.restored:
                continue
            greeting, self._greeting = self._greeting, False
            self._advance_safe()
            for entry in self.inputs.values():
                self._keep_input(entry, tick=tick, greeting=greeting)
            for output in self.outputs.values():
                output.send_again()
                output.remind()
                if tick:
                    output.sent_at_tick = output.box.sent

    def _report_health(self) -> None:
        inputs = {key: entry.box for key, entry in self.inputs.items()}
        outputs = {key: output.box for key, output in self.outputs.items()}
        shared = self.shared
        with shared.changed:
            waiting = self.waiting.description(time.monotonic())
            health = health_of(
                self.shared.peers.service, shared.peers.incarnation, waiting, inputs, outputs
            )
        self.report_faults()
        shared.session.put(f"{shared.prefix}/{health_key(health.service)}", codec.encode(health))

    def _advance_safe(self) -> None:
        """Messages before our newest usable checkpoint will not be requested again."""
        if self.checkpoints is None or self._done:
            return
        with self.shared.changed:
            safe = {key: output.box.safe() for key, output in self.outputs.items()}
        place = self.checkpoints.usable(safe)
        if place is None or place == self._place:
            return
        self._place = place
        with self.shared.changed:
            for key, taken in place.inputs.items():
                self.inputs[key].safe = max(self.inputs[key].safe, taken)

    def _keep_input(self, entry: InLink, *, tick: bool, greeting: bool) -> None:
        with self.shared.changed:
            request = NOTHING
            now = time.monotonic()
            if entry.box.gap and now - entry.requested_at >= _ASK_AGAIN_S:
                entry.box.gap, entry.requested_at, request = False, now, NOW
            elif tick and entry.wanted and not entry.arrived:
                request = IF_OLD
            if tick:
                entry.arrived = False
        if request or tick or greeting:
            self.report(entry, request)
