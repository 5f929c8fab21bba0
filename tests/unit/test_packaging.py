"""The wheel holds the two packages and nothing else, and works where it is installed."""

import ast
import json
import os
import re
import subprocess
import sys
import tomllib
import zipfile
from collections.abc import Iterable
from importlib.metadata import packages_distributions
from pathlib import Path

import pytest
import yaml
from packaging.requirements import Requirement

from pliant import __version__

ROOT = Path(__file__).parents[2]
HEAVY = {"cv2", "matplotlib", "numba", "open3d", "scipy", "zenoh"}


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
    env = {name: text for name, text in os.environ.items() if name != "PYTHONPATH"}
    done = subprocess.run(
        [str(part) for part in command], capture_output=True, text=True, cwd=cwd, env=env
    )
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
    assert all(
        Path(name).suffix in {".py", ".typed", ".yaml", ".json", ".html", ".js"} for name in packed
    )


def test_the_wheel_is_any_python_3_and_carries_its_licence(wheel: Path) -> None:
    assert wheel.name.endswith("-py3-none-any.whl")
    archive = zipfile.ZipFile(wheel)
    (metadata,) = [n for n in archive.namelist() if n.endswith(".dist-info/METADATA")]
    assert any(n.endswith(".dist-info/licenses/LICENSE") for n in archive.namelist())
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    text = archive.read(metadata).decode()
    assert "License-Expression: Apache-2.0" in text
    assert f"Version: {__version__}" in text
    assert project["dynamic"] == ["version"]  # it stands in one place


def test_the_archive_of_the_sources_gives_the_same_wheel(wheel: Path, tmp_path: Path) -> None:
    build = (sys.executable, "-m", "hatchling", "build", "-d", tmp_path, "--target")
    run(*build, "sdist", cwd=ROOT)
    (archive,) = tmp_path.glob("*.tar.gz")
    run("tar", "-xzf", archive, cwd=tmp_path)  # tarfile's has no safe way before Python 3.11.4
    sources = tmp_path / archive.name.removesuffix(".tar.gz")
    named = ("README.md", "LICENSE", "CHANGELOG.md", "CONTRIBUTING.md", "SECURITY.md")
    assert all((sources / name).is_file() for name in named)
    run(
        sys.executable, "-m", "hatchling", "build", "--target", "wheel", "-d", tmp_path, cwd=sources
    )
    (again,) = tmp_path.glob("*.whl")
    assert again.read_bytes() == wheel.read_bytes()


def test_what_is_imported_is_declared_and_what_is_declared_is_imported() -> None:
    """Not what comes with another package by chance; what some commands need is an extra."""
    imported = {"open3d"}  # by its name: see pliant/open3d_library.py
    for folder in (ROOT / "shared", ROOT / "services"):
        for path in folder.rglob("*.py"):
            for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
                if isinstance(node, ast.Import):
                    imported.update(alias.name.split(".")[0] for alias in node.names)
                elif isinstance(node, ast.ImportFrom):
                    imported.add((node.module or "").split(".")[0])
    imported -= {*sys.stdlib_module_names, "pliant", "pliant_services"}
    come_from = packages_distributions()
    used = distributions(name for module in imported for name in come_from.get(module, [module]))
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    extras = distributions(
        need for needs in project["optional-dependencies"].values() for need in needs
    )
    assert used - extras == distributions(
        need
        for need in project["dependencies"]
        if (marker := Requirement(need).marker) is None or marker.evaluate()
    )


def distributions(requirements: Iterable[str]) -> set[str]:
    """Their names alone, as package indices write them."""
    names = (re.split(r"[^\w.-]", requirement)[0] for requirement in requirements)
    return {re.sub(r"[-_.]+", "-", name).lower() for name in names}


def test_open3d_is_a_dependency_everywhere_and_small_where_it_can_be() -> None:
    """Its wheel without a GPU has a quarter of the size, and is for Linux on x86-64 alone."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    needs = [Requirement(need) for need in project["dependencies"]]
    machines = {("linux", "x86_64"): "open3d-cpu", ("linux", "aarch64"): "open3d"}
    for (system, machine), wanted in {**machines, ("darwin", "arm64"): "open3d"}.items():
        here = {"sys_platform": system, "platform_machine": machine}
        found = [n.name for n in needs if n.marker is not None and n.marker.evaluate(here)]
        assert found == [wanted]


def test_what_is_installed_here_fits_what_is_declared() -> None:
    """The other tests install the wheel without what it needs: that is what pip put here."""
    assert "No broken requirements" in run(sys.executable, "-m", "pip", "check")


def test_who_cites_it_finds_how() -> None:
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text(encoding="utf-8"))
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert citation["license"] == project["license"]
    assert [a["name"] for a in citation["authors"]] == [a["name"] for a in project["authors"]]


def test_help_of_the_installed_wheel_loads_nothing_heavy(installed: Path, tmp_path: Path) -> None:
    """So it comes at once; how soon is not for a test to say on a busy machine."""
    assert "pliant run" in run(installed.with_name("pliant"), "--help", cwd=tmp_path)
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
