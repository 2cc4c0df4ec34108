"""Work shared out to threads: the same result on any number of them (DESIGN §3)."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from threading import local
from typing import TypeVar

import numba

T = TypeVar("T")
_THREAD = local()


def in_threads(work: Callable[[int], T], count: int) -> list[T]:
    """Return [work(0), …], made on as many threads as numba may use; each piece of work is the same on any thread.

    What such a thread hands out in its turn it does itself.
    """
    workers = min(numba.get_num_threads(), count)
    if workers <= 1 or getattr(_THREAD, "busy", False):
        return [work(k) for k in range(count)]
    with ThreadPoolExecutor(workers, initializer=lambda: setattr(_THREAD, "busy", True)) as pool:
        return list(pool.map(work, range(count)))
