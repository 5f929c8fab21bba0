"""Kernels on disk: kept between processes, compiled anew when what they are built from changes."""

import subprocess
import sys
from pathlib import Path

import pliant
from pliant.algorithms import kernel, kernel_cache

_KERNEL = """
from pliant.algorithms.kernel import kernel
from pliant.algorithms.constants import (
    FACTOR,
)

@kernel
def scaled(x):
    return FACTOR * x
"""
_CALL = (
    "from pliant.algorithms.scaled import scaled; "
    "print(scaled(2.0), sum(scaled.stats.cache_hits.values()))"
)


def _call(root: Path) -> str:
    command = [sys.executable, "-B", "-c", _CALL]
    done = subprocess.run(
        command, env={"PYTHONPATH": str(root)}, capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


def test_a_constant_of_another_module_changes_the_kernel(tmp_path: Path) -> None:
    package = tmp_path / "pliant" / "algorithms"
    package.mkdir(parents=True)
    for module in (kernel, kernel_cache):
        source = Path(module.__file__)
        (package / source.name).write_bytes(source.read_bytes())
    for folder in (package, package.parent):
        (folder / "__init__.py").touch()
    (package / "scaled.py").write_text(_KERNEL)

    (package / "constants.py").write_text("FACTOR = 3.0\n")
    assert _call(tmp_path) == "6.0 0"
    assert _call(tmp_path) == "6.0 1"
    (package / "constants.py").write_text("FACTOR = 5.0\n")
    assert _call(tmp_path) == "10.0 0"


def test_sources_are_followed_through_imports() -> None:
    algorithms = Path(pliant.__file__).parent / "algorithms"
    paths = kernel_cache.sources(algorithms / "tracking" / "advance.py")
    found = {str(path.relative_to(algorithms)) for path in paths}
    assert {"tracking/advance.py", "tracking/patches.py", "kernel.py", "kernel_cache.py"} <= found
    assert not any(name.startswith("bundle/") for name in found)
