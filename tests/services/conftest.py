"""What several files of these tests use."""

from pathlib import Path

import pytest
from recorded_clips import write_clip, write_large_clip
from result_room import made_room


@pytest.fixture(scope="session")
def clip(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_clip(tmp_path_factory.mktemp("clip") / "clip.mp4")


@pytest.fixture(scope="session")
def large(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_large_clip(tmp_path_factory.mktemp("large") / "large.avi")


@pytest.fixture
def room(tmp_path: Path) -> Path:
    return made_room(tmp_path)
