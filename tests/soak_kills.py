"""Services killed, long: see scripts/soak.  Each run is one of ``pliant run --on-crash restart``.

A kill comes at a random moment: so long after a random frame as a few frames take.
"""

import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, suppress
from dataclasses import dataclass, field, replace
from hashlib import sha256
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parent / "system"))

from benchmarks.endurance import forth_and_back
from running import (
    FILES,
    TINY,
    Running,
    children,
    command,
    digests,
    has_ended,
    running,
    services_of,
)

from pliant.bus.session import free_endpoint, open_session
from pliant.datasets.builtin import builtin_folder
from pliant.messages import codec, topics
from pliant.messages.types import Status
from pliant.results.folder import MESH_FILES, SESSION_NAME, SURFELS_NAME
from pliant_services.profiles import PROFILES

TIMEOUT_S, LONGEST_S = 300.0, 1800.0
LATER_S = 0.1
"""The longest time from a frame to the kill: some frames."""
SETTINGS = ("--on-crash", "restart", "--set", "bus.checkpoint_frames=6")
POWER_CUT, ROUTER = "all and the launcher, then --resume", "router"


@dataclass(frozen=True)
class Kind:
    """A kind of run.  told: the service whose frames are waited for.  each: kills in every run."""

    arguments: Sequence[str]
    services: Sequence[str]
    files: Sequence[str]
    frames: int
    told: str
    each: int = 1


Moments = Sequence[tuple[int, float]]
"""Frames, rising, and how long after each of them somebody is killed."""

POINTS = Kind((TINY, "--set", "meshing.enabled=false"), PROFILES["points"], FILES, 40,
              "bundle_adjustment")  # fmt: skip
ROOM = Kind(("built-in:room", "--set", "meshing.enabled=false"), PROFILES["points"], FILES, 300,
            "bundle_adjustment", each=5)  # fmt: skip
ROOM_ONCE = replace(ROOM, each=1)
LONG_FRAMES = 3000
MESH = Kind((TINY,), ("meshing",), (*FILES, *MESH_FILES), 40, "meshing")
SURFELS = Kind(
    ("built-in:tiny?frames=20", "--profile", "deformable", "--set", "surfels.max_surfels=300"),
    PROFILES["deformable"],
    ("trajectory.txt", SURFELS_NAME),
    20,
    "surfels",
)  # fmt: skip


@dataclass
class Tally:
    """How many kills met a service that ran, and how many runs had the same bytes."""

    victim: str
    kills: int = 0
    same: int = 0
    differing: list[str] = field(default_factory=list[str])


def long_kind(folder: Path) -> Kind:
    """The room, forth and back, killed again and again.   folder: where its source is written."""
    source = forth_and_back(builtin_folder("built-in:room"), folder, LONG_FRAMES, 30.0)
    return replace(ROOM, arguments=(str(source), *ROOM.arguments[1:]), frames=LONG_FRAMES, each=20)


def results(folder: Path, kind: Kind) -> dict[str, str]:
    """Digests of the files that depend on nothing but the input."""
    return {name: sha256((folder / name).read_bytes()).hexdigest() for name in kind.files}


def undisturbed(kind: Kind, folder: Path) -> dict[str, str]:
    """The results of a run in which nobody dies."""
    with running(*kind.arguments, *SETTINGS, "--output", folder) as run:
        code, _, errors = run.finish(LONGEST_S)
    assert code == 0, errors
    return results(folder, kind)


def rows(victims: Sequence[tuple[Kind, str]], kills: int, seed: int) -> Iterator[Tally]:
    """For each victim the runs that followed so many kills."""
    with tempfile.TemporaryDirectory(prefix="pliant-soak-") as name:
        expected: dict[str, dict[str, str]] = {}
        for kind, victim in victims:
            source = kind.arguments[0] + kind.told
            if source not in expected:
                expected[source] = undisturbed(kind, Path(name) / f"{len(expected)}")
            yield _tally(kind, victim, kills, seed, expected[source])


def _tally(kind: Kind, victim: str, kills: int, seed: int, expected: dict[str, str]) -> Tally:
    tally, random = Tally(victim), np.random.default_rng(seed)
    for _ in range(2 * kills):  # a run may be over before it is killed
        if tally.kills >= kills:
            break
        moments = sorted(
            (int(random.integers(0, kind.frames - 1)), float(random.uniform(0.0, LATER_S)))
            for _ in range(kind.each)
        )
        with tempfile.TemporaryDirectory(prefix="pliant-soak-") as folder:
            killed, found = _RUNS.get(victim, ones_killed)(kind, victim, Path(folder), moments)
        differing = [file for file in expected if found.get(file) != expected[file]]
        tally.kills += killed
        tally.same += killed if not differing else 0
        tally.differing += differing
        words = "the same bytes" if not differing else f"DIFFERS: {', '.join(differing)}"
        when = ", ".join(f"{frame} + {later:.3f} s" for frame, later in moments)
        print(f"{victim} killed at frame {when} ({killed}): {words}", file=sys.stderr)
    return tally


def ones_killed(
    kind: Kind, victim: str, folder: Path, moments: Moments
) -> tuple[int, dict[str, str]]:
    """A run in which a service, or all at once, are killed; how often they ran, and the results."""
    names = kind.services if victim == "all at once" else (victim,)
    output = folder / "run"
    killed = 0
    with running(*kind.arguments, *SETTINGS, "--output", output) as run:
        with told_by(run, output, kind.told) as told:
            for frame, later in moments:
                told.wait_for(frame)
                threading.Event().wait(later)
                killed += _kill(services_of(run.process.pid), names)
        code, _, errors = run.finish()
    if code != 0:
        print(errors, file=sys.stderr)
        return killed, {}
    return killed, results(output, kind)


def mesher_killed(
    kind: Kind, victim: str, folder: Path, moments: Moments
) -> tuple[int, dict[str, str]]:
    """A run whose mesher is killed: it begins when the others have ended.  The frame says when."""
    ((frame, later),) = moments
    output = folder / "run"
    with running(*kind.arguments, *SETTINGS, "--output", output) as run:
        run.wait_for("meshing the recording")
        threading.Event().wait(frame / kind.frames * 2.0 + later)
        meshers = children(run.process.pid, "mesh.afterwards")
        killed = _kill(dict(zip((victim,), meshers, strict=False)), (victim,))
        code, _, errors = run.finish()
    if code != 0:
        print(errors, file=sys.stderr)
        return killed, {}
    return killed, results(output, kind)


def power_cut(
    kind: Kind, victim: str, folder: Path, moments: Moments
) -> tuple[int, dict[str, str]]:
    """Everything is killed at once, the launcher, too; then the run is taken up again."""
    ((frame, later),) = moments
    output = folder / "run"
    with running(*kind.arguments, *SETTINGS, "--output", output) as run:
        with told_by(run, output, kind.told) as told:
            told.wait_for(frame)
            threading.Event().wait(later)
            services = services_of(run.process.pid)
            run.process.kill()
            killed = _kill(services, kind.services)
        run.process.wait()
        assert all(has_ended(pid, TIMEOUT_S) for pid in services.values())
    if not (output / "state").is_dir():
        return False, results(output, kind)  # it was over
    done = subprocess.run(
        command("run", kind.arguments[0], "--resume", "--output", output),
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
    )
    if done.returncode != 0:
        print(done.stderr, file=sys.stderr)
        return killed, {}
    return killed, results(output, kind)


def router_killed(
    kind: Kind, victim: str, folder: Path, moments: Moments
) -> tuple[int, dict[str, str]]:
    """A session in parts whose router dies and returns; and its results."""
    ((frame, later),) = moments
    endpoint = free_endpoint()
    config = folder / "config.yaml"
    config.write_text("bus: {checkpoint_frames: 6}\n")
    common = ["--connect", endpoint, "--session", "soak", "--state", folder / "state"]
    common += ["--config", config]
    extra: dict[str, list[object]] = {
        "ingest": ["--source", kind.arguments[0]],
        "recorder": ["--output", folder / "recording.mcap", "--results"],
    }
    with ExitStack() as stack:
        router = stack.enter_context(_router(endpoint))
        # Connected before the first frame; its own connection need not survive.
        with Followed(endpoint, "soak", kind.told) as followed:
            services = [
                stack.enter_context(
                    subprocess.Popen(command("service", name, *common, *extra.get(name, [])))
                )
                for name in kind.services
            ]
            followed.wait_for(frame)
            threading.Event().wait(later)
            router.kill()
            router.wait()
        running_still = any(service.poll() is None for service in services)
        another = stack.enter_context(_router(endpoint))
        codes = [service.wait(TIMEOUT_S) for service in services]
        another.terminate()  # nobody tells it that a session is over that ended without it
    return running_still, digests(folder) if codes == [0] * len(codes) else {}


_RUNS: dict[str, Callable[[Kind, str, Path, Moments], tuple[int, dict[str, str]]]] = {
    "meshing": mesher_killed,
    POWER_CUT: power_cut,
    ROUTER: router_killed,
}


class Followed:
    """Waits for frames that a service of a session tells of."""

    def __init__(self, endpoint: str, session: str, service: str) -> None:
        self._changed = threading.Condition()
        self._frame = -1
        self._session = open_session([endpoint])
        key = f"pliant/{session}/{topics.status(service).key}"
        self._held = self._session.declare_subscriber(key, self._on_sample)

    def _on_sample(self, sample) -> None:
        if sample.attachment is None or sample.attachment.to_bytes()[-1:] != b"\0":
            return
        frame = codec.decode(Status, sample.payload.to_bytes()).frame
        with self._changed:
            self._frame = max(frame, self._frame)
            self._changed.notify_all()

    def wait_for(self, frame: int) -> None:
        with self._changed:
            assert self._changed.wait_for(lambda: self._frame >= frame, TIMEOUT_S)

    def __enter__(self) -> "Followed":
        return self

    def __exit__(self, *_: object) -> None:
        self._session.close()


def told_by(run: Running, output: Path, service: str) -> Followed:
    """What a service of a run tells."""
    run.wait_for("services are up")
    where = json.loads((output / SESSION_NAME).read_text())
    return Followed(where["endpoint"], where["session"], service)


def _kill(pids: dict[str, int], names: Sequence[str]) -> bool:
    """Kill -9 of all of them; whether each was there."""
    killed = [name in pids for name in names]
    for name in names:
        with suppress(ProcessLookupError):
            if name in pids:
                os.kill(pids[name], signal.SIGKILL)
    return all(killed)


def _router(endpoint: str) -> subprocess.Popen[str]:
    process = subprocess.Popen(
        command("router", "--listen", endpoint, "--once"), stderr=subprocess.PIPE, text=True
    )
    assert process.stderr is not None
    assert "router on" in process.stderr.readline()
    return process
