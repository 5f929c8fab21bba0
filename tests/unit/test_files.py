"""Files are whole or as they were before, and no link leads a writer astray."""

import fcntl
import os
from pathlib import Path

import pytest

from pliant.files import append, create, mark, move_all, write_whole
from pliant.staging import clear_staging, put_tree_in_place, staging


def test_no_writer_follows_a_link(precious: Path, tmp_path: Path) -> None:
    folder = tmp_path / "folder"
    folder.mkdir()
    names = ("created", "whole", "whole.partial", "log", "mark")
    for name in names:
        (folder / name).symlink_to(precious)
    with create(folder / "created") as file:
        file.write(b"new")
    write_whole(folder / "whole", "new")
    with append(folder / "log") as file:
        file.write(b"new")
    with pytest.raises(OSError):
        mark(folder / "mark")
    assert precious.read_text() == "precious"
    assert [(folder / name).read_text() for name in ("created", "whole", "log")] == ["new"] * 3


def test_a_file_that_cannot_be_written_leaves_the_one_before(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "a.txt"
    write_whole(file, "before")

    def full(path: Path, *, mode: int) -> object:
        return Path("/dev/full").open("wb", buffering=0)

    monkeypatch.setattr("pliant.files.create", full)
    with pytest.raises(OSError):
        write_whole(file, "after")
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == {"a.txt": "before"}


def test_what_is_no_file_is_written_to_as_it_is() -> None:
    reading, writing = os.pipe()
    write_whole(Path(f"/dev/fd/{writing}"), "through a pipe")
    os.close(writing)
    assert os.read(reading, 100) == b"through a pipe"
    os.close(reading)


def test_a_folder_is_merged_into_one_that_is_there(precious: Path, tmp_path: Path) -> None:
    made, there = tmp_path / "made", tmp_path / "there"
    for folder in (made, made / "sub", made / "new", made / "linked", there, there / "sub"):
        folder.mkdir()
    for file in ("a", "sub/b", "new/c", "linked/precious"):
        (made / file).write_text("new")
    for file in ("a", "sub/b", "sub/mine"):
        (there / file).write_text("old")
    (there / "linked").symlink_to(precious.parent)
    move_all(made, there)
    found = {str(p.relative_to(there)): p.read_text() for p in there.rglob("*") if p.is_file()}
    new = dict.fromkeys(("a", "sub/b", "new/c", "linked/precious"), "new")
    assert found == {**new, "sub/mine": "old"}
    assert precious.read_text() == "precious"


def test_what_a_killed_process_was_making_goes_and_what_a_living_one_makes_stays(
    tmp_path: Path,
) -> None:
    left = tmp_path / ".partial-left"
    left.mkdir()
    (left / "half").touch()
    with staging(tmp_path) as folder:
        assert not left.exists()
        (folder / "made").write_text("made")
        clear_staging(tmp_path)
        assert (folder / "made").exists()
        with staging(tmp_path) as other:
            assert other != folder
        put_tree_in_place(folder / "made", tmp_path / "file")
    assert {path.name for path in tmp_path.iterdir()} == {"file"}


def test_a_link_is_not_taken_for_what_was_left(precious: Path, tmp_path: Path) -> None:
    (tmp_path / ".partial-link").symlink_to(precious.parent)
    clear_staging(tmp_path)
    assert precious.exists()


def test_where_nothing_can_be_locked_nothing_is_removed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unable(*_: object) -> None:
        raise OSError(37, "No locks available")

    (tmp_path / ".partial-left").mkdir()
    monkeypatch.setattr(fcntl, "flock", unable)
    with staging(tmp_path) as folder:
        assert folder.is_dir()
    assert [path.name for path in tmp_path.iterdir()] == [".partial-left"]
