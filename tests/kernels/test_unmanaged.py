"""What the decorators of kernels promise: no reference counted, nothing inlined unasked, indices from the start."""

from __future__ import annotations

import ast
import os
from pathlib import Path

import numpy as np
import pytest
from numba import config, njit
from numba.core.caching import NullCache

from hhsr.kernels.unmanaged import inlined, unmanaged

DECORATORS = {"unmanaged", "inlined", "managed", "entry"}
KERNELS = Path(__file__).resolve().parents[2] / "hhsr" / "kernels"
BOUNDS_CHECKED = os.environ.get("NUMBA_BOUNDSCHECK") == "1"
compiled_only = pytest.mark.skipif(config.DISABLE_JIT, reason="nothing is compiled")


@unmanaged
def called(a, i):
    a[i] += 1.0
    return a[i + 1]


@inlined
def calling(a, i):
    return called(a, i)


for kernel in (called, calling):  # what comes from a cache cannot be looked into, and a second run would find it there
    kernel._cache = NullCache()


def ir_of(function: object) -> str:
    (text,) = function.inspect_llvm().values()  # type: ignore[attr-defined]
    return str(text)


@compiled_only
def test_what_an_inlined_kernel_calls_is_not_inlined_for_that() -> None:
    numbers = np.zeros(4)
    calling(numbers, np.int64(1))
    assert "alwaysinline" in ir_of(calling)
    assert "alwaysinline" not in ir_of(called)


@compiled_only
@pytest.mark.skipif(BOUNDS_CHECKED, reason="each index is asked for its bounds")
def test_indices_are_not_asked_whether_they_count_from_the_end() -> None:
    plain = njit(called.py_func, error_model="numpy")
    numbers = np.zeros(4)
    called(numbers, np.int64(1))
    plain(numbers, np.int64(1))
    assert numbers[1] == 2.0
    signs = ("icmp slt", "lshr", "ashr", "select")
    assert any(sign in ir_of(plain) for sign in signs)
    assert not any(sign in ir_of(called) for sign in signs)


@compiled_only
@pytest.mark.skipif(not BOUNDS_CHECKED, reason="NUMBA_BOUNDSCHECK is not set")
def test_a_negative_index_is_out_of_bounds() -> None:
    with pytest.raises(IndexError):
        called(np.zeros(4), np.int64(-2))


@pytest.mark.parametrize("path", sorted(KERNELS.glob("*.py")), ids=lambda p: p.name)
def test_no_kernel_counts_from_the_end(path: Path) -> None:
    """Compiled, a negative index would read what lies before the array."""
    for function in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names = {getattr(d, "id", "") for d in getattr(function, "decorator_list", ())}
        for node in ast.walk(function) if names & DECORATORS else ():
            if isinstance(node, ast.Subscript):
                parts = node.slice.elts if isinstance(node.slice, ast.Tuple) else [node.slice]
                negative = [isinstance(p, ast.UnaryOp) and isinstance(p.op, ast.USub) for p in parts]
                assert not any(negative), f"{path.name}:{node.lineno}"
