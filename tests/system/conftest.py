"""What several files of these tests look at, made once: a run costs more than all its checks."""

import fcntl
import os
import shutil
from pathlib import Path

import pytest
from running import TINY, pliant


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result folder of ``pliant run built-in:tiny`` with the defaults: this worker's copy."""
    folder = tmp_path_factory.mktemp("run") / "tiny"
    ours = tmp_path_factory.getbasetemp()
    shared = (ours.parent if "PYTEST_XDIST_WORKER" in os.environ else ours) / "run_of_all_workers"
    with shared.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not shared.exists():
            done = pliant("run", TINY, "--output", folder)
            assert done.returncode == 0, done.stderr
            (folder / "logs" / "stdout").write_text(done.stdout)
            folder.rename(shared)
    return Path(shutil.copytree(shared, folder))
