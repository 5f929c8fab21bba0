"""A result folder: the names of its files, who may write it, and what a run finds there."""

import errno
import json
import os
import platform
import shutil
import subprocess
import sys
from importlib.metadata import version
from pathlib import Path
from typing import Any

from pliant import __version__
from pliant.errors import ResultError
from pliant.recording import parts

RECORDING_NAME = "recording.mcap"
CONFIG_NAME = "config.yaml"
REPORT_NAME = "report.json"
STATE_FOLDER = "state"
"""Checkpoints of the services, while a run goes on that may be started again."""
TRAJECTORY_NAME = "trajectory.txt"
SURFELS_NAME = "surfels.npz"
_RIGID_FILES = (
    TRAJECTORY_NAME,
    "trajectory_causal.txt",
    "keyframes.txt",
    "points.ply",
    REPORT_NAME,
)
SURFEL_FILES = (TRAJECTORY_NAME, SURFELS_NAME, REPORT_NAME)
MESH_FILES = ("mesh.ply", "mesh_coarse.ply", "mesh.png", "mesh_shaded.png", "mesh_normals.png")
_VERSIONS = ("eclipse-zenoh", "mcap", "msgpack", "numba", "numpy", "opencv-python-headless")


def check_output(output: Path, *, force: bool) -> None:
    """Raise ResultError where the results cannot go there.  Changes nothing."""
    try:
        if output.exists() and not output.is_dir():
            raise ResultError(f"{output} is a file: choose another --output")
        if output.is_dir() and any(output.iterdir()) and not force:
            raise ResultError(
                f"{output} exists: choose another --output, or --force to overwrite it"
            )
        parent = next(folder for folder in (output, *output.parents) if folder.exists())
    except OSError as error:
        raise _unwritable(output, error) from None
    if not parent.is_dir():
        raise ResultError(f"{output}: {parent} is a file: choose another --output")
    if not os.access(parent, os.W_OK | os.X_OK):
        raise ResultError(f"{output}: {parent} cannot be written to: choose another --output")


def prepare(output: Path, config: str) -> None:
    """Make the folder, free of earlier results, with what the services read."""
    try:
        (output / "logs").mkdir(parents=True, exist_ok=True)
        parts.remove(output / RECORDING_NAME)
        shutil.rmtree(output / STATE_FOLDER, ignore_errors=True)
        for name in (*_RIGID_FILES, *MESH_FILES, SURFELS_NAME):
            (output / name).unlink(missing_ok=True)
        for path in output.glob("*_segment_*"):
            path.unlink()
        (output / CONFIG_NAME).write_text(config, encoding="utf-8")
        metadata = json.dumps(run_metadata(config))
        (output / "logs" / "metadata.json").write_text(metadata, encoding="utf-8")
    except OSError as error:
        raise _unwritable(output, error) from None


def _unwritable(output: Path, error: OSError) -> ResultError:
    if error.errno in (errno.ENOSPC, errno.EDQUOT):
        return ResultError(
            f"{output}: the disk is full: free some space or choose another --output"
        )
    return ResultError(f"{output}: cannot be written ({error.strerror}): choose another --output")


def run_metadata(config: str) -> dict[str, dict[str, str]]:
    """What a recording says of how it was made."""
    return {
        "pliant": {
            "version": __version__,
            "commit": _commit(),
            "command": " ".join(sys.argv),
            "python": platform.python_version(),
            "host": platform.node(),
            "machine": f"{platform.system()} {platform.machine()}",
            "cpu_count": str(os.cpu_count()),
        },
        "packages": {name: version(name) for name in _VERSIONS},
        "config": {"yaml": config},
    }


def _commit() -> str:
    """The commit of the checkout that runs; "" for an installed package."""
    try:
        here = Path(__file__).parent
        command = ["git", "-C", str(here), "rev-parse", "HEAD"]
        return subprocess.run(command, capture_output=True, text=True, timeout=5).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return ""


def files_of(output: Path, report: dict[str, Any]) -> list[str]:
    """Names of the files that a run with this report has left, but for its recording."""
    always = SURFEL_FILES if report.get("profile") == "deformable" else _RIGID_FILES
    return [*always, *(name for name in MESH_FILES if (output / name).exists())]
