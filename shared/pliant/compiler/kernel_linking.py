"""Kernels that run the same code, whatever process compiled them or was loaded before.

Numba compiles the helpers of a kernel into the kernel's own object file once more, optimised
together with it, and under the names that they have in theirs.  The linker takes equal names for
equal code and keeps the one that it met first.  So a process that has just compiled a helper calls
that one from the kernel; a process that loads the kernel from disk calls the copy inside it, and
where two kernels bring a copy each, the first one's.  With fast arithmetic the copies need not
round alike, and results would depend on whether and where a kernel was compiled.  Here the copies
in an object file are its own.
"""

from typing import Any

import numba.core.codegen


def keep_copies_apart() -> None:
    """Have every kernel of this process call the helpers in its own object file.

    Repeated calls do nothing.  Raises AttributeError if Numba finishes modules otherwise.
    """
    library: Any = numba.core.codegen.JITCodeLibrary
    finish = library._finalize_final_module
    if getattr(finish, "keeps_copies_apart", False):
        return

    def finish_with_own_copies(self: Any) -> None:
        copies = [
            function
            for function in self._final_module.functions
            if not function.is_declaration and function.linkage.name == "linkonce_odr"
        ]
        for function in copies:
            function.linkage = "internal"
        finish(self)
        for function in copies:  # as others expect it that link this module into theirs
            function.linkage = "linkonce_odr"

    finish_with_own_copies.keeps_copies_apart = True  # type: ignore[attr-defined]
    library._finalize_final_module = finish_with_own_copies
