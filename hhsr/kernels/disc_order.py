"""The order in which facets stand under their discs: sixteen neighbours in each, whichever leaf or face they are of."""

import numpy as np

from hhsr.kernels.disc_bounds import WIDE
from hhsr.kernels.unmanaged import entry, unmanaged

DEEP = 128  # pending ranges: two a halving would do


@entry
def order_facets(points, order):
    """Sort points (m, 3) in place so that runs of 16, 256, 4096 … lie close together; order: (m,) their old rows.

    A run is halved where it spreads most, at a whole number of the longest runs that it holds.
    """
    for q in range(order.shape[0]):
        order[q] = q
    first, last = np.empty(DEEP, dtype=np.int64), np.empty(DEEP, dtype=np.int64)
    first[0], last[0] = 0, order.shape[0]
    depth = 1
    while depth > 0:
        depth -= 1
        i, j = first[depth], last[depth]
        if j - i <= WIDE:
            continue
        unit = np.int64(WIDE)
        while unit * WIDE < j - i:
            unit *= WIDE
        middle = i + (-(-(j - i) // unit) + 1) // 2 * unit
        _part(points, order, i, middle, j, _widest(points, i, j))
        first[depth], last[depth] = i, middle
        first[depth + 1], last[depth + 1] = middle, j
        depth += 2


@unmanaged
def _widest(points, i, j):
    """Return the axis along which the points of the rows i … j − 1 have the greatest variance."""
    best, most = 0, -1.0
    for k in range(3):
        mean = spread = 0.0
        for q in range(i, j):
            mean += points[q, k]
        mean /= j - i
        for q in range(i, j):
            spread += (points[q, k] - mean) ** 2
        if spread > most:
            best, most = k, spread
    return best


@unmanaged
def _swap(points, order, p, q):
    for k in range(3):
        points[p, k], points[q, k] = points[q, k], points[p, k]
    order[p], order[q] = order[q], order[p]


@unmanaged
def _part(points, order, i, middle, j, axis):
    """Sort the rows i … j − 1 so far that none before `middle` is greater, along the axis, than one from there on."""
    low, high = i, j - 1
    while low < high:
        a, b, c = points[low, axis], points[(low + high) // 2, axis], points[high, axis]
        pivot = max(min(a, b), min(max(a, b), c))
        p, q = low, high
        while p <= q:
            while points[p, axis] < pivot:
                p += 1
            while points[q, axis] > pivot:
                q -= 1
            if p <= q:
                _swap(points, order, p, q)
                p += 1
                q -= 1
        if middle <= q:
            high = q
        elif middle >= p:
            low = p
        else:
            return
