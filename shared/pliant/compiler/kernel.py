"""The one way in which Pliant compiles a numba kernel.

``error_model="numpy"`` matters most: Python's own model puts division checks into loops and
keeps LLVM from vectorising them.  Nothing is compiled with ``parallel=True``, so that results do
not depend on threads.  ``fast_kernel`` lets LLVM reassociate sums and contract multiply-adds (the
result is the same on every run and every processor of the target); NaN and infinity keep their
meaning.  A kernel is kept on disk until one of the modules that it is built from changes.
"""

from collections.abc import Callable
from functools import partial
from typing import Any, TypeVar, cast, overload

import numba
import numba.np.arrayobj
from numba import extending

from pliant.compiler.kernel_cache import SourcesCache
from pliant.compiler.kernel_linking import keep_copies_apart
from pliant.compiler.kernel_loading import parse_when_needed
from pliant.compiler.reference_counts import BorrowingCompiler
from pliant.compiler.subroutines import keep_subroutines_apart

_Function = TypeVar("_Function", bound=Callable[..., Any])

_OPTIONS: dict[str, Any] = {
    "nogil": True,
    "error_model": "numpy",
    "no_cfunc_wrapper": True,
    "pipeline_class": BorrowingCompiler,
}
# Without "arcp": by it 1 / sqrt(x) becomes an estimate, which Intel and AMD make unlike.
_FAST = {"reassoc", "contract", "nsz", "afn"}


def _shapes_differ(source: Any, target: Any) -> None:
    raise NotImplementedError


@extending.overload(_shapes_differ)
def _raise_that_shapes_differ(source: Any, target: Any) -> Any:
    def shapes_differ(source: Any, target: Any) -> None:
        raise ValueError("cannot assign an array of another shape")

    return shapes_differ


# Numba's own names both shapes, and every process compiles its strings for three to five seconds.
numba.np.arrayobj.raise_with_shape_context = _shapes_differ


def kernel(function: _Function) -> _Function:
    """Compile with strict floating point.  Cached on disk, keyed by CPU."""
    return _compile(function, fastmath=False)


@overload
def fast_kernel(function: _Function) -> _Function: ...


@overload
def fast_kernel(*, inline: bool) -> Callable[[_Function], _Function]: ...


def fast_kernel(function: Any = None, *, inline: bool = False) -> Any:
    """Compile with reassociation and fused multiply-add allowed, so that reductions vectorise.

    inline: put the code into every kernel that calls it, however long it is.  A call passes five
    to seven words for every array: with the two dozen arrays of a level and its scratch that
    takes as long as a small patch.  Loops that are to be vectorised stay calls: among many arrays
    LLVM no longer proves that they are apart.
    """
    if function is None:
        return partial(fast_kernel, inline=inline)
    return _compile(function, fastmath=_FAST, forceinline=inline)


def _compile(function: _Function, *, fastmath: Any, forceinline: bool = False) -> _Function:
    keep_copies_apart()
    keep_subroutines_apart()
    parse_when_needed()
    # What is left out here, numba takes from the kernel that happens to call this one first.
    options: dict[str, Any] = {"fastmath": fastmath, "forceinline": forceinline, "_nrt": True}
    dispatcher: Any = numba.njit(**_OPTIONS, **options)(function)
    dispatcher._cache = SourcesCache(dispatcher.py_func)
    return cast(_Function, dispatcher)
