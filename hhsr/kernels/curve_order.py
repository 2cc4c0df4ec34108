"""An order of points in which neighbours follow each other: along Morton's curve over a grid of 32³ cells."""

import math

import numpy as np
from numba import njit

SIDE = 32
CELLS = SIDE**3


@njit(cache=True, error_model="numpy")
def _spread(i):
    """Return the five bits of a number, two apart."""
    i = (i | (i << 8)) & 0x100F
    i = (i | (i << 4)) & 0x10C3
    return (i | (i << 2)) & 0x1249


@njit(cache=True, nogil=True, error_model="numpy")
def order_along_curve(points, keys, order):
    """Fill order (n,) with the rows of points (n, 3): cell after cell of their box, as they came within one.

    keys: (n,) int32 scratch. A row that is not finite is put into the first cell.
    """
    n = points.shape[0]
    low, high = np.full(3, np.inf), np.full(3, -np.inf)
    for i in range(n):
        for k in range(3):
            x = points[i, k]
            if math.isfinite(x):
                low[k], high[k] = min(low[k], x), max(high[k], x)
    scale = np.empty(3)
    for k in range(3):
        scale[k] = (SIDE - 1e-6) / max(high[k] - low[k], 1e-300)
    ends = np.zeros(CELLS + 1, dtype=np.int64)
    for i in range(n):
        x, y, z = points[i, 0] - low[0], points[i, 1] - low[1], points[i, 2] - low[2]
        key = 0
        if math.isfinite(x + y + z):
            key = (_spread(int(x * scale[0])) << 2) | (_spread(int(y * scale[1])) << 1) | _spread(int(z * scale[2]))
        keys[i] = key
        ends[key + 1] += 1
    for c in range(CELLS):
        ends[c + 1] += ends[c]
    for i in range(n):
        order[ends[keys[i]]] = i
        ends[keys[i]] += 1
