"""The one way in which Pliant compiles a numba kernel.

``error_model="numpy"`` matters most: Python's own model puts division checks into loops and
keeps LLVM from vectorising them.  Nothing is compiled with ``parallel=True``, so that results do
not depend on threads.  ``fast_kernel`` lets LLVM reassociate sums and contract multiply-adds (the
result is the same on every run and every processor of the target); NaN and infinity keep their
meaning.  A kernel is kept on disk until one of the modules that it is built from changes.
"""

from collections.abc import Callable
from typing import Any, TypeVar, cast

import numba
import numba.np.arrayobj
from numba.extending import overload

from pliant.compiler.kernel_cache import SourcesCache
from pliant.compiler.kernel_linking import keep_copies_apart

_Function = TypeVar("_Function", bound=Callable[..., Any])

_OPTIONS: dict[str, Any] = {"nogil": True, "error_model": "numpy"}
# Without "arcp": by it 1 / sqrt(x) becomes an estimate, which Intel and AMD make unlike.
_FAST = {"reassoc", "contract", "nsz", "afn"}


def _shapes_differ(source: Any, target: Any) -> None:
    raise NotImplementedError


@overload(_shapes_differ)
def _raise_that_shapes_differ(source: Any, target: Any) -> Any:
    def shapes_differ(source: Any, target: Any) -> None:
        raise ValueError("cannot assign an array of another shape")

    return shapes_differ


# Numba's own names both shapes, and every process compiles its strings for three to five seconds.
numba.np.arrayobj.raise_with_shape_context = _shapes_differ


def kernel(function: _Function) -> _Function:
    """Compile with strict floating point.  Cached on disk, keyed by CPU."""
    return _compile(function)


def fast_kernel(function: _Function) -> _Function:
    """Compile with reassociation and fused multiply-add allowed, so that reductions vectorise.

    LLVM puts small ones into the kernels that call them.
    """
    return _compile(function, fastmath=_FAST)


def leaf_kernel(function: _Function) -> _Function:
    """Compile as ``fast_kernel`` does, without reference counts.  It must not make an array.

    Numba counts a reference, atomically, for every array passed to every function.  In a loop over
    tracks, whose helpers take a dozen arrays each, that costs several times more than the work.
    """
    return _compile(function, fastmath=_FAST, _nrt=False)


def inner_kernel(function: _Function) -> _Function:
    """Compile as ``leaf_kernel`` does, and put the code into every kernel that calls it.

    A call passes five to seven words for every array: with the two dozen arrays of a level and its
    scratch that takes as long as a small patch.  Loops that are to be vectorised stay calls: among
    many arrays LLVM no longer proves that they are apart.
    """
    return _compile(function, fastmath=_FAST, _nrt=False, forceinline=True)


def _compile(function: _Function, **options: Any) -> _Function:
    keep_copies_apart()
    dispatcher: Any = numba.njit(**_OPTIONS, **options)(function)
    dispatcher._cache = SourcesCache(dispatcher.py_func)
    return cast(_Function, dispatcher)
