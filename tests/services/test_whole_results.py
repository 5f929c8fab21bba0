"""Results appear all at once, whoever is killed meanwhile, and nothing is written through links."""

import json
import os
from collections.abc import Callable
from pathlib import Path

import pytest
from result_room import contents

from pliant.bus.checkpoints import Checkpoints, Place
from pliant.config import config_yaml, load_config
from pliant.errors import ResultError
from pliant.export.export import EXPORTS, export_result
from pliant.results.folder import all_or_none, check_free, prepare, written
from pliant.results.write import write_results
from pliant_services.runtime.announced import announced, running_session

OLD = ("trajectory.txt", "report.json", "points.ply")
CONFIG = config_yaml(load_config())


class KilledError(BaseException):
    """The process is gone: nothing after it is done."""


def killed_at(step: int, monkeypatch: pytest.MonkeyPatch) -> Callable[[], int]:
    """Let the process die at the n-th renaming; what it would do then is not done.  Returns how
    many came."""
    count = 0
    for name in ("rename", "replace"):
        real = getattr(os, name)

        def counted(*arguments: object, real: Callable[..., None] = real) -> None:
            nonlocal count
            count += 1
            if count > step:
                raise KilledError
            real(*arguments)

        monkeypatch.setattr(os, name, counted)
    return lambda: count


def write(room: Path) -> None:
    with written(room, force=True), all_or_none(room) as folder:
        for name in OLD:
            (folder / name).write_text("new")


@pytest.mark.parametrize("step", range(6))
def test_who_is_killed_has_switched_all_files_or_none(
    step: int, room: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def texts() -> set[str]:
        return {(room / name).read_text() for name in OLD}

    before = texts()
    with monkeypatch.context() as patch:
        came = killed_at(step, patch)
        if step < 4:
            with pytest.raises(KilledError):
                write(room)
        else:
            write(room)
            assert came() == 4  # the folder of results, and each of them
    assert texts() & {"new"} == ({"new"} if step > 1 else set())
    check_free(room)  # whoever comes next
    assert texts() == ({"new"} if step > 0 else before)
    write(room)
    assert [path.name for path in room.glob(".*")] == []


def test_a_folder_in_the_way_leaves_all_as_it_was(room: Path) -> None:
    (room / "points.ply").unlink()
    (room / "points.ply").mkdir()
    before = contents(room)
    with pytest.raises(ResultError, match=r"points\.ply is a folder"):
        write(room)
    assert contents(room) == before


def test_a_lock_that_is_a_link_empties_nothing(precious: Path, tmp_path: Path) -> None:
    folder = tmp_path / "new"
    folder.mkdir()
    lock = folder / ".lock"
    for link in (os.symlink, os.link):
        link(precious, lock)
        with pytest.raises(ResultError, match=r"\.lock is not a lock of Pliant: remove it$"):
            write(folder)
        assert precious.read_text() == "precious"
        lock.unlink()
    os.mkfifo(lock)
    with pytest.raises(ResultError, match="is not a lock"):
        write(folder)


def test_nothing_is_written_through_a_link(precious: Path, room: Path) -> None:
    """All names that a run writes lead elsewhere, as in a folder that somebody else has made."""
    names = [p.name for p in room.iterdir() if p.is_file() and p.name != "recording.mcap"]
    names += ["session.json", "map.pliant", "mesh.ply", "calibration.yaml"]
    for name in [*names, *(f"{name}.partial" for name in names)]:
        (room / name).unlink(missing_ok=True)
        (room / name).symlink_to(precious)
    for folder in ("logs", "state"):
        if (room / folder).is_dir():
            (room / folder / "metadata.json").unlink()
            (room / folder).rmdir()
        (room / folder).symlink_to(precious.parent)
    recording = (room / "recording.mcap").read_bytes()
    with written(room, force=True):
        prepare(room, CONFIG)
        (room / "recording.mcap").write_bytes(recording)
        with announced(room, "tcp/127.0.0.1:1", "run-1"):
            write_results(room)
        checkpoints = Checkpoints(room / "state" / "tracking", interval=1)
        checkpoints.save(Place(0, {}, {}), b"state", lambda: None)
        checkpoints.close()
    assert {path.name: path.read_text() for path in precious.parent.iterdir()} == {
        "precious": "precious"
    }


def test_an_export_that_fails_leaves_what_was_there(
    precious: Path, room: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(recording: object, path: Path, folder: object) -> None:
        if path.suffix:
            path.write_text("half")
        else:
            path.mkdir()
            (path / "half").touch()
        raise ResultError(f"{path}: cannot go on")

    for kind in ("ply", "images"):
        monkeypatch.setitem(EXPORTS, kind, (EXPORTS[kind][0], fails))
    (room / "points_longest.ply").write_text("before")
    (room / "images").mkdir()
    (room / "images" / "mine").write_text("mine")
    before = contents(room)
    for kind in ("ply", "images"):
        with pytest.raises(ResultError, match=f"^{room / EXPORTS[kind][0]}: cannot go on$"):
            export_result(room, kind, None, force=True)
    assert contents(room) == before
    assert list(room.glob(".partial-*")) == []


def test_an_export_replaces_a_link_and_not_what_it_leads_to(
    precious: Path, room: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def makes(recording: object, path: Path, folder: object) -> None:
        made = path if path.suffix else path / "precious"
        made.parent.mkdir(exist_ok=True)
        made.write_text("made")

    for kind, target in (("ply", precious), ("images", precious.parent)):
        monkeypatch.setitem(EXPORTS, kind, (EXPORTS[kind][0], makes))
        (room / EXPORTS[kind][0]).symlink_to(target)
        export_result(room, kind, None, force=True)
        assert not (room / EXPORTS[kind][0]).is_symlink()
    assert precious.read_text() == "precious"


def say(room: Path, endpoint: str, session: str = "run-1") -> None:
    (room / "session.json").write_text(json.dumps({"endpoint": endpoint, "session": session}))


def test_a_session_is_believed_while_its_folder_is_held(room: Path) -> None:
    for endpoint in ("unixsock-stream//tmp/pliant-a/bus", "tcp/127.0.0.1:7447", "tcp/[::1]:7447"):
        with written(room, force=True):
            say(room, endpoint)
            assert running_session(room) == ([endpoint], "run-1")
            other = room.with_name("renamed")
            room.rename(other)
            assert running_session(other) == ([endpoint], "run-1")
            other.rename(room)
        assert not (room / "session.json").exists()
        say(room, endpoint)  # as a run that was killed leaves it
        assert running_session(room) == ([], "")


@pytest.mark.parametrize(
    "endpoint",
    [
        *("tcp/192.0.2.1:7447", "tcp/example.org:7447", "tls/127.0.0.1:7447", "udp/127.0.0.1:7447"),
        *("tcp/127.0.0.1:7447#iface=eth0", "tcp/127.0.0.1:7447?prio=1", "", "unixsock-stream", 7),
    ],
)
def test_a_folder_sends_no_viewer_to_another_host(endpoint: str, room: Path) -> None:
    with written(room, force=True):
        say(room, endpoint)
        assert running_session(room) == ([], "")


def test_a_session_that_ends_leaves_the_announcement_of_another_folder(room: Path) -> None:
    with announced(room, "tcp/127.0.0.1:1", "run-1"):
        say(room, "tcp/127.0.0.1:2", "run-2")
    assert "run-2" in (room / "session.json").read_text()
