"""Faults of networks, long: see scripts/soak.  Rows of tables."""

import signal
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from pathlib import Path

from pliant.datasets.source_spec import SourceSpec

sys.path.insert(0, str(Path(__file__).parent / "system"))

import pytest
from benchmarks import latency
from hosts import THREE, TWO, Hosts, Spread, hosts
from watched_runs import run, run_attacked

from pliant_services.run.command import RunRequest
from pliant_services.runtime.launcher import Fleet, ServiceDiedError
from pliant_services.security.access import NAMES
from pliant_services.security.certificates import make_certificates

CUTS_S = (5.0, 30.0, 60.0)
STOP_S = 60.0
FAULT_FRAME = 10
HOSTILE = 100_000  # on each key
LONG = RunRequest(
    source=SourceSpec(location="built-in:room")
)  # a few frames go on every ten seconds of the attack
IMAGES = 1000
Row = tuple[str, bool, str]


def network_rows(undisturbed: dict[str, str]) -> Iterator[Row]:
    """What happened, whether the results were the same bytes, and what the status said."""
    with ExitStack() as stack:
        try:
            three = stack.enter_context(hosts("camera", "edge", "rack"))
        except pytest.skip.Exception as reason:
            print(f"not on several hosts: {reason}", file=sys.stderr)
            return
        for host in ("camera", "edge", "rack"):
            for seconds in CUTS_S:

                def cut(session: Spread, host: str = host, seconds: float = seconds) -> str:
                    three.cut(host)
                    time.sleep(seconds)
                    said = session.status()
                    three.join(host)
                    return said

                yield _row(f"{host} cut off for {seconds:.0f} s", three, cut, undisturbed)
        for service in ("tracking", "bundle_adjustment", "recorder"):

            def stop(session: Spread, service: str = service) -> str:
                session.send(signal.SIGSTOP, service)
                time.sleep(STOP_S)
                said = session.status()
                session.send(signal.SIGCONT, service)
                return said

            yield _row(f"{service} stopped for {STOP_S:.0f} s", three, stop, undisturbed)


def _row(
    name: str, three: Hosts, fault: Callable[[Spread], str], undisturbed: dict[str, str]
) -> Row:
    with (
        tempfile.TemporaryDirectory(prefix="pliant-soak-") as folder,
        Spread(three, Path(folder), THREE) as session,
    ):
        session.start()
        session.wait_for_frame("bundle_adjustment", FAULT_FRAME)
        said = fault(session)
        found = session.results()
    differing = sorted(file for file in undisturbed if found[file] != undisturbed[file])
    rows = [line.split(maxsplit=12) for line in said.splitlines()[1:]]
    waits = [f"{row[1]}: {row[12]}" for row in rows if ", for " in row[12] or "told" in row[12]]
    print(f"{name}: {differing or 'the same bytes'}", file=sys.stderr)
    return name, not differing and bool(waits), "; ".join(waits)


def hostile_rows(_: dict[str, str]) -> Iterator[Row]:
    """So many messages of nobody on each key, and the lines that the logs have of them."""
    with tempfile.TemporaryDirectory(prefix="pliant-soak-") as folder:
        first, second = Path(folder) / "first", Path(folder) / "second"
        for output in (first, second):
            output.mkdir()
        expected = run(first, request=LONG)
        ended, found, resident = "", dict[str, str](), dict[str, list[int]]()

        def watch(fleet: Fleet) -> None:
            for name, pid in fleet.pids.items():
                with suppress(OSError):  # who has done its part leaves
                    resident.setdefault(name, []).append(resident_mib(pid))

        start = time.monotonic()
        try:
            found = run_attacked(second, first / "recording.mcap", HOSTILE, LONG, watch)
        except ServiceDiedError as error:
            ended = f"; the run ended: {error}"
        spent_s = time.monotonic() - start
        logs = sorted((second / "logs").glob("*.log"))
        lines = ", ".join(f"{log.stem} {len(log.read_text().splitlines())}" for log in logs)
    grown = ", ".join(f"{name} {mib[0]} to {mib[-1]}" for name, mib in resident.items() if mib)
    yield (
        f"{HOSTILE} messages of nobody on each key",
        found == expected,
        f"{spent_s:.0f} s; lines of the logs: {lines}; MiB during the attack: {grown}{ended}",
    )


def resident_mib(pid: int) -> int:
    """Resident memory of a process."""
    words = Path(f"/proc/{pid}/status").read_text().split()
    return int(words[words.index("VmRSS:") + 1]) >> 10


def latency_rows() -> Iterator[Sequence[str]]:
    """A hop between two hosts, with mutual TLS."""
    with ExitStack() as stack:
        try:
            two = stack.enter_context(hosts("robot", "rack"))
        except pytest.skip.Exception:
            return
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory())) / "certs"
        address = two.address(TWO["recorder"])
        make_certificates(folder, NAMES, [address])
        where = {"router": "rack", "reader": "rack", "sender": "robot"}
        yield (
            "two hosts, TLS",
            *latency.hop(
                f"tls/{address}:7447",
                IMAGES,
                certificates=folder,
                place=lambda role, command: two.command(where[role], *command),
            ),
        )
