"""The blob as an array: seen as kernels take it, and grown by one more table."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hhsr.model import FloatArray


def read_only(blob: FloatArray) -> FloatArray:
    """Return a view of the blob as the kernels take it: one signature for all."""
    view = blob.view()
    view.setflags(write=False)
    return view


def joined(tables: list[NDArray[Any]]) -> FloatArray:
    """Return tables of any numbers one behind the other, each from a whole slot on."""
    words = [-(-table.nbytes // 8) for table in tables]
    blob = np.zeros(sum(words))
    start = 0
    for table, size in zip(tables, words, strict=True):
        blob[start : start + size].view(table.dtype)[: table.size] = table.ravel()
        start += size
    return blob


def appended(blob: FloatArray, table: NDArray[Any]) -> FloatArray:
    """Return the blob with a table of any numbers behind it."""
    return joined([blob, table])
