"""Batches in parts: kernels release the interpreter's lock, so threads share a batch at no cost to single calls."""

from __future__ import annotations

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numba

PARTS_PER_THREAD = 4


def in_parts(count: int, smallest: int, work: Callable[[int, int], Any]) -> list[Any]:
    """Return [work(start, stop), …] over 0 … count in order; on several threads from 2·`smallest` rows on.

    Threads: `numba.get_num_threads()`, at most the machine's. A row's answer must not depend on its part.
    """
    threads = min(numba.get_num_threads(), os.cpu_count() or 1, count // max(smallest, 1))
    if threads <= 1:
        return [work(0, count)]
    parts = PARTS_PER_THREAD * threads
    edges = [count * k // parts for k in range(parts + 1)]
    with ThreadPoolExecutor(threads) as pool:
        return list(pool.map(work, edges[:-1], edges[1:]))
