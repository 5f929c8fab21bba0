"""Numba's cache on disk, which notices a change in any module that a kernel is built from.

Numba stamps a cached kernel with the text of the file that it stands in.  A helper or a constant
from another file is compiled into the kernel all the same, so that after an edit or an upgrade an
old kernel would go on running, silently.  Here the stamp covers every module of ours that the
kernel's module imports, directly or not.
"""

import hashlib
import re
from functools import cache
from pathlib import Path
from typing import Any

from numba.core.caching import FunctionCache, IndexDataCacheFile

_PACKAGE = Path(__file__).parents[1]
_IMPORT = re.compile(rb"^\s*from (pliant[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)


class SourcesCache(FunctionCache):
    """The cache of one kernel, stamped with all the sources it is built from."""

    def __init__(self, function: Any) -> None:
        super().__init__(function)
        stamp = hashlib.sha256()
        for path in sources(Path(function.__code__.co_filename)):
            stamp.update(_digest(path))
        self._cache_file = IndexDataCacheFile(
            cache_path=self._cache_path,
            filename_base=self._impl.filename_base,
            source_stamp=stamp.hexdigest(),
        )


@cache
def sources(path: Path) -> tuple[Path, ...]:
    """The file and every file of ours that it imports, directly or not, sorted."""
    found = {path}
    waiting = [path]
    while waiting:
        new = set(_imports(waiting.pop())) - found
        found |= new
        waiting += sorted(new)
    return tuple(sorted(found))


@cache
def _imports(path: Path) -> tuple[Path, ...]:
    """The files of ours that a module names in its imports."""
    files: list[Path] = []
    for module, names in _IMPORT.findall(path.read_bytes()):
        parts = module.decode().split(".")[1:]
        folder = _PACKAGE.joinpath(*parts)
        own = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
        submodules = [folder / f"{name}.py" for name in re.findall(r"\w+", names.decode())]
        files += [file for file in (own, *submodules) if file.exists()]
    return tuple(files)


@cache
def _digest(path: Path) -> bytes:
    return hashlib.sha256(path.read_bytes()).digest()
