"""In CI a test that is skipped for a reason that nobody has allowed fails the run."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

TESTS = Path(__file__).parents[1]
SKIPS = """
import pytest

def test_allowed(): pytest.skip("no Docker engine answers")
def test_not_installed(): pytest.skip("this needs open3d, which is not installed")
def test_why(): pytest.skip("because")
"""


@pytest.mark.parametrize("ci", [True, False])
def test_a_skip_that_is_not_allowed_fails_in_ci(ci: bool, tmp_path: Path) -> None:
    (tmp_path / "test_skips.py").write_text(SKIPS)
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-p", "conftest", "-p", "no:cacheprovider", "."],
        env={**os.environ, "PYTHONPATH": str(TESTS), "CI": "1" if ci else ""},
        cwd=tmp_path,
        capture_output=True,
        text=True,
    )
    lines = [line.split(": ")[1] for line in done.stdout.splitlines() if "ALLOWED_SKIPS" in line]
    refused = ["test_skips.py::test_not_installed", "test_skips.py::test_why"]
    assert (done.returncode, lines) == ((1, refused) if ci else (0, [])), done.stdout


def test_ci_sets_its_variable() -> None:
    assert 'CI="${CI:-1}" bash scripts/test' in (TESTS.parent / ".ci" / "run").read_text()
