"""The health of every service, published once a second for people: ``pliant status``.

Not a topic: no credit, no numbers, never recorded, and no output depends on it.
"""

import os
import resource
import socket
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np
import zenoh

from pliant.algorithms.arrays import I64, Shape
from pliant.bus.inbox import Inbox
from pliant.bus.outbox import Outbox
from pliant.errors import MessageError
from pliant.messages import codec
from pliant.messages.types import Header
from pliant.version import __version__

MAX_BYTES = 1 << 16
_STATM = Path("/proc/self/statm")
_PAGE_MIB = os.sysconf("SC_PAGE_SIZE") / (1 << 20)
_PEAK_MIB = 1.0 / (1 << 20 if sys.platform == "darwin" else 1 << 10)


@dataclass(frozen=True, kw_only=True)
class Health(Header):
    """How a service stands.  frame: messages taken of its busiest input; sent, for a source.

    stamp_ns: its clock.     waiting_for: what holds it up, "" while it works.
    input_taken, input_waiting: messages by input.     faults: repeated, early and refused ones,
    and refused credits.
    memory_mib: resident; the most that it ever was where the system does not tell (macOS).
    output_sent, output_behind, output_kept: messages by output: sent, on the way to the slowest
    reader, kept to be sent again.
    """

    service: str
    host: str
    version: str
    incarnation: int
    waiting_for: str
    memory_mib: float
    inputs: tuple[str, ...]
    input_taken: Annotated[I64, Shape("I")]
    input_waiting: Annotated[I64, Shape("I")]
    faults: int
    outputs: tuple[str, ...]
    output_sent: Annotated[I64, Shape("O")]
    output_behind: Annotated[I64, Shape("O")]
    output_kept: Annotated[I64, Shape("O")]


def health_key(service: str) -> str:
    """The key on which a service publishes its health, without the session's prefix."""
    return f"health/{service}"


def read_health(sample: zenoh.Sample) -> tuple[str, Health] | None:
    """The session and the health in a sample; None if it is not one of ours."""
    if len(sample.payload) > MAX_BYTES:
        return None
    try:
        health = codec.decode(Health, sample.payload.to_bytes())
    except MessageError:
        return None
    return str(sample.key_expr).split("/")[1], health


def health_of(
    service: str,
    incarnation: int,
    waiting_for: str,
    inputs: Mapping[str, Inbox],
    outputs: Mapping[str, Outbox],
) -> Health:
    """The health of this process."""
    taken = [box.taken for box in inputs.values()]
    sent = [box.sent for box in outputs.values()]
    return Health(
        frame=max(taken or sent, default=0),
        stamp_ns=time.time_ns(),
        frame_id="",
        service=service,
        host=socket.gethostname(),
        version=__version__,
        incarnation=incarnation,
        waiting_for=waiting_for,
        memory_mib=_memory_mib(),
        inputs=tuple(inputs),
        input_taken=np.array(taken, np.int64),
        input_waiting=np.array([len(box.waiting) for box in inputs.values()], np.int64),
        faults=sum(box.repeated + box.early + box.refused for box in inputs.values())
        + sum(box.refused for box in outputs.values()),
        outputs=tuple(outputs),
        output_sent=np.array(sent, np.int64),
        output_behind=np.array([box.on_the_way() for box in outputs.values()], np.int64),
        output_kept=np.array([box.kept() for box in outputs.values()], np.int64),
    )


def _memory_mib() -> float:
    try:
        return int(_STATM.read_text(encoding="ascii").split()[1]) * _PAGE_MIB
    except OSError:
        return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * _PEAK_MIB
