"""Numba's own subroutines, compiled with the options of the kernel that calls them.

What Numba does not write out in a kernel, ``x ** n`` for example, it compiles as a subroutine.
That has the arithmetic of the first kernel that needs it, and is kept for all kernels of the
process.  So a strict kernel would round as a fast one does, or the other way round, depending on
which was compiled first.  Here kernels share a subroutine only with kernels of the same options.
"""

from typing import Any

from numba.core.base import BaseContext


def keep_subroutines_apart() -> None:
    """Have kernels with other options compile subroutines of their own.

    Repeated calls do nothing.  Raises AttributeError if Numba keeps subroutines otherwise.
    """
    target: Any = BaseContext
    subtarget = target.subtarget
    if getattr(subtarget, "keeps_apart", False):
        return
    shared: dict[Any, dict[Any, Any]] = {}

    def subtarget_with_own(self: Any, **options: Any) -> Any:
        made = subtarget(self, **options)
        fast = tuple(sorted(getattr(made.fastmath, "flags", ())))
        kind = id(made.codegen()), fast, made.enable_nrt
        made.cached_internal_func = shared.setdefault(kind, type(made.cached_internal_func)())
        return made

    subtarget_with_own.keeps_apart = True  # type: ignore[attr-defined]
    target.subtarget = subtarget_with_own
