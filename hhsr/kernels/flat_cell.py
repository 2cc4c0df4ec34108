"""A cell without a bend, against a point or a segment: bounded by its flat quad, settled by parting it."""

import numpy as np

from hhsr.kernels.cell import cell_model, direction_of
from hhsr.kernels.maps import outside_region
from hhsr.kernels.patch import BEST, FINEST, TOLERANCE, cell_bound, distance_to, offer
from hhsr.kernels.unmanaged import unmanaged


@unmanaged
def refine_cell(blob, ints, leaf, planes, count, search, face, a, b, half, corners, spare, rects):
    """Part a cell until what is left can hold no nearer point, by proven models. rects: (NODE_ROOM, 6) scratch."""
    rects[0, 0], rects[0, 1], rects[0, 2], rects[0, 3] = a, b, half, -1.0
    depth = 1
    while depth > 0:
        depth -= 1
        a, b, half, low = rects[depth, 0], rects[depth, 1], rects[depth, 2], rects[depth, 3]
        if low > search[BEST] - search[TOLERANCE]:
            continue
        half *= 0.5
        base = depth
        for corner in range(4):
            ca, cb = a + (half if corner & 1 else -half), b + (half if corner & 2 else -half)
            value, ga, gb, error = cell_model(blob, ints, leaf, face, ca, cb, half, half, np.bool_(False))[:4]
            low = cell_bound(
                blob, ints, leaf, planes, count, search, face, ca, cb, half, value, ga, gb, error, corners, spare
            )
            if low > search[BEST] - search[TOLERANCE]:
                continue
            if half / value < FINEST:
                x, y, z = direction_of(face, ca, cb)
                if not outside_region(blob, planes, count, x / value, y / value, z / value, FINEST):
                    distance, t = distance_to(search, x / value, y / value, z / value)
                    offer(search, distance, t, x / value, y / value, z / value)
                continue
            # Insert so that the nearest is parted first.
            k = depth
            while k > base and rects[k - 1, 3] < low:
                for q in range(4):
                    rects[k, q] = rects[k - 1, q]
                k -= 1
            rects[k, 0], rects[k, 1], rects[k, 2], rects[k, 3] = ca, cb, half, low
            depth += 1
