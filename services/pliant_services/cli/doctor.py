"""``pliant doctor``: checks this installation."""

import importlib
import shutil
import sys
import time
from dataclasses import dataclass
from typing import Literal

import typer

from pliant import arithmetic
from pliant.cache import cache_folder
from pliant.errors import PliantError
from pliant.open3d_library import OPEN3D_IS_FOR, Open3dError, load_open3d

_PACKAGES = {
    "eclipse-zenoh": "zenoh",
    "mcap": "mcap",
    "msgpack": "msgpack",
    "numba": "numba",
    "numpy": "numpy",
    "opencv-python-headless": "cv2",
    "pydantic": "pydantic",
}
_FREE_BYTES = 2 << 30


@dataclass(frozen=True)
class Finding:
    """One check.  detail: the result, and the remedy if it is not ok."""

    grade: Literal["ok", "warning", "error"]
    what: str
    detail: str = ""


def doctor() -> None:
    """Check the installation, and print a fix for each problem.

    pliant doctor
    """
    findings = diagnose()
    for finding in findings:
        detail = f": {finding.detail}" if finding.detail else ""
        typer.echo(f"{finding.grade:>7}  {finding.what}{detail}")
    if any(finding.grade == "error" for finding in findings):
        raise typer.Exit(1)


def diagnose() -> list[Finding]:
    """Every check, in the order in which a user would mend them."""
    return [
        _python(),
        *(_package(distribution, module) for distribution, module in _PACKAGES.items()),
        _optional("matplotlib", "plots of `pliant eval`", "pip install 'pliant[plot]'"),
        _open3d(),
        _arithmetic(),
        _scratch(),
        _bus(),
    ]


def _python() -> Finding:
    found = ".".join(str(part) for part in sys.version_info[:3])
    if (3, 11) <= sys.version_info[:2] <= (3, 13):
        return Finding("ok", "python", found)
    return Finding("error", "python", f"{found}; pliant needs 3.11, 3.12 or 3.13")


def _package(distribution: str, module: str) -> Finding:
    from importlib.metadata import version  # which a help page does not need

    try:
        importlib.import_module(module)
        return Finding("ok", distribution, version(distribution))
    except (ImportError, OSError) as error:
        remedy = f"pip install --force-reinstall {distribution}"
        return Finding("error", distribution, f"{_line(error)}; {remedy}")


def _optional(module: str, purpose: str, remedy: str) -> Finding:
    try:
        return Finding("ok", module, str(importlib.import_module(module).__version__))
    except (ImportError, OSError) as error:
        return Finding("warning", module, f"{_line(error)}; for {purpose}: {remedy}")


def _open3d() -> Finding:
    try:
        return Finding("ok", "open3d", str(load_open3d().__version__))
    except Open3dError as error:
        return Finding("warning", "open3d", f"{error}; for {OPEN3D_IS_FOR}")


def _arithmetic() -> Finding:
    try:
        strays = arithmetic.strays()
    except (ImportError, OSError) as error:  # a package is missing, or broken
        remedy = "pip install --force-reinstall pliant"
        return Finding("error", "arithmetic", f"{_line(error)}; {remedy}")
    if strays:
        remedy = (
            "results differ from other machines; pip install --upgrade numpy opencv-python-headless"
        )
        return Finding("warning", "arithmetic", f"{', '.join(strays)}: {remedy}")
    return Finding("ok", "arithmetic", arithmetic.target())


def _scratch() -> Finding:
    folder = cache_folder()
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".probe"
        probe.touch()
        probe.unlink()
    except OSError as error:
        remedy = "set PLIANT_CACHE_DIR to a writable folder"
        return Finding("error", "cache folder", f"{folder}: {error.strerror}; {remedy}")
    free = shutil.disk_usage(folder).free
    grade: Literal["ok", "warning"] = "ok" if free > _FREE_BYTES else "warning"
    return Finding(grade, "cache folder", f"{folder}, {free / 2**30:.1f} GiB free")


def _bus() -> Finding:
    from pliant.bus.session import free_endpoint, open_router, open_session

    endpoint = free_endpoint()
    start = time.monotonic()
    try:
        with open_router(endpoint), open_session([endpoint]):
            pass
    except PliantError as error:
        return Finding("error", "zenoh on loopback", str(error))
    return Finding("ok", "zenoh on loopback", f"{1e3 * (time.monotonic() - start):.0f} ms")


def _line(error: Exception) -> str:
    return (str(error).splitlines() or [type(error).__name__])[0]
