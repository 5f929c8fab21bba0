"""Whether a run can make a mesh, decided before anything starts."""

import subprocess
import sys

from pliant.config import Config

WITH_MESH = "rigid"
"""The profile that makes a mesh."""
_TIMEOUT_S = 180.0
_IMPORT = """
from pliant.errors import PliantError
from pliant.fusion.open3d_import import require_open3d
try:
    require_open3d()
except PliantError as error:
    print(error)
"""


def choose_profile(config: Config) -> tuple[str, str]:
    """The profile of services to start, and one line that says why there is no mesh."""
    if not config.meshing.enabled:
        return "points", ""
    problem = why_no_mesh()
    return ("points", f"no mesh: {problem}") if problem else (WITH_MESH, "")


def why_no_mesh() -> str:
    """What keeps open3d from being imported, with the remedy; "" where it can be.

    Tried in a process of its own: the launcher stays small, and a library that breaks the process
    that loads it breaks only that one.
    """
    try:
        done = subprocess.run(
            [sys.executable, "-c", _IMPORT], capture_output=True, text=True, timeout=_TIMEOUT_S
        )
    except subprocess.TimeoutExpired:
        return f"open3d did not come up in {_TIMEOUT_S:.0f} s"
    if done.returncode != 0:
        words = done.stderr.strip().splitlines()
        return f"importing open3d failed: {words[-1] if words else f'code {done.returncode}'}"
    return done.stdout.strip()
