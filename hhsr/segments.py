"""The crossings of rows of segments: side by side (`hhsr.kernels.crossing_many`), the few others one by one."""

from __future__ import annotations

import numpy as np

from hhsr.kernels.crossing import cross_one
from hhsr.kernels.crossing_many import cross_many
from hhsr.kernels.crossing_places import PART_SHIFT
from hhsr.kernels.run_batch import MANY, ROOM
from hhsr.model import FloatArray, IntArray


def cross_segments(
    blob: FloatArray,
    starts: FloatArray,
    ends: FloatArray,
    order: IntArray,
    first: bool,
    resolution: float,
    tolerance: float,
    counts: IntArray,
    begins: np.ndarray,
    places: IntArray,
    part: int = 0,
) -> FloatArray:
    """Return (m,) t of the crossings of rows `order` of LPS segments (n, 3) → (n, 3), each one's in order, all or one.

    Fills those rows of counts (n,), −1 where a segment is not finite; of begins (n,), whether it starts inside; of
    places (n,): where its crossings begin among all of this part, in the form of `hhsr.kernels.crossing_places`.
    """
    base = part << PART_SHIFT
    t: FloatArray
    t, alone = cross_many(blob, starts, ends, order, first, resolution, tolerance, counts, begins, places, base)
    if alone == 0:
        return t
    found, used = [t], len(t)
    for i in order[counts[order] == MANY]:
        begins[i], more = _cross_alone(blob, starts[i], ends[i], resolution, tolerance)
        found.append(more[:1] if first else more)
        counts[i], places[i] = len(found[-1]), base + used
        used += len(found[-1])
    return np.concatenate(found)


def _cross_alone(
    blob: FloatArray, start: FloatArray, end: FloatArray, resolution: float, tolerance: float
) -> tuple[bool, FloatArray]:
    """Return whether one segment starts inside, and (k,) t of its crossings, as many as there are."""
    (ax, ay, az), (bx, by, bz), room = start.tolist(), end.tolist(), ROOM
    while True:
        t, points = np.empty(room), np.empty((room, 3))
        code = cross_one(blob, ax, ay, az, bx, by, bz, resolution, tolerance, t, points)
        if code >= 0:
            return code % 2 == 1, t[: code // 2]
        room *= 4
