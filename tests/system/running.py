"""Starts ``pliant`` as a process, and waits for its lines, its end and the end of its services."""

import io
import os
import re
import select
import signal
import subprocess
import sys
from collections.abc import Generator, Sequence
from contextlib import chdir, contextmanager, redirect_stderr, redirect_stdout
from hashlib import sha256
from pathlib import Path
from typing import Any
from unittest.mock import patch

import cv2
import numpy as np
import pytest
import yaml

from pliant import arithmetic
from pliant.results.folder import has_frames
from pliant_services import cli

TINY = "built-in:tiny"
TIMEOUT_S = 300
AS_FROM_A_SHELL = ["env", *(f"-u{name}" for name in arithmetic.VARIABLES)]
"""Before a command: without what `import pliant` has set in this process, which a user's shell has
not.  A command that forgot to fix its arithmetic would not be seen otherwise."""
UP = "services are up"
NO_MESH = ("--set", "meshing.enabled=false")
"""For tests of what does not end in a mesh: a process and a third of a run's work less."""
COARSE_MESH = ("--set", "meshing.tsdf.fine_voxel=0.03")
"""For tests of what has a mesh, whatever its detail: a quarter of a run's work less."""
FILES = ("trajectory.txt", "trajectory_online.txt", "keyframes.txt", "points.ply")
"""Of a run's results, those that depend on nothing but its input."""


def undescribed(report: dict[str, Any]) -> set[str]:
    """Fields of a report.json that docs/outputs.md does not tell, those within the ones that have
    a set of their own included."""
    outputs = (Path(__file__).parents[2] / "docs" / "outputs.md").read_text(encoding="utf-8")
    section = re.split(r"^## ", outputs, flags=re.MULTILINE)
    (told,) = (part for part in section if part.startswith("report.json"))
    fields = set(report)
    for name in ("known_map", "calibration_correction", "recorder"):
        fields |= set(report.get(name) or {})
    for name in ("segments", "mesh"):
        fields |= {field for each in report.get(name, []) for field in each}
    for stages in report["milliseconds_per_frame"].values():
        fields |= {field for stage in stages.values() for field in stage}
    return fields - set(re.findall(r"`(\w+)`", told))


def digests(folder: Path) -> dict[str, str]:
    """Of the result files: thousands of differing bytes tell a reader nothing."""
    return {name: sha256((folder / name).read_bytes()).hexdigest() for name in FILES}


def command(*arguments: object) -> list[str]:
    return [*AS_FROM_A_SHELL, sys.executable, "-m", "pliant_services.cli", *map(str, arguments)]


def pliant(
    *arguments: object, cwd: Path | None = None, env: dict[str, str] | None = None
) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        command(*arguments),
        capture_output=True,
        text=True,
        timeout=TIMEOUT_S,
        cwd=cwd,
        env={**os.environ, **(env or {})},
    )


def in_this_process(
    *arguments: object, cwd: Path | None = None
) -> subprocess.CompletedProcess[str]:
    """As `pliant`, where the command's own process is not tested: it takes a second to start."""
    words, output, errors = list(map(str, arguments)), io.StringIO(), io.StringIO()
    with (
        chdir(cwd or Path.cwd()),
        patch.object(sys, "argv", ["pliant", *words]),
        redirect_stdout(output),
        redirect_stderr(errors),
        pytest.raises(SystemExit) as ended,
    ):
        cli.run_and_exit()
    code = ended.value.code
    assert isinstance(code, int)
    return subprocess.CompletedProcess(words, code, output.getvalue(), errors.getvalue())


class Running:
    """A ``pliant run`` that goes on."""

    def __init__(self, process: subprocess.Popen[str]) -> None:
        self.process = process
        self.services: dict[str, int] = {}

    def wait_for(self, text: str) -> None:
        """Block until a line on stderr has the text."""
        assert self.process.stderr is not None
        seen: list[str] = []
        for line in self.process.stderr:
            seen.append(line)
            if text in line:
                self.services = services_of(self.process.pid)
                return
        raise AssertionError(f"{text!r} did not come:\n{''.join(seen)}")

    def wait_for_frames(self, folder: Path) -> None:
        """Block until the recording in the result folder has a frame."""
        while not has_frames(folder):
            assert self.process.poll() is None

    def send(self, kind: signal.Signals, service: str = "") -> None:
        os.kill(self.services[service] if service else self.process.pid, kind)

    def finish(self, timeout_s: float = TIMEOUT_S) -> tuple[int, str, str]:
        """Exit code, stdout, and stderr from here on; no service may outlive its launcher."""
        output, errors = self.process.communicate(timeout=timeout_s)
        survivors = [name for name, pid in self.services.items() if not has_ended(pid, 0.0)]
        assert not survivors, f"{survivors} outlived the launcher"
        assert "Traceback" not in errors, errors
        return self.process.returncode, output, errors


@contextmanager
def running(
    *arguments: object, env: dict[str, str] | None = None, start_new_session: bool = False
) -> Generator[Running]:
    process = subprocess.Popen(
        command("run", *arguments),
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, **(env or {})},
        start_new_session=start_new_session,
    )
    try:
        yield Running(process)
    finally:
        process.kill()
        process.communicate()


def services_of(pid: int) -> dict[str, int]:
    """Process ids of a launcher's services by name."""
    rows = _children(pid)
    return {row[row.index("service") + 1]: int(row[0]) for row in rows if "service" in row}


def children(pid: int, text: str) -> list[int]:
    """Process ids of those children whose command has the text."""
    return [int(row[0]) for row in _children(pid) if text in " ".join(row)]


def _children(pid: int) -> list[list[str]]:
    listed = subprocess.run(
        ["ps", "-ww", "-o", "pid=,args=", "--ppid", str(pid)], capture_output=True, text=True
    )
    return [row.split() for row in listed.stdout.splitlines()]


def has_ended(pid: int, timeout_s: float) -> bool:
    """Whether a process, perhaps not a child of ours, ends within the time."""
    try:
        handle = os.pidfd_open(pid)
    except ProcessLookupError:
        return True
    try:
        return bool(select.select([handle], [], [], timeout_s)[0])
    finally:
        os.close(handle)


def assert_one_line(done: subprocess.CompletedProcess[str], text: str, code: int = 1) -> None:
    assert done.returncode == code, done.stderr
    assert text in done.stderr
    assert "Traceback" not in done.stderr
    assert len(done.stderr.strip().splitlines()) == 1, done.stderr


def write_sequence(
    folder: Path,
    images: Sequence[np.ndarray | bytes],
    *,
    stamps: Sequence[float] | None = None,
    **calibration: object,
) -> Path:
    """A folder with rgb.txt and calib.yaml; bytes are written as they are, as a file that lies."""
    (folder / "images").mkdir(parents=True)
    lines: list[str] = []
    for i, image in enumerate(images):
        name = f"images/{i:04d}.png"
        data = image if isinstance(image, bytes) else cv2.imencode(".png", image)[1].tobytes()
        (folder / name).write_bytes(data)
        lines.append(f"{i / 30 if stamps is None else stamps[i]:.6f} {name}")
    (folder / "rgb.txt").write_text("\n".join(lines) + "\n")
    height, width = next(i for i in images if not isinstance(i, bytes)).shape[:2]
    content: dict[str, object] = {"model": "pinhole", "width": width, "height": height}
    focal = 0.9 * max(width, height)
    content |= {"fx": focal, "fy": focal, "cx": width / 2, "cy": height / 2}
    content |= calibration
    kept = {key: value for key, value in content.items() if value is not None}
    (folder / "calib.yaml").write_text(yaml.safe_dump(kept))
    return folder
