"""Batches of questions, row by row: asked in the order of neighbours, which read the same tables, and in parts.

Each returns its answers in the order of the rows, and how many of those are not finite.
"""

from __future__ import annotations

import numpy as np

from hhsr.answers import Crossings
from hhsr.batches import in_parts, neighbours_first, segments_in_order
from hhsr.kernels.clearance import clearance_many
from hhsr.kernels.crossing import cross_many, first_many, place_many
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
    bad = in_parts(
        len(order),
        4_000,
        lambda i, j: first_many(blob, first[i:j], last[i:j], order[i:j], resolution, tolerance, t),
    )
    return t, int(sum(bad))


def crossings_of_rows(
    blob: FloatArray, starts: FloatArray, ends: FloatArray, resolution: float, tolerance: float
) -> Crossings:
    """Return the crossings of segments (n, 3); none, and not valid, where a segment is not finite."""
    order, first, last = segments_in_order(starts, ends)
    counts, begins = np.empty(len(order), dtype=np.int64), np.empty(len(order), dtype=np.bool_)

    def part(i: int, j: int) -> FloatArray:
        found: list[FloatArray] = []
        room = 4 * (j - i) + 64
        while True:
            t = np.empty(room)
            done, used = cross_many(blob, first[i:j], last[i:j], resolution, tolerance, counts[i:j], begins[i:j], t)
            found.append(t[:used])
            i += done
            if i == j:
                return np.concatenate(found)
            if done == 0:
                room *= 4

    found = np.concatenate(in_parts(len(order), 4_000, part)) if len(order) else np.empty(0)
    valid, offsets = np.empty(len(order), dtype=np.bool_), np.zeros(len(order) + 1, dtype=np.int64)
    valid[order] = counts >= 0
    offsets[1:][order] = np.maximum(counts, 0)
    np.cumsum(offsets, out=offsets)
    t, points, entering = np.empty(len(found)), np.empty((len(found), 3)), np.empty(len(found), dtype=np.bool_)
    place_many(first, last, order, begins, found, offsets, t, points, entering)
    return Crossings(offsets, t, points, entering, valid)
