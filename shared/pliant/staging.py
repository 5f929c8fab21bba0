"""Folders for incomplete files, next to the files that they will replace.

A folder of this kind belongs to the process that holds its lock.  One without
a holder is of a killed process: the next writer removes it.
"""

import errno
import fcntl
import os
import shutil
import tempfile
from collections.abc import Generator
from contextlib import contextmanager, suppress
from pathlib import Path

from pliant.files import is_folder, move_all, put_in_place, sync, sync_all

_PREFIX = ".partial-"


@contextmanager
def staging(folder: Path) -> Generator[Path]:
    """A new folder within another one, deleted at the end with what is left.  Raises OSError."""
    clear_staging(folder)
    path, lock = _locked_folder(folder)
    try:
        yield path
    finally:
        shutil.rmtree(path, ignore_errors=True)
        os.close(lock)


def clear_staging(folder: Path) -> None:
    """Remove what killed processes have left in a folder, as far as it can be removed."""
    for path in folder.glob(f"{_PREFIX}*"):
        with suppress(OSError):
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_NOFOLLOW | os.O_CLOEXEC)
            try:
                fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
                shutil.rmtree(path, ignore_errors=True)
            finally:
                os.close(lock)


def _locked_folder(parent: Path) -> tuple[Path, int]:
    while True:
        path = Path(tempfile.mkdtemp(prefix=_PREFIX, dir=parent))
        try:
            lock = os.open(path, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        except FileNotFoundError:  # another process took it for an abandoned one
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
        except OSError as error:
            if error.errno not in (errno.ENOLCK, errno.ENOTSUP):  # a file system without locks
                raise
        if path.is_dir():
            return path, lock
        os.close(lock)


def put_tree_in_place(made: Path, path: Path) -> None:
    """Give a file or a folder that was made in a staging folder its name.  Raises OSError.

    What is there is replaced when the new is on the disk; a folder keeps what else is in it.
    """
    if not is_folder(made):
        put_in_place(made, path)
        return
    sync_all(made)
    if is_folder(path):
        move_all(made, path)
        return
    if path.is_symlink():  # what it points to stays
        path.unlink()
    made.rename(path)
    sync(path.parent)
