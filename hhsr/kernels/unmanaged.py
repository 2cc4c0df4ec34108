"""Decorators for kernels that own no memory: they take arrays and give numbers, so no references need counting.

Counting costs two atomic steps for each array handed to a kernel, on each call: 20 to 40 ns of a query that takes 10.
A kernel that allocates, or returns an array, cannot go without; `managed` says so where one is called by those that do.

In all of these an index counts from the start of an array: none is negative. To ask costs a twentieth of a query.

A literal handed to a kernel has its own type, for which all that it calls is compiled once more: hand over np.int64(0)
or np.bool_(True).
"""

from __future__ import annotations

from functools import partial
from typing import Any

from numba import njit, types
from numba.core import ir
from numba.core.compiler import CompilerBase, DefaultPassBuilder
from numba.core.compiler_machinery import FunctionPass, register_pass
from numba.core.typed_passes import NopythonTypeInference


def _from_start(index):
    """Return the type of an index, or of a tuple of them, whose integers have no sign."""
    if isinstance(index, types.BaseTuple):
        return types.Tuple([_from_start(part) for part in index])
    return types.uint64 if isinstance(index, types.Integer) else index


@register_pass(mutates_CFG=False, analysis_only=False)
class _IndicesFromStart(FunctionPass):
    """Read and write arrays at indices without a sign, which are not asked whether they count from the end."""

    _name = "indices_from_start"

    def __init__(self):
        super().__init__()

    def run_pass(self, state):
        given = {}
        for statement, signature in state.calltypes.items():
            indexed = isinstance(statement, ir.SetItem) or getattr(statement, "op", None) == "getitem"
            if indexed and isinstance(signature.args[0], types.Array):
                array, index, *value = signature.args
                given[statement] = signature.replace(args=(array, _from_start(index), *value))
        state.calltypes.update(given)
        return bool(given)


class _Compiler(CompilerBase):
    def define_pipelines(self):
        pipeline = DefaultPassBuilder.define_nopython_pipeline(self.state)
        pipeline.add_pass_after(_IndicesFromStart, NopythonTypeInference)
        pipeline.finalize()
        return [pipeline]


# `_nrt` is no documented option: with the runtime of references, or not. What a kernel calls inherits all these unless
# said: so it is said of `forceinline` too, or all that an inlined kernel calls would be inlined, if it came first.
_njit: Any = partial(njit, cache=True, error_model="numpy", pipeline_class=_Compiler)
unmanaged = _njit(_nrt=False, forceinline=False)
inlined = _njit(_nrt=False, forceinline=True)
managed = _njit(_nrt=True, forceinline=False)
entry = _njit(nogil=True)  # called from Python, without its lock
