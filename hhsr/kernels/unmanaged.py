"""Decorators for kernels that own no memory: they take arrays and give numbers, so no references need counting.

Counting costs two atomic steps for each array handed to a kernel, on each call: 20 to 40 ns of a query that takes 10.
A kernel that allocates, or returns an array, cannot go without; `managed` says so where one is called by those that do.

A literal handed to a kernel has its own type, for which all that it calls is compiled once more: hand over np.int64(0)
or np.bool_(True).
"""

from __future__ import annotations

from numba import njit

# `_nrt` is no documented option: with the runtime of references, or not. What a kernel calls inherits it unless said.
unmanaged = njit(cache=True, error_model="numpy", _nrt=False)  # type: ignore[call-overload]
inlined = njit(cache=True, error_model="numpy", _nrt=False, forceinline=True)  # type: ignore[call-overload]
managed = njit(cache=True, error_model="numpy", _nrt=True)  # type: ignore[call-overload]
