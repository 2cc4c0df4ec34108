"""An order of points in which neighbours follow each other: along Morton's curve over a grid of 32³ cells."""

import math

import numpy as np
from numba import njit

from hhsr.kernels.unmanaged import entry

SIDE = 32
SAMPLE = 16  # the box is that of every so many-th row: others beyond it go to its outermost cells
CELLS = SIDE**3


@njit(cache=True, error_model="numpy")
def _spread(i):
    """Return the five bits of a number, two apart."""
    i = (i | (i << 8)) & 0x100F
    i = (i | (i << 4)) & 0x10C3
    return (i | (i << 2)) & 0x1249


@njit(cache=True, error_model="numpy")
def _cell(x):
    return int(min(max(x, 0.0), SIDE - 1.0))


@entry
def order_along_curve(points, others, keys, order):
    """Fill order (n,) with the rows of points (n, 3) + others (n, 3): cell after cell of their box, as they came in.

    keys: (n,) int32 scratch. A row that is not finite is put into the first cell.
    """
    n = points.shape[0]
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(0, n, SAMPLE):
        for k in range(3):
            x = points[i, k] + others[i, k]
            if math.isfinite(x):
                low[k], high[k] = min(low[k], x), max(high[k], x)
    scale = np.empty(3)
    for k in range(3):
        scale[k] = (SIDE - 1e-6) / max(high[k] - low[k], 1e-300)
    ends = np.zeros(CELLS + 1, dtype=np.int64)
    for i in range(n):
        x, y, z = points[i, 0] + others[i, 0], points[i, 1] + others[i, 1], points[i, 2] + others[i, 2]
        x, y, z = x - low[0], y - low[1], z - low[2]
        key = 0
        if math.isfinite(x + y + z):
            a, b, c = _cell(x * scale[0]), _cell(y * scale[1]), _cell(z * scale[2])
            key = (_spread(a) << 2) | (_spread(b) << 1) | _spread(c)
        keys[i] = key
        ends[key + 1] += 1
    for c in range(CELLS):
        ends[c + 1] += ends[c]
    for i in range(n):
        order[ends[keys[i]]] = i
        ends[keys[i]] += 1
