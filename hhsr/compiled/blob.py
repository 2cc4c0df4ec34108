"""The blob as an array: seen as kernels take it, and grown by one more table."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hhsr.model import FloatArray

LINE, PAGE = 8, 2**18  # numbers of a cache's line, and of a large page of memory


def room(size: int) -> FloatArray:
    """Return `size` zeros that begin on a cache's line; of a large blob also on a large page, and none is cut short.

    Its tables are asked at random: on pages of 4 kB every other look-up would first wait for where the page lies.
    numpy asks the system for large pages; those that hold nothing are never touched.
    """
    step = PAGE if size >= PAGE else LINE
    blob = np.zeros(size + 2 * step)
    skip = -(blob.ctypes.data // 8) % step
    return blob[skip : skip + size]


def read_only(blob: FloatArray) -> FloatArray:
    """Return a view of the blob as the kernels take it: one signature for all."""
    view = blob.view()
    view.setflags(write=False)
    return view


def joined(tables: list[NDArray[Any]]) -> FloatArray:
    """Return tables of any numbers one behind the other, each from a whole slot on."""
    words = [-(-table.nbytes // 8) for table in tables]
    blob = room(sum(words))
    start = 0
    for table, size in zip(tables, words, strict=True):
        blob[start : start + size].view(table.dtype)[: table.size] = table.ravel()
        start += size
    return blob


def appended(blob: FloatArray, table: NDArray[Any]) -> FloatArray:
    """Return the blob with a table of any numbers behind it."""
    return joined([blob, table])
