"""Batches in parts: kernels release the interpreter's lock, so threads share a batch at no cost to single calls."""

from __future__ import annotations

import os
from collections import deque
from collections.abc import Callable
from typing import Any

import numba
import numpy as np
from numpy.typing import NDArray

from hhsr.kernels.curve_order import order_along_curve
from hhsr.model import FloatArray
from hhsr.workers import hand_out, is_working, set_working

CORES = os.cpu_count() or 1  # the system takes as long to say so as 3,000 points take
SHARE = 0.5  # of what is left, for each thread, is a part
LEAST = 8  # as many of the last parts make the smallest batch that is parted
FEW = 2_000


def _edges(count: int, threads: int, least: int) -> list[int]:
    """Return where parts begin and end: ever smaller ones, so that no thread waits long for another's last part."""
    edges = [0]
    while edges[-1] < count:
        rest = count - edges[-1]
        edges.append(edges[-1] + min(max(int(SHARE * rest / threads), least), rest))
    return edges


def in_parts(count: int, smallest: int, work: Callable[[int, int], Any]) -> list[Any]:
    """Return [work(start, stop), …] over 0 … count in order; on several threads from 2·`smallest` rows on.

    Threads: `numba.get_num_threads()`, at most the machine's. A row's answer must not depend on its part.
    """
    threads = min(numba.get_num_threads(), CORES, count // max(smallest, 1))
    if threads <= 1 or is_working():  # a part's own parts: a thread that waits for them helps none
        return [work(0, count)]
    edges = _edges(count, threads, max(smallest // LEAST, 1))
    results: list[Any] = [None] * (len(edges) - 1)
    waiting = deque(range(len(results)))

    def share() -> None:
        while waiting:
            try:
                k = waiting.popleft()
            except IndexError:  # another thread took the last one
                return
            results[k] = work(edges[k], edges[k + 1])

    # The caller works too: to wake a thread costs as much as some thousand points.
    others = hand_out(share, threads - 1)
    set_working(True)
    try:
        share()
    finally:
        set_working(False)
        waiting.clear()
        errors = [other.finish() for other in others]
    for error in errors:
        if error is not None:
            raise error
    return results


def neighbours_first(points: FloatArray) -> NDArray[np.int64]:
    """Return an order of points (n, 3) in which neighbours follow each other: they read the same tables.

    Of few points they lie too far apart for that: these stay as they are.
    """
    return by_middles(points, points)


def by_middles(starts: FloatArray, ends: FloatArray) -> NDArray[np.int64]:
    """Return an order of segments (n, 3) → (n, 3): that of `neighbours_first` of their middles."""
    if len(starts) < FEW:
        return np.arange(len(starts))
    order = np.empty(len(starts), dtype=np.int64)
    order_along_curve(starts, ends, np.empty(len(starts), dtype=np.int32), order)
    return order
