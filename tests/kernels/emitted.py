"""Code that a module of LLVM's holds, made to run outside of numba, shared by the tests of this folder."""

from __future__ import annotations

from typing import Any

import llvmlite.binding as llvm


def engine_of(module: Any) -> Any:
    """Return what runs a module: it keeps the code, and knows where its functions lie."""
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(str(module)), machine)
    engine.finalize_object()
    return engine
