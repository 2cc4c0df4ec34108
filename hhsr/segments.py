"""The crossings of rows of segments: side by side (`hhsr.kernels.crossing_many`), the few others one by one."""

from __future__ import annotations

import numpy as np

from hhsr.kernels.crossing import cross_one
from hhsr.kernels.crossing_many import cross_many
from hhsr.kernels.run_batch import MANY, ROOM
from hhsr.model import FloatArray


def cross_segments(
    blob: FloatArray,
    starts: FloatArray,
    ends: FloatArray,
    first: bool,
    resolution: float,
    tolerance: float,
    counts: np.ndarray,
    begins: np.ndarray,
    places: np.ndarray,
) -> FloatArray:
    """Return (m,) t of the crossings of LPS segments (n, 3) → (n, 3), each segment's in order, all or the first.

    Fills counts (n,) of each, −1 where it is not finite; begins (n,) whether it starts inside; places (n,) where its
    crossings begin among all.
    """
    t: FloatArray = cross_many(blob, starts, ends, first, resolution, tolerance, counts, begins, places)
    found, used = [t], len(t)
    for i in np.flatnonzero(counts == MANY):
        begins[i], more = _cross_alone(blob, starts[i], ends[i], resolution, tolerance)
        found.append(more[:1] if first else more)
        counts[i], places[i] = len(found[-1]), used
        used += len(found[-1])
    return np.concatenate(found) if len(found) > 1 else t


def _cross_alone(
    blob: FloatArray, start: FloatArray, end: FloatArray, resolution: float, tolerance: float
) -> tuple[bool, FloatArray]:
    """Return whether one segment starts inside, and (k,) t of its crossings, as many as there are."""
    (ax, ay, az), (bx, by, bz), room = start.tolist(), end.tolist(), ROOM
    while True:
        offsets, t = np.empty(2, dtype=np.int64), np.empty(room)
        points, entering = np.empty((room, 3)), np.empty(room + 2, dtype=np.bool_)
        count = cross_one(blob, ax, ay, az, bx, by, bz, resolution, tolerance, offsets, t, points, entering)
        if count >= 0:
            return bool(entering[room + 1]), t[:count]
        room *= 4
