"""The point of the model leaves' surface nearest to a segment (a point is a segment of no length): branch and bound.

A disc of the facets' hierarchy is discarded when it lies no nearer than the best point less the tolerance; a facet when
its flat quad, widened by its proven thickness, does; what is left is settled at the end.
"""

import numpy as np

from hhsr.kernels.descent import descend, onto_surface
from hhsr.kernels.disc_bounds import BLOCK, LOOSE, WIDE, bound_to_point, bound_to_segment
from hhsr.kernels.facets import facet_cell, facet_slot
from hhsr.kernels.flat_cell import refine_cell
from hhsr.kernels.layout import (
    CELL_SIZE,
    ERROR,
    FACET_CODES,
    FACET_COUNT,
    FACET_LEVELS,
    FRAME,
    OWNER_INT_SIZE,
    OWNER_INTS,
    OWNER_PLANE_FLOATS,
    OWNER_PLANES,
    OWNER_RECORD,
    SEED_FRAME,
    SLOPE_A,
    SLOPE_B,
    VALUE,
)
from hhsr.kernels.patch import (
    BEST,
    BEST_T,
    ENOUGH,
    FAR,
    FOOT,
    LATE,
    LENGTH2,
    NODE_ROOM,
    SPOT,
    START,
    TOLERANCE,
    VECTOR,
    cell_bound,
    distance_to,
    into_own_frame,
    offer,
)
from hhsr.kernels.seeds import seed_at
from hhsr.kernels.settle import settle_cell
from hhsr.kernels.tree import turn_out_of_leaf
from hhsr.kernels.unmanaged import inlined, unmanaged
from hhsr.kernels.vectors import ask_ahead, lowest_bit

VAST = 1e9  # mm
ROUNDING = 1e-9  # of the coordinates
PATIENCE = 16  # facets that may wait
SAMPLES = 4  # points of a segment that ask for a seed


@inlined
def _settle(blob, ints, tab, code, search, local, corners, spare, rects):
    """Offer the nearest point of a facet, or prove that it holds none: by quadratics where no cut touches it."""
    owner = ints[OWNER_INTS] + OWNER_INT_SIZE * (code >> 24)
    leaf, planes = ints[owner + OWNER_RECORD], ints[owner + OWNER_PLANE_FLOATS]
    count = 0 if code & 1 else ints[owner + OWNER_PLANES]
    frame = ints[leaf + FRAME]
    into_own_frame(blob, ints, leaf, search, local)
    local[BEST] = search[BEST]
    o, face, a, b, half = facet_cell(ints, leaf, code)
    if not settle_cell(blob, ints, tab, leaf, planes, count, local, face, o, a, b, half, corners, spare, rects):
        low = cell_bound(
            blob, ints, leaf, planes, count, local, face, a, b, half, np.float64(tab[o + VALUE]),
            np.float64(tab[o + SLOPE_A]), np.float64(tab[o + SLOPE_B]), np.float64(tab[o + ERROR]), corners, spare,
        )  # fmt: skip
        if low <= local[BEST] - search[TOLERANCE]:
            refine_cell(blob, ints, leaf, planes, count, local, face, a, b, half, corners, spare, rects)
    if local[BEST] < search[BEST]:
        x, y, z = turn_out_of_leaf(blob, frame, local[FOOT], local[FOOT + 1], local[FOOT + 2])
        offer(search, local[BEST], local[BEST_T], x + blob[frame], y + blob[frame + 1], z + blob[frame + 2])


@unmanaged
def seed_point(blob, ints, tab, search):
    """Offer surface points on the way down from the facet that is named near the search's point; nothing is proven."""
    if ints[FACET_COUNT] == 0:
        return
    code = ints[ints[FACET_CODES] + seed_at(blob, ints, search[START], search[START + 1], search[START + 2])]
    leaf = ints[ints[OWNER_INTS] + OWNER_INT_SIZE * (code >> 24) + OWNER_RECORD]
    _, face, a, b, _ = facet_cell(ints, leaf, code)
    descend(blob, ints, tab, code >> 24, face, a, b, np.bool_(True), search)


@unmanaged
def _seed_segment(blob, ints, tab, search, local):
    """Offer a surface point near the search's segment: the nearest of a few points', then to and fro between both."""
    local[LENGTH2], local[TOLERANCE] = 0.0, search[TOLERANCE]
    t = 0.0
    for k in range(SAMPLES + 2):
        if k < SAMPLES:
            t = k / (SAMPLES - 1.0)
        elif search[BEST] < FAR:
            t = search[BEST_T]
        else:
            return
        for q in range(3):
            local[START + q] = search[START + q] + t * search[VECTOR + q]
        local[BEST], local[SPOT] = FAR, -1.0
        seed_point(blob, ints, tab, local)
        onto_surface(blob, ints, local)
        if local[BEST] < FAR:
            distance, t = distance_to(search, local[FOOT], local[FOOT + 1], local[FOOT + 2])
            if distance < search[BEST]:
                offer(search, distance, t, local[FOOT], local[FOOT + 1], local[FOOT + 2])


@unmanaged
def nearest_on_leaves(blob, ints, tab, search, local, nodes, keys, corners, spare, rects, seeded):
    """Improve the search (tree's frame) by the surface of all model leaves, each within its region, until it is enough.

    seeded: of a point, and what a seed gives is known already. nodes, keys: (LATE + NODE_ROOM + 8,) scratch: pending
    blocks and their bounds, from LATE on the facets yet to be settled; last the bounds of a block.
    """
    if ints[FACET_COUNT] == 0:
        return
    levels, codes = ints[FACET_LEVELS], ints[FACET_CODES]
    moving = search[LENGTH2] > 0.0
    local[VECTOR], local[VECTOR + 1], local[VECTOR + 2] = 0.0, 0.0, 0.0
    local[TOLERANCE], local[ENOUGH] = search[TOLERANCE], search[ENOUGH]
    if moving:
        _seed_segment(blob, ints, tab, search, local)
    elif not seeded:
        seed_point(blob, ints, tab, search)
    x, y, z = search[START], search[START + 1], search[START + 2]
    dx, dy, dz = search[VECTOR], search[VECTOR + 1], search[VECTOR + 2]
    first = ints[levels + 1 + 2 * ints[levels]]
    blocks = tab[first : first + BLOCK * ints[levels + 2 + 2 * ints[levels]]]
    bounds = keys[LATE + NODE_ROOM :].view(np.float32)
    reach = max(abs(x), abs(y), abs(z)) + max(abs(x + dx), abs(y + dy), abs(z + dz))
    # From 10 km on the squares of distances round to more than the tolerance.
    search[TOLERANCE] = max(search[TOLERANCE], ROUNDING * reach)
    local[LENGTH2], local[TOLERANCE] = search[LENGTH2], search[TOLERANCE]
    loose = LOOSE * (reach + blob[ints[SEED_FRAME] + 4])
    limit = search[BEST] - search[TOLERANCE]
    depth, waiting = 0, 0
    while WIDE * depth < ints[levels + 2 * ints[levels]]:
        keys[depth], nodes[depth] = 0.0, ((ints[levels] - 1) << 40) + depth
        depth += 1
    mask = np.int64(0)
    while depth > 0 or waiting > 0:
        depth -= 1
        if depth >= 0 and limit >= 0.0 and keys[depth] <= limit * limit:
            level, i = nodes[depth] >> 40, nodes[depth] & 0xFFFFFFFFFF
            start, size = ints[levels + 1 + 2 * level], ints[levels + 2 + 2 * level]
            if not reach < VAST:  # beyond what float32 holds: no disc is ruled out
                bounds[:] = np.float32(0.0)
                mask = np.int64((1 << WIDE) - 1)
            elif moving:
                mask = bound_to_segment(blocks, start + i, x, y, z, dx, dy, dz, loose, limit * limit, bounds)
            else:
                mask = bound_to_point(blocks, start + i, x, y, z, loose, limit * limit, bounds)
            base = depth
            while mask != 0:
                c = lowest_bit(mask)
                mask &= mask - 1
                if WIDE * i + c >= size:
                    continue
                low = np.float64(bounds[c])
                if level == 0:
                    code = ints[codes + WIDE * i + c]
                    keys[LATE + waiting], nodes[LATE + waiting] = low, code
                    # A facet's cell lies in no near cache, often in two lines: they come while other discs are bounded.
                    slot = facet_slot(ints, code)
                    ask_ahead(tab, slot)
                    ask_ahead(tab, slot + CELL_SIZE - 1)
                    waiting += 1
                    continue
                if level == 1:  # so do a block of them and their codes
                    child = WIDE * i + c
                    slot = first + BLOCK * (ints[levels + 1] + child)
                    for line in range(slot, slot + BLOCK, WIDE):
                        ask_ahead(tab, line)
                    ask_ahead(ints, codes + WIDE * child)
                    ask_ahead(ints, codes + WIDE * child + WIDE // 2)
                # Inserted so that the nearest is next.
                k = depth
                while k > base and keys[k - 1] < low:
                    keys[k], nodes[k] = keys[k - 1], nodes[k - 1]
                    k -= 1
                keys[k], nodes[k] = low, ((level - 1) << 40) + WIDE * i + c
                depth += 1
        depth = max(depth, 0)
        # Facets wait: most are settled when the search is over, against a tight bound.
        while waiting > (PATIENCE if depth > 0 else 0):
            waiting = _settle_nearest(blob, ints, tab, waiting, search, local, nodes, keys, corners, spare, rects)
            limit = search[BEST] - search[TOLERANCE]
        if search[BEST] < search[ENOUGH]:
            return


@inlined
def _settle_nearest(blob, ints, tab, waiting, search, local, nodes, keys, corners, spare, rects):
    """Settle the nearest of the facets that wait, from slot LATE on; return how many wait then."""
    last = LATE + waiting - 1
    k = last
    for q in range(LATE, last):
        if keys[q] < keys[k]:
            k = q
    low, code = keys[k], nodes[k]
    keys[k], nodes[k] = keys[last], nodes[last]
    limit = search[BEST] - search[TOLERANCE]
    if limit < 0.0 or low > limit * limit:
        return np.int64(0)  # nor are the others nearer
    _settle(blob, ints, tab, code, search, local, corners, spare, rects)
    return waiting - 1


@unmanaged
def owner_planes(ints, owner):
    """Return (float slot, number) of the planes of an owner's region, in the owner's frame."""
    return ints[owner + OWNER_PLANE_FLOATS], ints[owner + OWNER_PLANES]
