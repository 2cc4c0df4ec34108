"""Batches of questions, row by row: asked in the order of neighbours, which read the same tables, and in parts.

Each returns its answers in the order of the rows, and how many of those are not finite.
"""

from __future__ import annotations

import numpy as np

from hhsr.answers import Crossings
from hhsr.batches import in_parts, neighbours_first, segments_in_order
from hhsr.kernels.clearance import clearance_many
from hhsr.kernels.crossing_many import cross_many, place_all, place_first
from hhsr.kernels.distance import nearest_many
from hhsr.model import FloatArray


def nearest_to_rows(blob: FloatArray, points: FloatArray, tolerance: float) -> tuple[FloatArray, FloatArray, int]:
    """Return (n,) signed distance (mm) and (n, 3) surface point of points (n, 3); NaN where not finite."""
    distance, foot, order = np.empty(len(points)), np.empty((len(points), 3)), neighbours_first(points)
    near = np.take(points, order, axis=0)
    bad = in_parts(
        len(points), 1_000, lambda i, j: nearest_many(blob, near[i:j], order[i:j], tolerance, distance, foot)
    )
    return distance, foot, int(sum(bad))


def clearance_of_rows(
    blob: FloatArray, starts: FloatArray, ends: FloatArray, tolerance: float
) -> tuple[FloatArray, FloatArray, FloatArray, int]:
    """Return (n,) clearance of segments (n, 3) (mm), (n,) where along them, (n, 3) surface points; NaN: not finite."""
    order, first, last = segments_in_order(starts, ends)
    value, t, foot = np.empty(len(order)), np.empty(len(order)), np.empty((len(order), 3))
    bad = in_parts(
        len(order),
        500,
        lambda i, j: clearance_many(blob, first[i:j], last[i:j], order[i:j], tolerance, value, t, foot),
    )
    return value, t, foot, int(sum(bad))


def first_of_rows(
    blob: FloatArray, starts: FloatArray, ends: FloatArray, resolution: float, tolerance: float
) -> tuple[FloatArray, int]:
    """Return (n,) t of the first crossing of segments (n, 3): NaN where there is none, −1 where not finite."""
    order, first, last = segments_in_order(starts, ends)
    t = np.empty(len(order))

    def part(i: int, j: int) -> int:
        counts, places, begins = np.empty(j - i, np.int64), np.empty(j - i, np.int64), np.empty(j - i, np.bool_)
        found = cross_many(blob, first[i:j], last[i:j], True, resolution, tolerance, counts, begins, places)
        return int(place_first(order[i:j], counts, places, found, t))

    return t, sum(in_parts(len(order), 4_000, part))


def crossings_of_rows(
    blob: FloatArray, starts: FloatArray, ends: FloatArray, resolution: float, tolerance: float
) -> Crossings:
    """Return the crossings of segments (n, 3); none, and not valid, where a segment is not finite."""
    order, first, last = segments_in_order(starts, ends)
    n = len(order)
    counts, places, begins = np.empty(n, np.int64), np.empty(n, np.int64), np.empty(n, np.bool_)
    valid, offsets = np.empty(n, np.bool_), np.zeros(n + 1, np.int64)

    def part(i: int, j: int) -> tuple[int, int, FloatArray]:
        some = slice(i, j)
        found = cross_many(
            blob, first[some], last[some], False, resolution, tolerance, counts[some], begins[some], places[some]
        )
        valid[order[some]] = counts[some] >= 0
        offsets[1:][order[some]] = np.maximum(counts[some], 0)
        return i, j, found

    parts = in_parts(n, 4_000, part)
    np.cumsum(offsets, out=offsets)
    m = int(offsets[-1])
    t, points, entering = np.empty(m), np.empty((m, 3)), np.empty(m, np.bool_)

    def place(k: int, stop: int) -> None:
        for i, j, found in parts[k:stop]:
            place_all(
                first[i:j], last[i:j], order[i:j], counts[i:j], begins[i:j], places[i:j], found, offsets, t, points,
                entering,
            )  # fmt: skip

    in_parts(len(parts), 1, place)
    return Crossings(offsets, t, points, entering, valid)
