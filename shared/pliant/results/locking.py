"""The lock of a result folder, which holds even if the folder is renamed.

It is a lock of the operating system, which frees the locks of dead processes.
"""

import errno
import fcntl
import os
import stat
from contextlib import suppress
from pathlib import Path

from pliant.errors import ResultError

LOCK_NAME = ".lock"
_LONGEST = 20
"""Bytes of a lock file: the number of a process."""
_WITHOUT_LOCKS = (errno.ENOLCK, errno.ENOTSUP)
"""Errors of a file system without locks."""
_OPENED = os.O_RDWR | os.O_NOFOLLOW | os.O_NONBLOCK | os.O_CLOEXEC


class Held:
    """A result folder that this process holds."""

    def __init__(self, output: Path, kind: int = fcntl.LOCK_EX) -> None:
        """kind: LOCK_EX, or LOCK_SH for several holders.

        Raises ResultError if another process holds it, OSError if it cannot be written to.
        """
        self._name = output
        self._folder = os.open(output, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
        try:
            self._lock = self._locked(kind)
        except BaseException:
            os.close(self._folder)
            raise

    @property
    def path(self) -> Path | None:
        """The present path of the folder, which may have been renamed; None if it was deleted."""
        own = os.fstat(self._folder)
        with suppress(OSError):
            if os.path.samestat(own, os.stat(self._name)):
                return self._name
        with suppress(OSError):
            found = Path(os.readlink(f"/proc/self/fd/{self._folder}"))
            if os.path.samestat(own, os.stat(found)):
                return found
        return None

    def release(self) -> None:
        """Release the lock, and delete its file unless others hold it, too."""
        with suppress(OSError):
            try:
                fcntl.flock(self._lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except OSError as error:
                if error.errno not in _WITHOUT_LOCKS:
                    raise
            os.unlink(LOCK_NAME, dir_fd=self._folder)
        os.close(self._lock)
        os.close(self._folder)

    def _locked(self, kind: int) -> int:
        """The descriptor of a lock file with our number in it."""
        while True:
            lock = _opened(self._name, self._folder)
            try:
                fcntl.flock(lock, kind | fcntl.LOCK_NB)
                if self._has(lock):
                    os.truncate(lock, 0)
                    os.pwrite(lock, f"{os.getpid()}\n".encode(), 0)
                    return lock
            except OSError as error:
                if error.errno in _WITHOUT_LOCKS:
                    return lock
                if error.errno not in (errno.EACCES, errno.EAGAIN):
                    os.close(lock)
                    raise
                holder = _number_in(lock)
                os.close(lock)
                raise held(self._name, holder) from None
            os.close(lock)  # its holder left between our two looks, and took the file away

    def _has(self, lock: int) -> bool:
        """Whether the lock file of the folder is the one that is open."""
        with suppress(FileNotFoundError):
            there = os.stat(LOCK_NAME, dir_fd=self._folder, follow_symlinks=False)
            return os.path.samestat(os.fstat(lock), there)
        return False


def holder_of(output: Path) -> str | None:
    """The number of the process that holds a folder, "" if unknown; None: without a holder."""
    try:
        lock = os.open(output / LOCK_NAME, _OPENED)
    except OSError:
        return None
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError as error:
        if error.errno in (errno.EACCES, errno.EAGAIN):
            return _number_in(lock)
    finally:
        os.close(lock)
    return None


def held(output: Path, holder: str, *, elsewhere: bool = True) -> ResultError:
    """The error of a folder that another process holds."""
    return ResultError(
        f"{output} is being written by process {holder or '?'}: wait until it ends"
        + ", or choose another --output" * elsewhere
    )


def _opened(output: Path, folder: int) -> int:
    """Open the lock file, or create it; never the target of a link, or a file that is no lock.

    Raises ResultError, OSError.
    """
    no_lock = ResultError(f"{output / LOCK_NAME} is not a lock of Pliant: remove it")
    try:
        lock = os.open(LOCK_NAME, _OPENED | os.O_CREAT, 0o644, dir_fd=folder)
    except OSError as error:
        if error.errno in (errno.ELOOP, errno.EMLINK, errno.EISDIR, errno.ENXIO):
            raise no_lock from None
        raise
    found = os.fstat(lock)
    if not stat.S_ISREG(found.st_mode) or found.st_nlink > 1 or found.st_size > _LONGEST:
        os.close(lock)
        raise no_lock
    return lock


def _number_in(lock: int) -> str:
    text = os.pread(lock, _LONGEST, 0).decode("ascii", errors="replace").strip()
    return text if text.isdigit() else ""
