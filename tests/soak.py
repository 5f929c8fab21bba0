"""Faults, long: see scripts/soak.  Every run must end with the bytes of the undisturbed one."""

import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator
from contextlib import ExitStack
from itertools import chain
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent / "system"))

from running import TINY, command, digests
from soak_network import hostile_rows, latency_rows, network_rows
from test_faults import SERVICES, once_at, run

from pliant.bus.session import free_endpoint, open_session
from pliant.messages import codec, topics
from pliant.messages.types import Status
from pliant_services.benchmarks import latency
from pliant_services.benchmarks.table import markdown
from pliant_services.warm_up import compile_kernels

FRAMES = 40  # of the source
TIMEOUT_S = 300.0


def with_router_killed(folder: Path, frame: int) -> dict[str, str]:
    """A session in parts whose router dies at a frame and returns; digests of its results."""
    endpoint = free_endpoint()
    common = ["--connect", endpoint, "--session", "soak", "--state", folder / "state"]
    extra: dict[str, list[object]] = {
        "ingest": ["--source", TINY],
        "recorder": ["--output", folder / "recording.mcap", "--results"],
    }
    reached = threading.Event()

    def on_sample(sample) -> None:
        end = sample.attachment is None or sample.attachment.to_bytes()[-1:] != b"\0"
        if not end and codec.decode(Status, sample.payload.to_bytes()).frame >= frame:
            reached.set()

    with ExitStack() as running:
        router = running.enter_context(_router(endpoint))
        # Connected before the first frame; its own connection need not survive.
        with open_session([endpoint]) as looking:
            key = f"pliant/soak/{topics.status('bundle_adjustment').key}"
            held = looking.declare_subscriber(key, on_sample)
            services = [
                running.enter_context(
                    subprocess.Popen(command("service", name, *common, *extra.get(name, [])))
                )
                for name in SERVICES
            ]
            assert reached.wait(TIMEOUT_S)
            router.kill()
            router.wait()
            held.undeclare()
        running.enter_context(_router(endpoint))
        assert [service.wait(TIMEOUT_S) for service in services] == [0] * len(services)
    return digests(folder)


def _router(endpoint: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        command("router", "--listen", endpoint, "--once"), stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    assert "router on" in process.stderr.readline()
    return process


def rows(kills: int, seed: int, undisturbed: dict[str, str]) -> Iterator[tuple[str, int, int]]:
    """What was killed, how often, and after how many of them the results were the same bytes."""
    random = np.random.default_rng(seed)

    def same(victim: str) -> bool:
        frame = int(random.integers(0, FRAMES - 1))
        with tempfile.TemporaryDirectory(prefix="pliant-soak-") as folder:
            if victim == "router":
                found = with_router_killed(Path(folder), frame)
            else:
                names = SERVICES if victim == "all at once" else (victim,)
                found = run(Path(folder), once_at((frame, names)))
        print(f"{victim} killed at frame {frame}: {found == undisturbed}", file=sys.stderr)
        return found == undisturbed

    for victim in (*SERVICES, "all at once", "router"):
        yield victim, kills, sum(same(victim) for _ in range(kills))


def main() -> int:
    kills, seed = (int(text) for text in [*sys.argv[1:], *("20", "0")[len(sys.argv) - 1 :]])
    compile_kernels(print)
    print("| killed | times | same bytes |\n|---|---|---|")
    whole = True
    with tempfile.TemporaryDirectory(prefix="pliant-soak-") as folder:
        undisturbed = run(Path(folder))
    for victim, times, same in rows(kills, seed, undisturbed):
        print(f"| {victim} | {times} | {same} |", flush=True)
        whole = whole and times == same
    print("\n| fault | same bytes | told meanwhile |\n|---|---|---|")
    for fault, same, told in chain(network_rows(undisturbed), hostile_rows(undisturbed)):
        print(f"| {fault} | {same} | {told} |", flush=True)
        whole = whole and same
    print("\n" + markdown(latency.HEADING, latency_rows()), flush=True)
    return 0 if whole else 1


if __name__ == "__main__":
    sys.exit(main())
