"""The wheel holds the two packages and nothing else, and works where it is installed."""

import json
import math
import subprocess
import sys
import time
import tomllib
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
HEAVY = {"cv2", "matplotlib", "numba", "open3d", "scipy", "zenoh"}
HELP_SECONDS = 2.0


@pytest.fixture(scope="module")
def wheel(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Built from the files that git knows, as a clone would: caches and scratch stay out."""
    folder = tmp_path_factory.mktemp("wheel")
    run(sys.executable, "-m", "hatchling", "build", "--target", "wheel", "-d", folder, cwd=ROOT)
    (built,) = folder.glob("*.whl")
    return built


@pytest.fixture(scope="module")
def installed(wheel: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The Python of a fresh environment with the wheel; what it depends on comes from this one."""
    folder = tmp_path_factory.mktemp("environment")
    run(sys.executable, "-m", "venv", "--without-pip", folder)
    python = folder / "bin" / "python"
    run(sys.executable, "-m", "pip", "--python", python, "install", "--no-deps", "--quiet", wheel)
    site = run(python, "-c", "import sysconfig; print(sysconfig.get_path('purelib'))")
    # A plain path, unlike site.addsitedir, leaves this environment's editable install unread.
    here = [path for path in sys.path if path.endswith("site-packages")]
    (Path(site.strip()) / "dependencies.pth").write_text("\n".join(here))
    return python


def run(*command: object, cwd: Path | None = None) -> str:
    done = subprocess.run([str(c) for c in command], capture_output=True, text=True, cwd=cwd)
    assert done.returncode == 0, done.stdout + done.stderr
    return done.stdout


def test_the_wheel_holds_the_two_packages_whole_and_nothing_else(wheel: Path) -> None:
    names = zipfile.ZipFile(wheel).namelist()
    packed = {name for name in names if not name.split("/")[0].endswith(".dist-info")}
    assert {name.split("/")[0] for name in packed} == {"pliant", "pliant_services"}
    sources = {
        str(path.relative_to(folder))
        for folder in (ROOT / "shared", ROOT / "services")
        for path in folder.rglob("*")
        if path.is_file() and "__pycache__" not in path.parts
    }
    assert packed == sources
    assert {"pliant/py.typed", "pliant_services/py.typed"} <= packed
    assert all(Path(name).suffix in {".py", ".typed", ".yaml", ".json"} for name in packed)


def test_the_wheel_is_any_python_3_and_carries_its_licence(wheel: Path) -> None:
    assert wheel.name.endswith("-py3-none-any.whl")
    archive = zipfile.ZipFile(wheel)
    (metadata,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
    assert any(n.endswith(".dist-info/licenses/LICENSE") for n in archive.namelist())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    text = archive.read(metadata).decode()
    assert "License-Expression: Apache-2.0" in text
    assert f"Version: {project['version']}" in text


def test_help_of_the_installed_wheel_comes_at_once_and_loads_nothing_heavy(
    installed: Path, tmp_path: Path
) -> None:
    command = installed.with_name("pliant")
    seconds = math.inf
    for _ in range(3):  # the first start compiles bytecode; the machine may be busy
        start = time.perf_counter()
        text = run(command, "--help", cwd=tmp_path)
        seconds = min(seconds, time.perf_counter() - start)
    assert "pliant run" in text
    assert seconds < HELP_SECONDS
    loaded = run(
        installed,
        "-c",
        "import json, sys, pliant\n"
        "from pliant_services.cli import main\n"
        "sys.argv = ['pliant', '--help']\n"
        "try: main()\n"
        "except SystemExit: pass\n"
        "print(json.dumps([pliant.__file__, *sys.modules]))",
        cwd=tmp_path,
    ).splitlines()[-1]
    where, *modules = json.loads(loaded)
    assert Path(where).is_relative_to(installed.parents[1])
    assert not HEAVY & set(modules)
