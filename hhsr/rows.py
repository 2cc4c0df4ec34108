"""Batches of questions, row by row: asked in the order of neighbours, which read the same tables, and in parts.

Each returns its answers in the order of the rows, and how many of those are not finite.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hhsr.answers import Crossings
from hhsr.batches import by_middles, in_parts, neighbours_first
from hhsr.kernels.clearance import clearance_many
from hhsr.kernels.crossing_places import place_all, place_counts, place_first
from hhsr.kernels.distance import nearest_many
from hhsr.model import FloatArray
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
    order = by_middles(starts, ends)
    t = np.empty(len(order))

    def part(i: int, j: int) -> int:
        some = order[i:j]
        counts, places, begins = np.empty(j - i, np.int64), np.empty(j - i, np.int64), np.empty(j - i, np.bool_)
        found = cross_segments(
            blob, _rows(starts, some), _rows(ends, some), True, resolution, tolerance, counts, begins, places
        )
        return int(place_first(some, counts, places, found, t))

    return t, sum(in_parts(len(order), 4_000, part))


def crossings_of_rows(
    blob: FloatArray, starts: FloatArray, ends: FloatArray, resolution: float, tolerance: float
) -> Crossings:
    """Return the crossings of segments (n, 3); none, and not valid, where a segment is not finite."""
    order = by_middles(starts, ends)
    n = len(order)
    counts, places, begins = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.bool_)
    valid, offsets = np.empty(n, np.bool_), np.zeros(n + 1, np.int64)

    def part(i: int, j: int) -> tuple[int, int, FloatArray, FloatArray, FloatArray]:
        some = slice(i, j)
        first, last = _rows(starts, order[some]), _rows(ends, order[some])
        found = cross_segments(
            blob, first, last, False, resolution, tolerance, counts[some], begins[some], places[some]
        )
        place_counts(order[some], counts[some], valid, offsets[1:])
        return i, j, first, last, found

    parts = in_parts(n, 4_000, part)
    np.cumsum(offsets, out=offsets)
    m = int(offsets[-1])
    t, points, entering = np.empty(m), np.empty((m, 3)), np.empty(m, np.bool_)

    def place(k: int, stop: int) -> None:
        for i, j, first, last, found in parts[k:stop]:
            place_all(
                first, last, order[i:j], counts[i:j], begins[i:j], places[i:j], found, offsets, t, points, entering
            )

    in_parts(len(parts), 1, place)
    return Crossings(offsets, t, points, entering, valid)


def _rows(points: FloatArray, order: NDArray[np.int64]) -> FloatArray:
    return np.take(points, order, axis=0)
