"""What one hop over the bus adds: from ``publish`` in one process to ``receive`` in another.

The processes are this module, too: ``python -m benchmarks.latency ROLE ENDPOINT
[CERTIFICATES]``; ``tests/soak.py`` runs them on two hosts.
"""

import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator, Sequence
from importlib.util import find_spec
from pathlib import Path

import numpy as np

from benchmarks.table import markdown
from pliant.bus.session import Identity, free_endpoint
from pliant.bus.zenoh_bus import ZenohBus
from pliant.errors import PliantError
from pliant.messages import topics
from pliant.messages.types import Image
from pliant_services.security.access import NAMES
from pliant_services.security.certificates import make_certificates

HEADING = ("image of 361 kB", "images", "p50 ms", "p99 ms")
WIDTH, HEIGHT = 752, 480
_RATE = 30.0  # images a second
_WARM = 30  # images that are not counted: connections, caches
_SENDER, _READER = "ingest", "tracking"


def measure(images: int) -> Iterator[str]:
    """One host: TCP, and mutual TLS with access control where certificates can be made."""
    endpoint = free_endpoint()
    rows = [("one host, TCP", *hop(endpoint, images))]
    if find_spec("cryptography") is not None:
        with tempfile.TemporaryDirectory() as folder:
            certificates = Path(folder) / "certs"
            make_certificates(certificates, NAMES, ["127.0.0.1"])
            secure = free_endpoint().replace("tcp/", "tls/")
            rows.append(("one host, TLS", *hop(secure, images, certificates=certificates)))
    yield markdown(HEADING, rows)


def hop(
    endpoint: str,
    images: int,
    *,
    certificates: Path | None = None,
    place: Callable[[str, Sequence[str]], list[str]] = lambda role, command: list(command),
) -> tuple[str, str, str]:
    """Send images through a router; returns their number, and the times as text.

    place: the command line that runs another one where a role (router, sender, reader) is.
    """
    python = (sys.executable, "-m")
    tls = ("--tls", str(certificates)) if certificates is not None else ()
    router = (*python, "pliant_services.cli", "router", "--listen", endpoint, *tls)
    more = (str(certificates),) if certificates is not None else ()

    def start(role: str, command: Sequence[str]) -> "subprocess.Popen[str]":
        pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.STDOUT, "text": True}
        return subprocess.Popen(place(role, command), **pipes)  # type: ignore[call-overload]

    running = [start("router", router)]
    try:
        assert running[0].stdout is not None
        running[0].stdout.readline()  # it listens
        for role in ("reader", "sender"):
            own = (*python, __name__, role, endpoint, str(images), *more)
            running.append(start(role, own))
        said, _ = running[1].communicate()
    finally:
        for process in running:
            process.kill()
            process.wait()
            if process.stdout is not None:
                process.stdout.close()
    if running[1].returncode != 0:
        raise PliantError(f"no image came: {said.strip()}")
    times_ms = np.array(said.split(), np.float64)[_WARM:]
    p50, p99 = np.percentile(times_ms, [50.0, 99.0])
    return str(len(times_ms)), f"{p50:.2f}", f"{p99:.2f}"


def _bus(name: str, endpoint: str, certificates: str | None) -> ZenohBus:
    reads = name == _READER
    return ZenohBus(
        endpoints=[endpoint],
        session="latency",
        service=name,
        inputs={topics.IMAGE: _SENDER} if reads else {},
        outputs={} if reads else {topics.IMAGE: (_READER,)},
        window=16,
        identity=Identity.in_folder(Path(certificates), name) if certificates else None,
    )


def _send(endpoint: str, images: int, certificates: str | None) -> None:
    grey = np.random.default_rng(0).integers(0, 256, (HEIGHT, WIDTH), np.uint8)
    none = np.zeros((0, 0, 3), np.uint8)
    with _bus(_SENDER, endpoint, certificates) as bus:
        start = time.monotonic()
        for number in range(images + _WARM):
            time.sleep(max(0.0, start + number / _RATE - time.monotonic()))
            now_ns = time.monotonic_ns()  # of the whole machine, namespaces or not
            image = Image(frame=number, stamp_ns=now_ns, frame_id="", grey=grey, colour=none)
            bus.publish(topics.IMAGE, image)
        bus.end_all()
        bus.see_off()


def _read(endpoint: str, certificates: str | None) -> None:
    with _bus(_READER, endpoint, certificates) as bus:
        times = [time.monotonic_ns() - image.stamp_ns for image in bus.receive(topics.IMAGE)]
        bus.see_off()
    print(" ".join(f"{spent * 1e-6:.4f}" for spent in times))


if __name__ == "__main__":
    role, to, count, *folder = sys.argv[1:]
    certificates_in = folder[0] if folder else None
    if role == "sender":
        _send(to, int(count), certificates_in)
    else:
        _read(to, certificates_in)
