"""Files and folders that are still there after a power cut: names are data, too.

A file's fsync puts its content on the disk, but not its name: that stands in its folder.
"""

import errno
import os
from pathlib import Path

# A file system that has no such thing, and a folder that may be written to, but not read.
_UNABLE = (errno.EINVAL, errno.EROFS, errno.EACCES, errno.ENOTSUP)


def sync(path: Path) -> None:
    """Put a file's content, or the names in a folder, on the disk.  Raises OSError."""
    try:
        descriptor = os.open(path, os.O_RDONLY)
        try:
            os.fsync(descriptor)
        finally:
            os.close(descriptor)
    except OSError as error:
        if error.errno not in _UNABLE:
            raise


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, where they are not there.  Raises OSError."""
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for each in missing:
        sync(each.parent)


def put_in_place(partial: Path, path: Path) -> None:
    """Give what was written whole its name: there is this file then, or what was there before.

    Raises OSError.
    """
    sync(partial)
    partial.replace(path)
    sync(path.parent)


def write_whole(path: Path, text: str) -> None:
    """Write a small file: there is all of it then, or what was there before.  Raises OSError."""
    partial = path.with_name(path.name + ".partial")
    partial.write_text(text, encoding="utf-8")
    put_in_place(partial, path)


def move_all(folder: Path, output: Path) -> None:
    """Put every file of a folder in place in another one of the same file system.

    Raises OSError.
    """
    files = sorted(folder.iterdir())
    for file in files:
        sync(file)
    for file in files:
        file.replace(output / file.name)
    sync(output)
