"""A folder of checkpoints that cannot be made names whose it is."""

import os
from pathlib import Path

import pytest

from pliant.bus.checkpoints import Checkpoints
from pliant.errors import BusError


def test_a_folder_of_another_user_names_the_user_to_run_as(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(folder: Path) -> None:
        raise PermissionError(13, "Permission denied")

    found = tmp_path.stat()
    monkeypatch.setattr("pliant.bus.checkpoints.make_folder", refuse)
    monkeypatch.setattr(os, "getuid", lambda: found.st_uid + 1000)
    says = f"belongs to user {found.st_uid}, this is user .*PLIANT_USER={found.st_uid}:"
    with pytest.raises(BusError, match=says):
        Checkpoints(tmp_path / "session" / "state", interval=1)
