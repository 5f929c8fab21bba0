"""Kernels that are loaded from disk without their intermediate code.

Beside a kernel's machine code numba keeps its LLVM code, which is linked into kernels that call it
and are compiled later.  Numba parses that, and lists its symbols, whenever it loads the kernel.
Here it is parsed when a kernel that is compiled needs it: where all kernels are on disk, never.
"""

from typing import Any

import llvmlite.binding as llvm
import numba.core.codegen


def parse_when_needed() -> None:
    """Have this process parse the intermediate code of loaded kernels only where it is linked.

    Repeated calls do nothing.  Raises AttributeError if Numba loads kernels otherwise.
    """
    library: Any = numba.core.codegen.JITCodeLibrary
    load, link = library._unserialize.__func__, library._get_module_for_linking
    address = library.get_pointer_to_function
    if getattr(link, "parses_when_needed", False):
        return

    def load_unparsed(cls: Any, codegen: Any, state: Any) -> Any:
        name, kind, data = state
        if kind != "object":
            return load(cls, codegen, state)
        loaded = codegen.create_library(name)
        loaded.enable_object_caching()
        machine_code, loaded.unparsed = data
        loaded._set_compiled_object(machine_code)
        loaded._finalize_final_module()
        return loaded

    def parse_and_link(self: Any) -> Any:
        if getattr(self, "unparsed", None) is not None:
            self._shared_module = llvm.parse_bitcode(self.unparsed)
            self._codegen._engine._load_defined_symbols(self._shared_module)
            self.unparsed = None
        return link(self)

    def address_of(self: Any, name: str) -> Any:
        if getattr(self, "unparsed", None) is not None:  # numba looks in its list of symbols first
            return self._codegen._engine.get_function_address(name)
        return address(self, name)

    parse_and_link.parses_when_needed = True  # type: ignore[attr-defined]
    library._unserialize = classmethod(load_unparsed)
    library._get_module_for_linking = parse_and_link
    library.get_pointer_to_function = address_of
