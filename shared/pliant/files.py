"""Files and folders that survive a power cut, and are not written through links.

A file's fsync puts its content on the disk, but not its name, which is in its folder.  A file is
written under a new name and takes its own when it is whole: what was there before stays until then,
and where a link was there, what the link points to stays as it is.
"""

import errno
import os
import stat
from pathlib import Path
from typing import IO

# A file system that has no such thing, and a folder that may be written to, but not read.
_UNABLE = (errno.EINVAL, errno.EROFS, errno.EACCES, errno.ENOTSUP)
_PARTIAL = ".partial"


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


def sync_all(folder: Path) -> None:
    """Put all that a folder holds on the disk, and what its folders hold.  Raises OSError."""
    for path in sorted(folder.iterdir()):
        if is_folder(path):
            sync_all(path)
        else:
            sync(path)
    sync(folder)


def is_folder(path: Path) -> bool:
    """Whether it is a folder itself, not a link to one."""
    return path.is_dir() and not path.is_symlink()


def make_folder(folder: Path) -> None:
    """Make a folder and those above it, where they are not there.  Raises OSError."""
    missing = [each for each in (folder, *folder.parents) if not each.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    for each in missing:
        sync(each.parent)


def create(path: Path, *, mode: int = 0o666) -> IO[bytes]:
    """A new file, unbuffered; a file or a link of this name goes.  Raises OSError.

    What is no file, e.g. a pipe or /dev/stdout, is opened as it is.
    """
    if is_stream(path):
        return path.open("wb", buffering=0)
    path.unlink(missing_ok=True)
    descriptor = os.open(path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, mode)
    return os.fdopen(descriptor, "wb", buffering=0)


def mark(path: Path) -> None:
    """Make an empty file, where there is none.  Raises OSError."""
    os.close(os.open(path, os.O_WRONLY | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o666))


def append(path: Path) -> IO[bytes]:
    """A file to write to behind what is in it, unbuffered; a link goes.  Raises OSError."""
    if path.is_symlink():
        path.unlink()
    flags = os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_NOFOLLOW | os.O_CLOEXEC
    return os.fdopen(os.open(path, flags, 0o666), "ab", buffering=0)


def put_in_place(partial: Path, path: Path) -> None:
    """Give what was written whole its name: there is this file then, or what was there before.

    Raises OSError.
    """
    sync(partial)
    partial.replace(path)
    sync(path.parent)


def write_whole(path: Path, data: str | bytes, *, mode: int = 0o666, synced: bool = True) -> None:
    """Write a file: there is all of it then, or what was there before.  Raises OSError.

    synced: whether that also holds for a power cut.
    """
    content = data.encode(errors="surrogateescape") if isinstance(data, str) else data
    if is_stream(path):
        with path.open("wb") as file:
            file.write(content)
        return
    partial = path.with_name(path.name + _PARTIAL)
    try:
        with create(partial, mode=mode) as file:
            left = memoryview(content)
            while left:
                left = left[file.write(left) :]
        if synced:
            put_in_place(partial, path)
        else:
            partial.replace(path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def move_all(folder: Path, output: Path) -> None:
    """Put every file of a folder, all on the disk, in place in another one of the same file system.

    Folders that are there keep what else is in them; links do not.  Raises OSError.
    """
    for path in sorted(folder.iterdir()):
        target = output / path.name
        if is_folder(path) and os.path.lexists(target):
            if not is_folder(target):
                target.unlink()
                target.mkdir()
            move_all(path, target)
            path.rmdir()
        else:
            path.replace(target)
    sync(output)


def is_stream(path: Path) -> bool:
    """Whether something is no file that could be replaced: a device, a pipe, a name of one."""
    if path.parts[:2] in (("/", "dev"), ("/", "proc")):
        return path.parts[2:3] != ("shm",)
    try:
        kind = path.lstat().st_mode
    except OSError:
        return False
    return not (stat.S_ISREG(kind) or stat.S_ISLNK(kind) or stat.S_ISDIR(kind))
