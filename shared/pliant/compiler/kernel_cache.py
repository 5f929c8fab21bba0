"""Numba's cache on disk, which notices a change in any module that a kernel is built from.

Numba stamps a cached kernel with the text of the file that it stands in.  But helpers and constants
from other files are compiled into the kernel, too.  So after an edit or an upgrade an old kernel
would silently stay in use.  Here the stamp covers every module of ours that the kernel's module
imports, directly or not.

Kernels are kept in NUMBA_CACHE_DIR, else beside their sources, else in Pliant's cache folder.
"""

import hashlib
import re
from functools import cache
from pathlib import Path
from typing import Any

from numba.core.caching import (
    CompileResultCacheImpl,
    FunctionCache,
    IndexDataCacheFile,
    InTreeCacheLocator,
    UserProvidedCacheLocator,
    UserWideCacheLocator,
)
from numba.core.runtime.nrt import rtsys

from pliant.cache import cache_folder
from pliant.errors import PliantError

_PACKAGE = Path(__file__).parents[1]
_IMPORT = re.compile(rb"^\s*from (pliant[\w.]*) import (\([^)]*\)|[^\n]*)", re.MULTILINE)


class _CacheFolder(UserWideCacheLocator):
    def __init__(self, function: Any, file: str) -> None:
        super().__init__(function, file)
        folder = cache_folder() / "kernels" / self.get_suitable_cache_subpath(file)
        self._cache_path = str(folder)


class _Place(CompileResultCacheImpl):
    _locator_classes = (UserProvidedCacheLocator, InTreeCacheLocator, _CacheFolder)


class _Index(IndexDataCacheFile):
    """An index that may name, in the types of arguments, classes of ours that are gone by now."""

    def _load_index(self) -> Any:
        try:
            return super()._load_index()
        except (AttributeError, ImportError):
            return {}


class SourcesCache(FunctionCache):
    """The cache of one kernel, stamped with all the sources it is built from."""

    _impl_class = _Place

    def __init__(self, function: Any) -> None:
        """Raises PliantError if no folder can be written."""
        try:
            super().__init__(function)
        except RuntimeError:  # of Numba, where no place will do
            raise PliantError(
                f"compiled kernels can be kept neither beside {function.__code__.co_filename} nor "
                f"in {cache_folder()}: set PLIANT_CACHE_DIR to a writable folder"
            ) from None
        stamp = hashlib.sha256()
        for path in sources(Path(function.__code__.co_filename)):
            stamp.update(_digest(path))
        self._cache_file = _Index(
            cache_path=self._cache_path,
            filename_base=self._impl.filename_base,
            source_stamp=stamp.hexdigest(),
        )

    def load_overload(self, sig: Any, target_context: Any) -> Any:
        """A kernel from disk; None if it is not there.

        Numba registers all that a compiler may need first, a tenth of a second in every process:
        machine code needs the functions that count references, no more.  Who compiles registers
        the rest then.
        """
        rtsys.initialize(target_context)
        with self._guard_against_spurious_io_errors():
            return self._load_overload(sig, target_context)
        return None


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
    """The files of ours that a module names in its imports, but for what holds no kernels."""
    files: list[Path] = []
    for module, names in _IMPORT.findall(path.read_bytes()):
        parts = module.decode().split(".")[1:]
        folder = _PACKAGE.joinpath(*parts)
        own = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
        submodules = [folder / f"{name}.py" for name in re.findall(r"\w+", names.decode())]
        files += [f for f in (own, *submodules) if f.exists() and f.parent != _PACKAGE]
    return tuple(files)


@cache
def _digest(path: Path) -> bytes:
    return hashlib.sha256(path.read_bytes()).digest()
