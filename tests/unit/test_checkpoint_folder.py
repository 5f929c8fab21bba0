"""A folder of checkpoints: whose it is, and what it stores once."""

import os
from pathlib import Path

import numpy as np
import pytest

from pliant.algorithms.inertial.preintegration import GyroSignal
from pliant.algorithms.inertial.samples import append, joined
from pliant.bus.checkpoints import Checkpoints, Place
from pliant.errors import BusError, StateError
from pliant.state import load_state, save_state


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


def signal() -> GyroSignal:
    return GyroSignal(times_s=np.arange(1e4), gyro=np.ones((10_000, 3)))


def saved(folder: Path, store: Checkpoints, frame: int, state: object) -> int:
    """Keep a state as a service does; returns the bytes of its file."""
    store.save(Place(frame, {}, {}), save_state(state, store), lambda: None)
    store.close()
    return (folder / f"{frame:09d}.state").stat().st_size


def test_what_never_changes_is_written_once_and_comes_back(tmp_path: Path) -> None:
    store, kept = Checkpoints(tmp_path, interval=1), signal()
    state = {"now": 1, "signal": kept, "again": kept}
    sizes = [saved(tmp_path, store, frame, state | {"now": frame}) for frame in range(3)]
    assert max(sizes) < 1000 < kept.gyro.nbytes
    assert len(list(tmp_path.glob("*.constant"))) == 1
    restarted = Checkpoints(tmp_path, interval=1)
    place = restarted.usable({})
    assert place is not None
    found = load_state(restarted.restart_from(place), restarted)
    assert found["now"] == 2
    assert found["signal"] is found["again"]
    np.testing.assert_array_equal(found["signal"].gyro, kept.gyro)
    saved(tmp_path, restarted, 3, found)
    assert len(list(tmp_path.glob("*.constant"))) == 1


def test_blocks_that_are_full_are_written_once(tmp_path: Path) -> None:
    """Samples of a live source grow: what may still change is part of each state."""
    store, blocks, more = Checkpoints(tmp_path, interval=1), list[GyroSignal](), signal()
    for frame in range(40):
        rows = slice(250 * frame, 250 * (frame + 1))
        append(blocks, GyroSignal(times_s=more.times_s[rows], gyro=more.gyro[rows]))
        saved(tmp_path, store, frame, blocks)
    assert len(blocks) == len(list(tmp_path.glob("*.constant"))) + 1 == 2
    restarted = Checkpoints(tmp_path, interval=1)
    place = restarted.usable({})
    assert place is not None
    found = joined(load_state(restarted.restart_from(place), restarted))
    np.testing.assert_array_equal(found.times_s, more.times_s)
    np.testing.assert_array_equal(found.gyro, more.gyro)


def test_a_state_whose_constant_is_gone_is_one_error(tmp_path: Path) -> None:
    store = Checkpoints(tmp_path, interval=1)
    data = save_state([signal()], store)
    (constant,) = tmp_path.glob("*.constant")
    constant.unlink()
    with pytest.raises(BusError, match="cannot read the checkpoint"):
        load_state(data, Checkpoints(tmp_path, interval=1))
    with pytest.raises(StateError, match="broken state"):
        load_state(data)
