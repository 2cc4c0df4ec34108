"""Batches of questions, row by row: asked in the order of neighbours, which read the same tables, and in parts.

Each returns its answers in the order of the rows, and how many of those are not finite.
"""

from __future__ import annotations

from itertools import count
from operator import itemgetter

import numpy as np
from numpy.typing import NDArray

from hhsr.answers import Crossings
from hhsr.batches import by_middles, in_parts, neighbours_first
from hhsr.kernels.clearance import clearance_many
from hhsr.kernels.crossing_places import place_all, place_counts, place_first
from hhsr.kernels.distance import nearest_many
from hhsr.model import FloatArray, IntArray
from hhsr.segments import cross_segments


def nearest_to_rows(blob: FloatArray, points: FloatArray, tolerance: float) -> tuple[FloatArray, FloatArray, int]:
    """Return (n,) signed distance (mm) and (n, 3) surface point of points (n, 3); NaN where not finite."""
    distance, foot, order = np.empty(len(points)), np.empty((len(points), 3)), neighbours_first(points)

    def part(i: int, j: int) -> int:
        some = order[i:j]
        return int(nearest_many(blob, _rows(points, some), some, tolerance, distance, foot))

    bad = in_parts(len(points), 1_000, part)
    return distance, foot, int(sum(bad))


def clearance_of_rows(
    blob: FloatArray, starts: FloatArray, ends: FloatArray, tolerance: float
) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """Return (n,) clearance of segments (n, 3) (mm), (n,) where along them, (n, 3) surface points; NaN: not finite."""
    order = by_middles(starts, ends)
    value, t, foot = np.empty(len(order)), np.empty(len(order)), np.empty((len(order), 3))

    def part(i: int, j: int) -> int:
        some = order[i:j]
        first, last = _rows(starts, some), _rows(ends, some)
        return int(clearance_many(blob, first, last, some, tolerance, value, t, foot))

    bad = in_parts(len(order), 500, part)
    return value, t, foot, int(sum(bad))


def first_of_rows(
    blob: FloatArray, starts: FloatArray, ends: FloatArray, resolution: float, tolerance: float
) -> tuple[FloatArray, int]:
    """Return (n,) t of the first crossing of segments (n, 3): NaN where there is none, −1 where not finite."""
    counts, _, places, bases, ts = _followed(blob, starts, ends, True, resolution, tolerance)
    t = np.empty(len(counts))
    return t, int(place_first(counts, places, bases, ts, t))


def crossings_of_rows(
    blob: FloatArray, starts: FloatArray, ends: FloatArray, resolution: float, tolerance: float
) -> Crossings:
    """Return the crossings of segments (n, 3); none, and not valid, where a segment is not finite."""
    counts, begins, places, bases, ts = _followed(blob, starts, ends, False, resolution, tolerance)
    n = len(counts)
    valid, offsets = np.empty(n, np.bool_), np.empty(n + 1, np.int64)
    place_counts(counts, valid, offsets)
    m = int(offsets[-1])
    t, points, entering = np.empty(m), np.empty((m, 3)), np.empty(m, np.bool_)
    in_parts(
        n,
        20_000,
        lambda i, j: place_all(starts, ends, i, j, begins, places, bases, ts, offsets, t, points, entering),
    )
    return Crossings(offsets, t, points, entering, valid)


def _followed(
    blob: FloatArray, starts: FloatArray, ends: FloatArray, first: bool, resolution: float, tolerance: float
) -> tuple[IntArray, NDArray[np.bool_], IntArray, IntArray, FloatArray]:
    """Return what `cross_segments` tells of segments (n, 3), in parts: counts, begins, places; bases and t of all."""
    order = by_middles(starts, ends)
    n = len(order)
    counts, begins, places = np.empty(n, np.int64), np.empty(n, np.bool_), np.empty(n, np.int64)
    numbers = count()

    def part(i: int, j: int) -> tuple[int, FloatArray]:
        number = next(numbers)
        return number, cross_segments(
            blob, starts, ends, order[i:j], first, resolution, tolerance, counts, begins, places, number
        )

    found = [ts for _, ts in sorted(in_parts(n, 4_000, part), key=itemgetter(0))]
    bases = np.cumsum([0, *(len(ts) for ts in found)])
    return counts, begins, places, bases, found[0] if len(found) == 1 else np.concatenate(found)


def _rows(points: FloatArray, order: NDArray[np.int64]) -> FloatArray:
    return np.take(points, order, axis=0)
