"""A session from its parts: a router of its own, services started one by one, status and stop."""

import json
import stat
import subprocess
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from benchmarks.endurance import forth_and_back
from running import AS_FROM_A_SHELL, NO_MESH, command, in_this_process, pliant

from pliant import arithmetic
from pliant.bus.session import free_endpoint
from pliant.datasets.builtin import builtin_folder
from pliant.results.folder import has_frames
from pliant_services.profiles import PROFILES

pytestmark = pytest.mark.system

REFERENCE = Path(__file__).parents[1] / "data" / "reference" / "reference.mcap"


class Part(subprocess.Popen[str]):
    """A part of a session; it does not outlive a test that fails."""

    def __exit__(self, error_type: type[BaseException] | None, *rest: Any) -> None:
        if error_type is not None:
            self.kill()
        super().__exit__(error_type, *rest)


def start(*arguments: str) -> Part:
    return Part(command(*arguments), stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)


@pytest.fixture
def endpoint() -> Iterator[str]:
    found = free_endpoint()
    router = start("router", "--listen", found)
    assert router.stdout is not None
    assert "router on" in router.stdout.readline()
    yield found
    router.terminate()
    assert router.wait(20) == 0
    router.stdout.close()


def long_source(folder: Path) -> str:
    """One that goes on until it is stopped, and needs no rendering."""
    return str(forth_and_back(builtin_folder("built-in:tiny"), folder / "source", 20_000, 30.0))


def test_status_and_stop_of_a_session_in_parts(endpoint: str, tmp_path) -> None:
    extra = {
        "ingest": ["--source", long_source(tmp_path)],
        "recorder": ["--output", str(tmp_path / "recording.mcap")],
    }
    with ExitStack() as running:
        services = {
            name: running.enter_context(
                start(
                    "service", name, "--connect", endpoint, "--session", "lab", *extra.get(name, [])
                )
            )
            for name in PROFILES["points"]
        }
        rows: dict[str, str] = {}
        while not set(services) <= set(rows):  # they come up by and by
            shown = in_this_process("status", "--connect", endpoint, "--session", "lab")
            rows = {line.split()[1]: line for line in shown.stdout.splitlines()[1:]}
            assert all(service.poll() is None for service in services.values())
        assert rows["tracking"].startswith("lab ")
        stopped = in_this_process("stop", "--connect", endpoint, "--session", "lab")
        assert stopped.returncode == 0, stopped.stderr
        assert {name: service.wait(60) for name, service in services.items()} == dict.fromkeys(
            services, 0
        )
    info = in_this_process("info", str(tmp_path / "recording.mcap"))
    assert info.returncode == 0, info.stderr


def test_a_command_fixes_its_arithmetic_itself() -> None:
    """No command that a test starts has the variables from the test's own process."""
    shown = subprocess.run([*AS_FROM_A_SHELL, "env"], capture_output=True, text=True).stdout
    inherited = {line.partition("=")[0] for line in shown.splitlines()}
    assert inherited.isdisjoint(arithmetic.VARIABLES)
    (said,) = (line for line in pliant("doctor").stdout.splitlines() if "arithmetic" in line)
    assert said.split()[0] == "ok", said


def test_an_empty_router_has_no_services_and_no_session(endpoint: str) -> None:
    shown = in_this_process("status", "--connect", endpoint, "--seconds", "1.5")
    assert (shown.returncode, "no services" in shown.stderr) == (1, True)
    stopped = in_this_process("stop", "--connect", endpoint, "--session", "none")
    assert (stopped.returncode, "no session none" in stopped.stderr) == (1, True)


def test_a_run_is_found_by_its_result_folder(tmp_path: Path) -> None:
    """Its router is at a socket that only its user reaches."""
    (idle := tmp_path / "idle").mkdir()
    for name in ("status", "stop"):
        refused = in_this_process(name, str(idle))
        assert (refused.returncode, "no active run in this folder" in refused.stderr) == (1, True)
    result = tmp_path / "long"
    with start("run", long_source(tmp_path), *NO_MESH, "--output", str(result)) as run:
        rows: set[str] = set()
        while not ({"ingest", "recorder"} <= rows and has_frames(result)):
            shown = in_this_process("status", str(result), "--seconds", "1.5")
            rows = {line.split()[1] for line in shown.stdout.splitlines()[1:]}
            assert run.poll() is None
        endpoint = json.loads((result / "session.json").read_text())["endpoint"]
        socket = Path(endpoint.removeprefix("unixsock-stream/"))
        assert stat.S_ISSOCK(socket.stat().st_mode)
        assert socket.parent.stat().st_mode & 0o777 == 0o700
        stopped = in_this_process("stop", str(result))
        assert stopped.returncode == 0, stopped.stderr
        assert run.wait(120) in (0, 3)
        assert not socket.parent.exists()


def test_a_session_without_a_launcher_writes_its_results_and_ends_its_router(
    tmp_path: Path,
) -> None:
    """Started again when it is over, as by what starts services again: nothing is done twice."""
    output = tmp_path / "recording.mcap"
    extra = {
        "ingest": ["--source", "built-in:tiny"],
        "recorder": ["--output", str(output), "--results"],
    }
    written: list[bytes] = []
    for _ in range(2):
        found = free_endpoint()
        common = ["--connect", found, "--session", "lab", "--state", str(tmp_path / "state")]
        with ExitStack() as running:
            parts = [running.enter_context(start("router", "--listen", found, "--once"))]
            for name in PROFILES["points"]:
                arguments = ["service", name, *common, *extra.get(name, [])]
                parts.append(running.enter_context(start(*arguments)))
            said = [part.communicate(timeout=300)[0] for part in parts]
            assert [part.returncode for part in parts] == [0] * len(parts), said
        assert {path.name for path in tmp_path.iterdir()} == {
            *("recording.mcap", "config.yaml", "report.json", "points.ply", "keyframes.txt"),
            *("calibration.yaml", "map.pliant", "report.html"),
            *("trajectory.txt", "trajectory_online.txt", "state"),
        }
        written.append((tmp_path / "trajectory.txt").read_bytes() + output.read_bytes())
    assert "40 frames" not in "".join(said)
    assert written[0] == written[1]


def test_results_go_to_no_folder_with_another_recording(endpoint: str, tmp_path: Path) -> None:
    (tmp_path / "recording.mcap").write_bytes(b"of another session")
    output, state = str(tmp_path / "recording.mcap"), str(tmp_path / "state")
    arguments = ["--connect", endpoint, "--output", output, "--results", "--state", state]
    done = pliant("service", "recorder", *arguments)
    assert (done.returncode, "choose another folder" in done.stderr) == (1, True)


def test_a_recording_is_replayed_to_a_viewer_elsewhere(endpoint: str, tmp_path: Path) -> None:
    pytest.importorskip("rerun")
    to = ["--connect", endpoint, "--session", "replay"]
    seen = tmp_path / "seen.rrd"
    with (
        start("replay", str(REFERENCE), *to, "--rate", "max", "--loop") as player,
        start("view", *to, "--save", str(seen), "--patience", "60") as viewer,
    ):
        while not any(b"\x89PNG" in path.read_bytes() for path in tmp_path.rglob(seen.name)):
            assert viewer.poll() is None
            assert "interrupted" not in next(iter(player.stdout or []))  # a line a loop
        player.terminate()
        assert "interrupted" in player.communicate(timeout=60)[0]
        assert str(seen) in viewer.communicate(timeout=60)[0]
    assert (player.returncode, viewer.returncode) == (130, 0)


def test_an_interrupted_command_does_not_wait_for_what_zenoh_left_behind() -> None:
    code = (
        "import threading; from pliant_services import cli; cli._run = lambda _: 130; "
        "threading.Thread(target=threading.Event().wait).start(); cli.main()"
    )
    assert subprocess.run([sys.executable, "-c", code], timeout=60).returncode == 130


@pytest.mark.parametrize("moment", ["told", "over"])
@pytest.mark.parametrize("kind", ["SIGINT", "SIGTERM", "SIGHUP"])
def test_one_more_interruption_changes_neither_the_words_nor_the_code(
    kind: str, moment: str
) -> None:
    """One that comes while the first is told, and one that comes when all is done."""
    code = (
        "import atexit, os, signal; from pliant_services import cli\n"
        "from pliant_services.cli import commands\n"
        f"once_more = lambda: os.kill(os.getpid(), signal.{kind})\n"
        "def app(**options): raise KeyboardInterrupt\n"
        "say = cli._say\n"
        "def say_interrupted(*words): once_more(); return say(*words)\n"
    )
    if moment == "told":
        code += "commands.app, cli._say = app, say_interrupted\n"
    else:
        code += "commands.app = lambda **options: 0; atexit.register(once_more)\n"
    code += "cli.main()"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    expected = (130, "pliant: interrupted\n") if moment == "told" else (0, "")
    assert (done.returncode, done.stderr) == expected


@pytest.mark.parametrize(
    ("kind", "raised", "expected"),
    [("SIGINT", "signal.default_int_handler", 130), ("SIGTERM", "lambda *_: sys.exit(143)", 143)],
)
def test_an_interruption_in_a_destructor_is_not_lost(kind: str, raised: str, expected: int) -> None:
    """Python prints what a handler raises there, and goes on."""
    code = (
        "import os, signal, sys, threading; from pliant_services import cli\n"
        "from pliant_services.cli import commands\n"
        "class Closed:\n"
        f"    def __del__(self): os.kill(os.getpid(), signal.{kind}); list(range(9))\n"
        "def app(**options):\n"
        f"    signal.signal(signal.{kind}, {raised})\n"
        "    Closed()\n"
        "    threading.Event().wait()\n"
        "commands.app = app\n"
        "cli.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60)
    assert (done.returncode, "Traceback" in done.stderr) == (expected, False), done.stderr


def test_what_a_signal_ends_without_a_word_does_not_wait_either() -> None:
    code = (
        "import sys, threading; from pliant_services import cli\n"
        "from pliant_services.cli import commands\n"
        "commands.app = lambda **options: sys.exit(143)\n"
        "threading.Thread(target=threading.Event().wait).start(); cli.main()"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, timeout=60)
    assert (done.returncode, done.stderr) == (143, b"")
