"""What several files of these tests look at, made once: a run costs more than all its checks."""

import fcntl
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest
from running import COARSE_MESH, TINY, in_this_process


@pytest.fixture(scope="session")
def tiny_run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The result folder of ``pliant run built-in:tiny`` with a coarse mesh: this worker's copy.

    tests/system/test_readme.py runs with the defaults.
    """
    folder = tmp_path_factory.mktemp("run") / "tiny"
    ours = tmp_path_factory.getbasetemp()
    shared = (ours.parent if "PYTEST_XDIST_WORKER" in os.environ else ours) / "run_of_all_workers"
    with shared.with_suffix(".lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        if not shared.exists():
            done = in_this_process("run", TINY, *COARSE_MESH, "--output", folder)
            assert done.returncode == 0, done.stderr
            (folder / "logs" / "stdout").write_text(done.stdout)
            folder.rename(shared)
    return Path(shutil.copytree(shared, folder))


@pytest.fixture(autouse=True)
def tiny_run_stays_as_it_is(request: pytest.FixtureRequest) -> Iterator[None]:
    """A test that writes into the folder fails here: later ones would depend on the order."""
    if "tiny_run" not in request.fixturenames:
        yield
        return
    folder = request.getfixturevalue("tiny_run")
    before = _state(folder)
    yield
    assert _state(folder) == before, "this test changed the run of all tests: let it take a copy"


def _state(folder: Path) -> dict[str, tuple[int, int]]:
    """Size in bytes and time of change of each file, by its path in the folder."""
    files = {str(path.relative_to(folder)): path.stat() for path in folder.rglob("*")}
    return {name: (file.st_size, file.st_mtime_ns) for name, file in files.items()}
