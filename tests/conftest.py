"""Fixtures of all tests."""

import os
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
SHARED_DATA = ROOT.parent / "shared" / "data"

# As the launcher does for its services: results must not depend on threads.
for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "NUMBA_NUM_THREADS"):
    os.environ.setdefault(name, "1")


@pytest.fixture(scope="session")
def rigid_data() -> Path:
    """The real sequences, where they are at hand."""
    folder = SHARED_DATA / "rigid"
    if not folder.is_dir():
        pytest.skip("the real sequences are not here (../shared/data/rigid)")
    return folder
