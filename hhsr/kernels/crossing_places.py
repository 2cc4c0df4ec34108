"""Where the crossings of a batch go: from the order that its segments were followed in to that of the answers."""

import numpy as np
from numba import njit


@njit(cache=True, nogil=True, error_model="numpy")
def place_first(order, counts, places, ts, out):
    """Put the first crossings, as `cross_many` tells of them, into rows `order` of out: NaN none, −1 not finite.

    Returns how many are not finite.
    """
    bad = 0
    for i in range(order.shape[0]):
        out[order[i]] = ts[places[i]] if counts[i] > 0 else (np.nan if counts[i] == 0 else -1.0)
        bad += 1 if counts[i] < 0 else 0
    return bad


@njit(cache=True, nogil=True, error_model="numpy")
def place_counts(order, counts, valid, out):
    """Put counts (k,), 0 where a segment is not finite, into rows `order` of out, and which are finite into valid."""
    for i in range(order.shape[0]):
        valid[order[i]], out[order[i]] = counts[i] >= 0, max(counts[i], 0)


@njit(cache=True, nogil=True, error_model="numpy")
def place_all(starts, ends, order, counts, begins, places, ts, offsets, t, points, entering):
    """Fill t (m,), points (m, 3) and entering (m,) with what `cross_many` found of segments (n, 3) → (n, 3).

    order: (n,) the row of the answers that each segment is for. offsets: where each row's crossings begin.
    """
    for i in range(starts.shape[0]):
        inside = begins[i]
        to = offsets[order[i]]
        for k in range(counts[i]):
            inside = not inside
            t[to + k], entering[to + k] = ts[places[i] + k], inside
            for c in range(3):
                points[to + k, c] = starts[i, c] + ts[places[i] + k] * (ends[i, c] - starts[i, c])
