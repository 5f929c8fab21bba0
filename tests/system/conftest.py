"""What several files of these tests look at, made once: a run costs more than all its checks."""

from pathlib import Path

import pytest
from running import TINY, pliant


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result folder of ``pliant run built-in:tiny`` with the defaults."""
    folder = tmp_path_factory.mktemp("run") / "tiny"
    done = pliant("run", TINY, "--output", folder)
    assert done.returncode == 0, done.stderr
    (folder / "logs" / "stdout").write_text(done.stdout)
    return folder
