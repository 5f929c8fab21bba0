"""The other services in the session, by their liveliness tokens.

A token is ``ready/<service>/<incarnation>/<wire version>/<release>+<schema>``.  The incarnation
differs in each start of a service, so that the late end of an old token is not mistaken for the
death of the restarted service.  A state machine without a socket; the caller passes the time.
"""

import re
from collections.abc import Collection, Iterable
from dataclasses import dataclass, field

from pliant.errors import BusError, SessionOverError
from pliant.messages import codec
from pliant.messages.topics import TOPICS, status
from pliant.version import __version__

WIRE_VERSION = 6
"""Version of envelopes and credits; services of different versions refuse each other."""
SCHEMA = codec.schema_hash([topic.message for topic in (*TOPICS, status("*"))])
"""Hash of the messages' fields: with other fields a message would be misread."""

STOP_KEY, OVER_KEY = "control/stop", "control/over"
"""The keys of announcements to a whole session, without its prefix: to end, and ended."""

_MOST_STRANGERS = 16

_TOKEN = re.compile(r"/ready/([^/]+)/(\d{1,20})/(\d{1,9})/([^/]{1,60})$")


def token_key(service: str, incarnation: int) -> str:
    """The key of a service's token, without the session's prefix."""
    return f"ready/{service}/{incarnation}/{WIRE_VERSION}/{__version__}+{SCHEMA}"


def service_of(key: str) -> str:
    """The service whose token a key is."""
    return key.split("/ready/", 1)[1].split("/")[0]


def misfit(key: str, reader: str) -> str:
    """The error for a token of another version than this reader's; "" if it fits, and for
    none of ours."""
    match = _TOKEN.search(key)
    if match is None:
        return ""
    name, _, wire, version = match.groups()
    release, _, schema = version.partition("+")
    if (int(wire), schema) == (WIRE_VERSION, SCHEMA):
        return ""
    return (
        f"{name} is pliant {release} (wire version {wire}, messages {schema or '-'}), "
        f"{reader} is {__version__} (wire version {WIRE_VERSION}, messages {SCHEMA})"
    )


@dataclass
class Peers:
    """The services that are here, and since when those that went away are gone."""

    service: str
    incarnation: int
    needed: Collection[str] = ()
    """Services that we read from, or that read from us."""
    here: dict[str, set[int]] = field(default_factory=dict[str, set[int]])
    gone_since: dict[str, float] = field(default_factory=dict[str, float])
    met: dict[str, set[int]] = field(default_factory=dict[str, set[int]])
    """Every incarnation that was here, of each service."""
    refusal: str = ""
    """Why this service cannot take part; "" while it can."""
    failure: Exception | None = None
    """The error of a thread of the bus."""
    strangers: dict[str, str] = field(default_factory=dict[str, str])
    """The note on peers of another version that no service here needs, by name: once."""
    over: bool = False
    """Whether the recorder has said that everything is on its disk."""
    stays: bool = False
    """Whether another start of this service cannot take over."""

    def on_token(self, key: str, *, alive: bool, now: float) -> str:
        """Take note of a token that appeared or vanished; returns the service it is of, "" where
        it is none of ours.

        One of another version does not take part; where we need it, and have none of ours, neither
        do we.
        """
        match = _TOKEN.search(key)
        if match is None:
            return ""
        name, number = match.groups()[:2]
        words = misfit(key, self.service)
        if words:
            if alive and name in self.needed and not self.here.get(name):
                self.refusal = f"{words}: install the same version everywhere"
            elif alive and len(self.strangers) < _MOST_STRANGERS:
                self.strangers.setdefault(name, f"{words}: passed over")
            return ""
        incarnations = self.here.setdefault(name, set())
        if not alive:
            incarnations.discard(int(number))
            if not incarnations:
                self.gone_since.setdefault(name, now)
            return name
        incarnations.add(int(number))
        self.met.setdefault(name, set()).add(int(number))
        self.gone_since.pop(name, None)
        if name == self.service and int(number) > self.incarnation and not self.stays:
            self.refusal = f"another {name} has replaced this one in the session"
        return name

    def is_known(self, name: str, incarnation: int) -> bool:
        """Whether a service may speak as this incarnation: none was announced before, or this."""
        return incarnation in self.met.get(name, {incarnation})

    def left(self, name: str) -> set[int]:
        """Incarnations of a service that were here and are no more."""
        return self.met.get(name, set()) - self.here.get(name, set())

    def seen(self, names: Iterable[str]) -> bool:
        """Whether all of them are here, or have been."""
        return all(self.here.get(name) or name in self.gone_since for name in names)

    def expect(self, names: Iterable[str], now: float) -> None:
        """Count services that were here before us as absent until their token appears."""
        for name in names:
            if not self.here.get(name):
                self.gone_since.setdefault(name, now)

    def missing(self, names: Iterable[str]) -> list[str]:
        """Absent services, sorted."""
        return sorted(name for name in names if not self.here.get(name))

    def absent(self, names: Iterable[str]) -> str:
        """Absent services as text: "tracking (away)"; "" if all are present."""
        missing = dict.fromkeys(self.missing(names))
        return ", ".join(
            f"{name} ({'away' if name in self.gone_since else 'not here yet'})" for name in missing
        )

    def lost(self, names: Iterable[str], *, patience_s: float, now: float) -> list[str]:
        """Services absent for longer than we wait, sorted."""
        gone = self.gone_since
        return sorted(name for name in names if name in gone and now - gone[name] >= patience_s)

    def raise_if_failed(self) -> None:
        """Raise what a thread of the bus failed of."""
        if self.failure is not None:
            raise self.failure

    def raise_if_refused(self) -> None:
        """Raise BusError if versions do not fit or a newer one of us is there, SessionOverError
        if there is nothing to wait for any more; and what a thread of the bus failed of."""
        self.raise_if_failed()
        if self.over:
            raise SessionOverError(f"{self.service}: the session is over")
        if self.refusal:
            raise BusError(self.refusal)
