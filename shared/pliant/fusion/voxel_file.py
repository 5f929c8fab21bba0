"""Memory for voxels: up to a limit in RAM, beyond it in a temporary file.

The file is mapped, so that kernels read and write it as memory.  What a keyframe does not see stays
on disk, and time per keyframe does not depend on the size of the scene.
"""

import mmap
import os
import shutil
import tempfile
from typing import IO

import numpy as np

from pliant.algorithms.arrays import I32
from pliant.algorithms.meshing.mesh_blocks import BLOCK_BYTES
from pliant.algorithms.meshing.tsdf_blocks import InMemory

_GROWTH = 1.25
"""Nothing is copied as a file grows, so it can stay near what is needed."""
_COPIED = 4096
"""Blocks at a time, when memory is full of them."""
_SHARE_OF_FREE = 0.5
"""Maximum share of the free disk: other programs need some, too."""


class VoxelFile(InMemory):
    """A context manager.  The files have no name and vanish with the process.

    size_bytes: of the files, 0 while all is in memory.
    """

    def __init__(self, memory_bytes: int) -> None:
        """memory_bytes: beyond these all voxels are in files."""
        self._memory_bytes = memory_bytes
        self._folder = _folder()
        free = shutil.disk_usage(self._folder).free
        self.most = max(1, int(memory_bytes + _SHARE_OF_FREE * free) // BLOCK_BYTES)
        self._files: list[IO[bytes]] = []
        self._maps: list[mmap.mmap] = []
        self.size_bytes = 0

    def __enter__(self) -> "VoxelFile":
        return self

    def __exit__(self, *_: object) -> None:
        self._maps = []  # unmapped when the last array is gone
        for file in self._files:
            file.close()

    def grow(self, sums: list[I32], used: int, least: int) -> None:
        """As in memory while that is within the limit.  OSError where the disk is full."""
        if 2 * least * BLOCK_BYTES <= self._memory_bytes:
            super().grow(sums, used, least)
            return
        room = int(_GROWTH * least)
        was_in_memory = not self._files
        if was_in_memory:
            self._files = [self._new_file() for _ in sums]
            self._maps = [mmap.mmap(-1, 1) for _ in sums]
        self.size_bytes = 0
        for k, (old, file) in enumerate(zip(sums, self._files, strict=True)):
            size = room * old[:1].nbytes
            # Taken now: without room a later write would kill the process.
            os.posix_fallocate(file.fileno(), 0, size)
            self._maps[k] = mmap.mmap(file.fileno(), size)
            sums[k] = np.frombuffer(self._maps[k], np.int32).reshape(room, *old.shape[1:])
            if was_in_memory:
                for first in range(0, used, _COPIED):
                    rows = slice(first, min(first + _COPIED, used))
                    sums[k][rows] = old[rows]
                    self._maps[k].madvise(mmap.MADV_DONTNEED)
            self.size_bytes += size

    def let_go(self) -> None:
        """Only the disk need hold what is in files: their pages are read again when needed."""
        for mapped in self._maps:
            mapped.madvise(mmap.MADV_DONTNEED)

    def _new_file(self) -> IO[bytes]:
        return tempfile.TemporaryFile(prefix="pliant-voxels-", dir=self._folder)


def _folder() -> str:
    """/tmp is often memory; /var/tmp never is."""
    if os.environ.get("TMPDIR") or not os.access("/var/tmp", os.W_OK):
        return tempfile.gettempdir()
    return "/var/tmp"
