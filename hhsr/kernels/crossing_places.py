"""Where the crossings of a batch go: from the order that its segments were followed in to that of the answers."""

import numpy as np

from hhsr.kernels.unmanaged import entry, inlined
from hhsr.kernels.vectors import ask_ahead

AHEAD = 8  # rows whose crossings are asked for before they are placed
PART_SHIFT = 40  # a place is the number of its part, shifted by so many bits, + the place in that part


@inlined
def _place(places, bases, row):
    return bases[places[row] >> PART_SHIFT] + (places[row] & ((1 << PART_SHIFT) - 1))


@entry
def place_first(counts, places, bases, ts, out):
    """Fill out (n,) with the first crossings that `cross_many` told of: NaN none, −1 not finite; how many are not.

    ts: those of all parts, one after the other; bases: where each part's begin.
    """
    bad = 0
    for i in range(out.shape[0]):
        out[i] = ts[_place(places, bases, i)] if counts[i] > 0 else (np.nan if counts[i] == 0 else -1.0)
        bad += 1 if counts[i] < 0 else 0
    return bad


@entry
def place_counts(counts, valid, offsets):
    """Fill valid (n,), whether a segment is finite, and offsets (n + 1,), where each one's crossings begin."""
    offsets[0] = 0
    for i in range(counts.shape[0]):
        valid[i], offsets[i + 1] = counts[i] >= 0, offsets[i] + max(counts[i], 0)


@entry
def place_all(starts, ends, first, stop, begins, places, bases, ts, offsets, t, points, entering):
    """Fill t (m,), points (m, 3) and entering (m,) with the crossings of segments first … stop of (n, 3) → (n, 3).

    ts, bases: as of `place_first`.
    """
    for i in range(first, stop):
        if i + AHEAD < stop:
            ask_ahead(ts, _place(places, bases, i + AHEAD))
        inside, at = begins[i], offsets[i]
        place = _place(places, bases, i) - at
        for k in range(at, offsets[i + 1]):
            inside = not inside
            t[k], entering[k] = ts[place + k], inside
            for c in range(3):
                points[k, c] = starts[i, c] + ts[place + k] * (ends[i, c] - starts[i, c])
