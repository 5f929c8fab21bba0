"""No reference counts where a kernel makes no array.

Numba counts a reference, atomically, for every array passed to every function.  In a loop over
tracks, whose helpers take a dozen arrays each, that costs several times more than the work.  What
only reads and writes arrays that its caller holds, and returns none, needs no count.
"""

from typing import Any

from numba.core import ir, types
from numba.core.compiler import Compiler
from numba.core.compiler_machinery import AnalysisPass, register_pass
from numba.core.typed_passes import IRLegalization

_VIEWS = {
    "cast", "build_tuple", "getattr", "getitem", "typed_getitem", "static_getitem",
    "getiter", "iternext", "pair_first", "exhaust_iter", "phi",
}  # fmt: skip
"""Expressions whose arrays are those that they were made of; all others may be new."""
_VIEW_METHODS = {"array.reshape", "array.view"}


@register_pass(mutates_CFG=False, analysis_only=True)
class _LeaveCountsOut(AnalysisPass):  # type: ignore[misc]
    _name = "leave_counts_out"

    def __init__(self) -> None:
        AnalysisPass.__init__(self)

    def run_pass(self, state: Any) -> Any:
        statements = (s for block in state.func_ir.blocks.values() for s in block.body)
        if not _counted(state, state.return_type) and not any(_makes(state, s) for s in statements):
            state.targetctx = state.targetctx.subtarget(enable_nrt=False)
        return False


class BorrowingCompiler(Compiler):
    """Numba's compiler, without counts for what makes no array."""

    def define_pipelines(self) -> Any:
        """Numba's own passes, and ours before code is made."""
        pipelines = super().define_pipelines()
        for pipeline in pipelines:
            pipeline.add_pass_after(_LeaveCountsOut, IRLegalization)
            pipeline.finalize()
        return pipelines


def _counted(state: Any, numba_type: Any) -> bool:
    return state.targetctx.data_model_manager[numba_type].contains_nrt_meminfo()


def _makes(state: Any, statement: Any) -> bool:
    """Whether a statement may make an array, or keep one where no caller holds it."""
    types_of = state.typemap
    if isinstance(statement, ir.SetItem | ir.StaticSetItem):  # copied first where they overlap
        return _counted(state, types_of[statement.value.name])
    if not isinstance(statement, ir.Assign) or not isinstance(statement.value, ir.Expr):
        return False
    value = statement.value
    if not _counted(state, types_of[statement.target.name]):
        return False
    if value.op == "call":
        called = types_of[value.func.name]
        method = called.typing_key if isinstance(called, types.BoundFunction) else None
        return method not in _VIEW_METHODS and not isinstance(called, types.NamedTupleClass)
    if value.op == "getitem":  # an array of indices takes elements into an array of their own
        index = types_of[value.index.name]
        parts = getattr(index, "types", (index,))
        return any(isinstance(part, types.Array) for part in parts)
    return value.op not in _VIEWS
