"""Columns that grow row by row into one ``.npz``, without holding them in memory."""

import tempfile
import zipfile
from contextlib import ExitStack
from pathlib import Path
from typing import IO, Any

import numpy as np
from numpy.lib import format as npy

from pliant.errors import ResultError

_CHUNK = 1 << 22


class NpzWriter:
    """``with NpzWriter(path) as npz: npz.add("ids", rows)``; equal rows give equal bytes.

    Every array added under a name must have the same dtype and, but for its first side, shape.
    The file appears when all is well at the end.  Raises ResultError if it cannot be written.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self._stack = ExitStack()
        self._files: dict[str, IO[bytes]] = {}
        self._rows: dict[str, int] = {}
        self._kinds: dict[str, tuple[Any, tuple[int, ...]]] = {}

    def add(self, name: str, rows: Any) -> None:
        """Append (n, ...) rows to a column.  ValueError for another dtype or shape than before."""
        rows = np.ascontiguousarray(rows)
        kind = (rows.dtype.newbyteorder("<"), rows.shape[1:])
        if self._kinds.setdefault(name, kind) != kind:
            raise ValueError(f"{name}: rows of {kind}, before they were {self._kinds[name]}")
        if name not in self._files:
            file: Any = tempfile.TemporaryFile(dir=self._path.parent)  # noqa: SIM115
            self._files[name] = self._stack.enter_context(file)
        self._rows[name] = self._rows.get(name, 0) + len(rows)
        self._files[name].write(rows.astype(kind[0], copy=False).tobytes())

    def __enter__(self) -> "NpzWriter":
        return self

    def __exit__(self, failed: type[BaseException] | None, *_: object) -> None:
        with self._stack:
            if failed is None:
                try:
                    self._assemble()
                except OSError as error:
                    raise ResultError(
                        f"{self._path}: cannot be written ({error.strerror})"
                    ) from None

    def _assemble(self) -> None:
        with zipfile.ZipFile(self._path, "w") as archive:
            for name, file in self._files.items():
                dtype, shape = self._kinds[name]
                header = {
                    "descr": npy.dtype_to_descr(dtype),
                    "fortran_order": False,
                    "shape": (self._rows[name], *shape),
                }
                # A name alone, without a time: the same bytes in every run.
                entry = zipfile.ZipInfo(f"{name}.npy")
                with archive.open(entry, "w", force_zip64=True) as target:
                    npy.write_array_header_1_0(target, header)
                    file.seek(0)
                    while chunk := file.read(_CHUNK):
                        target.write(chunk)
