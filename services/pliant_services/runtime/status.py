"""Looks at a session from outside: the reports of its services once a second, and their tokens."""

import threading
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import zenoh

from pliant.bus.health import Health, health_key, read_health
from pliant.bus.peers import STOP_KEY, misfit, service_of
from pliant.bus.session import Identity, is_session_name, open_session, session_name
from pliant.errors import BusError

_HEADINGS = (
    *("session", "service", "host", "version", "frame", "frames/s", "lag", "queue"),
    *("kept", "faults", "MiB", "clock ms", "waiting for"),
)


_SAY_AGAIN_S = 0.5
_SILENT = "silent: stopped, or its host is disconnected"
_READER = "this command"


@dataclass
class Seen:
    """A service: its first and last health, each with our own clock when it came (ns)."""

    session: str
    first: Health
    first_ns: int
    last: Health
    last_ns: int

    @property
    def rate(self) -> float:
        """Frames a second between the two."""
        spent_s = (self.last_ns - self.first_ns) * 1e-9
        return (self.last.frame - self.first.frame) / spent_s if spent_s > 0.0 else 0.0


def listen(
    endpoints: Sequence[str], session: str, seconds: float, identity: Identity | None = None
) -> tuple[list[Seen], list[tuple[str, str, str]]]:
    """Return the health of every service that reported it within these seconds, by session and
    name; and the session and name of those that are announced without a readable report, with the
    reason.

    Raises BusError if no router answers.
    """
    seen: dict[tuple[str, str], Seen] = {}
    announced: dict[str, tuple[str, str]] = {}

    def on_token(sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        if not is_session_name(key.split("/")[1]):
            return
        if sample.kind == zenoh.SampleKind.PUT:
            announced[key] = key.split("/")[1], service_of(key)
        else:
            announced.pop(key, None)

    def on_sample(sample: zenoh.Sample) -> None:
        found = read_health(sample)
        if found is None:
            return
        name, health = found
        expected = f"pliant/{name}/{health_key(health.service)}"
        if not is_session_name(name) or str(sample.key_expr) != expected:
            return
        now = time.time_ns()
        before = seen.get((name, health.service))
        if before is None or before.last.incarnation != health.incarnation:
            seen[name, health.service] = Seen(name, health, now, health, now)
        else:
            before.last, before.last_ns = health, now

    session = session if session == "*" else session_name(session)
    with open_session(endpoints, identity) as connection:
        tokens = f"pliant/{session}/ready/**"
        liveliness = connection.liveliness()
        subscribers = (
            connection.declare_subscriber(f"pliant/{session}/{health_key('*')}", on_sample),
            liveliness.declare_subscriber(tokens, on_token, history=True),
        )
        time.sleep(seconds)
        for subscriber in subscribers:
            subscriber.undeclare()  # type: ignore[no-untyped-call]
    silent = {
        (*name, misfit(key, _READER) or _SILENT)
        for key, name in announced.items()
        if name not in seen
    }
    return [seen[key] for key in sorted(seen)], sorted(silent)


def table(services: Sequence[Seen], silent: Sequence[tuple[str, str, str]] = ()) -> Iterator[str]:
    """The services as lines of text.  silent: session, name, and why there is no report."""
    newest: dict[str, int] = {}
    for each in services:
        newest[each.session] = max(newest.get(each.session, 0), each.last.frame)
    rows = [_HEADINGS, *(_row(each, newest[each.session]) for each in services)]
    unknown = ("-",) * (len(_HEADINGS) - 3)
    rows += [(session, name, *unknown, why) for session, name, why in silent]
    widths = [max(len(row[column]) for row in rows) for column in range(len(_HEADINGS))]
    for row in rows:
        yield "  ".join(cell.ljust(width) for cell, width in zip(row, widths)).rstrip()


def _row(each: Seen, newest: int) -> tuple[str, ...]:
    health = each.last
    return (
        each.session,
        health.service,
        health.host,
        health.version,
        str(health.frame),
        f"{each.rate:.1f}",
        str(newest - health.frame),
        str(int(health.input_waiting.sum())),
        str(int(health.output_kept.sum())),
        str(health.faults),
        f"{health.memory_mib:.0f}",
        f"{(health.stamp_ns - each.last_ns) * 1e-6:+.0f}",  # with the network's delay
        health.waiting_for or "-",
    )


def stop_session(
    endpoints: Sequence[str], session: str, patience_s: float, identity: Identity | None = None
) -> list[str]:
    """Request the end of a session, and wait until its services are gone.

    Returns those that are left.  Raises BusError if there is no such session.
    """
    here: dict[str, str] = {}
    changed = threading.Condition()

    def on_token(sample: zenoh.Sample) -> None:
        key = str(sample.key_expr)
        with changed:
            if sample.kind == zenoh.SampleKind.PUT:
                here[key] = service_of(key)
            else:
                here.pop(key, None)
            changed.notify_all()

    session_name(session)
    with open_session(endpoints, identity) as connection:
        tokens = f"pliant/{session}/ready/**"
        subscriber = connection.liveliness().declare_subscriber(tokens, on_token, history=True)
        with changed:
            if not changed.wait_for(lambda: here, timeout=3.0):
                raise BusError(f"no session {session} on {', '.join(endpoints)}")
        enough = time.monotonic() + patience_s
        with changed:
            # Again and again: the source may still be on its way up, and does not listen yet.
            while here:
                connection.put(f"pliant/{session}/{STOP_KEY}", b"")
                left_s = enough - time.monotonic()
                if left_s <= 0.0:
                    break
                changed.wait(min(left_s, _SAY_AGAIN_S))
            left = sorted(set(here.values()))
        subscriber.undeclare()  # type: ignore[no-untyped-call]
    return left
