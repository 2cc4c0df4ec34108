"""The nearest point by the charts of the leaves about a point alone: most points near the surface need no search."""

from hhsr.kernels.foot import FREE, UNPROVEN, foot_in_chart, leaf_is_free
from hhsr.kernels.layout import (
    CUT,
    FRAME,
    MODEL,
    NODE_FLOAT_SIZE,
    NODE_FLOATS,
    NODE_INT_SIZE,
    NODE_INTS,
    OWNER_INT_SIZE,
    OWNER_INTS,
    OWNER_KIND,
    OWNER_RECORD,
)
from hhsr.kernels.patch import BEST, FOOT, SIDE, START, TOLERANCE, offer
from hhsr.kernels.tree import into_leaf, owner_of, turn_out_of_leaf
from hhsr.kernels.unmanaged import unmanaged


@unmanaged
def _others_are_free(blob, ints, tab, own, search, local, nodes, spare):
    """Return whether every region but `own` that the ball about the search's point meets is a leaf's, free in it.

    The ball: all that is nearer than the best point less the tolerance.
    """
    px, py, pz = search[START], search[START + 1], search[START + 2]
    radius = search[BEST] - search[TOLERANCE]
    nodes[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        i = ints[NODE_INTS] + NODE_INT_SIZE * nodes[depth]
        if ints[i] == CUT:
            f = ints[NODE_FLOATS] + NODE_FLOAT_SIZE * nodes[depth]
            h = blob[f] * px + blob[f + 1] * py + blob[f + 2] * pz - blob[f + 3]
            d = blob[f + 4]
            if d > 0.0 and abs(h) < d + radius:
                return False
            if h >= -radius:
                nodes[depth] = ints[i + 2]
                depth += 1
            if h <= radius:
                nodes[depth] = ints[i + 1]
                depth += 1
            continue
        owner = ints[i + 3]
        if owner == own:
            continue
        o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
        if ints[o + OWNER_KIND] != MODEL:
            return False
        x, y, z = into_leaf(blob, ints, ints[o + OWNER_RECORD], px, py, pz)
        if not leaf_is_free(blob, ints, tab, ints[o + OWNER_RECORD], x, y, z, radius, search[TOLERANCE], local, spare):
            return False
    return True


@unmanaged
def nearest_by_charts(blob, ints, tab, search, local, nodes, spare):
    """Offer the foot of a point in the chart of its own leaf; return what is proven of it.

    PROVEN: nothing lies nearer. FREE: no leaf's surface does, step faces and edges may.
    """
    px, py, pz = search[START], search[START + 1], search[START + 2]
    owner = owner_of(blob, ints, 0, px, py, pz)
    o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
    if ints[o + OWNER_KIND] != MODEL:
        return UNPROVEN
    leaf = ints[o + OWNER_RECORD]
    x, y, z = into_leaf(blob, ints, leaf, px, py, pz)
    distance, outcome = foot_in_chart(blob, ints, tab, owner, x, y, z, search[TOLERANCE], local, spare)
    if distance < search[BEST]:
        frame = ints[leaf + FRAME]
        x, y, z = turn_out_of_leaf(blob, frame, local[FOOT], local[FOOT + 1], local[FOOT + 2])
        offer(search, distance, 0.0, x + blob[frame], y + blob[frame + 1], z + blob[frame + 2])
        search[SIDE] = local[SIDE]
    if outcome == FREE and not _others_are_free(blob, ints, tab, owner, search, local, nodes, spare):
        return UNPROVEN
    return outcome
