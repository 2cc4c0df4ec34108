"""Signed distance and nearest point of the whole solid (DESIGN §2, §4).

The surface nearest to a segment is on a patch of some owner (branch and bound), on the inside of a step face (then at
the foot of one of the segment's ends on a cutting plane, where the two sides disagree), or on a straight edge where two
cutting planes meet (a short list made when the tree is compiled).
"""

import math

import numpy as np
from numba import njit

from hhsr.kernels.by_charts import nearest_by_charts
from hhsr.kernels.descent import onto_surface
from hhsr.kernels.disc_bounds import WIDE
from hhsr.kernels.foot import FREE, UNPROVEN
from hhsr.kernels.layout import (
    EDGE_COUNT,
    EDGE_FLOATS,
    MODEL,
    OWNER_BOX,
    OWNER_COUNT,
    OWNER_INT_SIZE,
    OWNER_INTS,
    OWNER_KIND,
    OWNER_RECORD,
    PLANE_COUNT,
    PLANE_FLOATS,
    RETAINED,
    integers,
    tables,
)
from hhsr.kernels.nearest import nearest_on_leaves, owner_planes
from hhsr.kernels.nearest_part import box_bound, nearest_on_part
from hhsr.kernels.nearest_slab import nearest_on_slab
from hhsr.kernels.patch import (
    BEST,
    BEST_T,
    ENOUGH,
    FAR,
    FOOT,
    LATE,
    LENGTH2,
    NODE_ROOM,
    SEARCH_SIZE,
    SIDE,
    SPOT,
    START,
    TOLERANCE,
    VECTOR,
    offer,
)
from hhsr.kernels.polygon import ROOM, segment_to_segment
from hhsr.kernels.tree import (
    into_tree,
    out_of_tree,
)
from hhsr.kernels.unmanaged import entry, managed, unmanaged
from hhsr.kernels.voxels import settled_about, solid_contains

ASIDE = 1e-6  # mm: how far off a plane its two sides are asked


@managed
def near_scratch():
    """Return (search, local, nodes, keys, corners, spare, rects): what one thread needs for a search."""
    # One block: to ask for seven takes as long as a near point.
    nodes, keys, corners = LATE + NODE_ROOM, LATE + NODE_ROOM + WIDE // 2, 3 * ROOM
    block = np.empty(2 * SEARCH_SIZE + nodes + keys + 2 * corners + 6 * NODE_ROOM)
    block[: 2 * SEARCH_SIZE] = 0.0
    search, local = block[:SEARCH_SIZE], block[SEARCH_SIZE : 2 * SEARCH_SIZE]
    at = 2 * SEARCH_SIZE
    pending, bounds = block[at : at + nodes].view(np.int64), block[at + nodes : at + nodes + keys]
    at += nodes + keys
    one, other = block[at : at + corners].reshape(ROOM, 3), block[at + corners : at + 2 * corners].reshape(ROOM, 3)
    return search, local, pending, bounds, one, other, block[at + 2 * corners :].reshape(NODE_ROOM, 6)


@unmanaged
def set_search(search, px, py, pz, dx, dy, dz, tolerance):
    """Begin a search about p + t·d."""
    search[START], search[START + 1], search[START + 2] = px, py, pz
    search[VECTOR], search[VECTOR + 1], search[VECTOR + 2] = dx, dy, dz
    search[LENGTH2] = dx * dx + dy * dy + dz * dz
    search[BEST], search[BEST_T] = FAR, 0.0
    search[FOOT], search[FOOT + 1], search[FOOT + 2] = np.nan, np.nan, np.nan
    search[TOLERANCE], search[SPOT], search[SIDE], search[ENOUGH] = tolerance, -1.0, 0.0, 0.0


@unmanaged
def _nearest_on_owner(blob, ints, owner, search, nodes, keys, corners, spare, rects):
    o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
    kind, record = ints[o + OWNER_KIND], ints[o + OWNER_RECORD]
    planes, count = owner_planes(ints, o)
    if kind == RETAINED:
        nearest_on_part(blob, ints, record, planes, count, search, nodes, keys, corners, spare)
    else:
        nearest_on_slab(blob, ints, record, planes, count, search, corners, spare, rects)


@unmanaged
def _nearest_step(blob, ints, tab, search):
    """Offer the feet of the segment's ends on the cutting planes where the sides disagree, and the straight edges."""
    for end in range(2 if search[LENGTH2] > 0.0 else 1):
        px = search[START] + end * search[VECTOR]
        py = search[START + 1] + end * search[VECTOR + 1]
        pz = search[START + 2] + end * search[VECTOR + 2]
        for k in range(ints[PLANE_COUNT]):
            o = ints[PLANE_FLOATS] + 4 * k
            nx, ny, nz = blob[o], blob[o + 1], blob[o + 2]
            h = nx * px + ny * py + nz * pz - blob[o + 3]
            if abs(h) < search[BEST]:
                x, y, z = px - h * nx, py - h * ny, pz - h * nz
                if settled_about(blob, ints, x, y, z):
                    continue
                if solid_contains(
                    blob, ints, tab, np.int64(0), x + ASIDE * nx, y + ASIDE * ny, z + ASIDE * nz
                ) != solid_contains(blob, ints, tab, np.int64(0), x - ASIDE * nx, y - ASIDE * ny, z - ASIDE * nz):
                    offer(search, abs(h), float(end), x, y, z)
    for k in range(ints[EDGE_COUNT]):
        o = ints[EDGE_FLOATS] + 6 * k
        ax, ay, az = blob[o], blob[o + 1], blob[o + 2]
        ux, uy, uz = blob[o + 3] - ax, blob[o + 4] - ay, blob[o + 5] - az
        if search[LENGTH2] > 0.0:
            d2, t, s = segment_to_segment(
                search[START], search[START + 1], search[START + 2], search[VECTOR], search[VECTOR + 1],
                search[VECTOR + 2], ax, ay, az, ux, uy, uz,
            )  # fmt: skip
        else:
            rx, ry, rz = search[START] - ax, search[START + 1] - ay, search[START + 2] - az
            t, uu, ru = 0.0, ux * ux + uy * uy + uz * uz, rx * ux + ry * uy + rz * uz
            if (rx * rx + ry * ry + rz * rz - search[BEST] * search[BEST]) * uu > ru * ru:
                continue  # not even its line is nearer
            s = min(max(ru / uu, 0.0), 1.0) if uu > 0.0 else 0.0
            rx, ry, rz = rx - s * ux, ry - s * uy, rz - s * uz
            d2 = rx * rx + ry * ry + rz * rz
        if d2 < search[BEST] * search[BEST]:
            offer(search, math.sqrt(d2), t, ax + s * ux, ay + s * uy, az + s * uz)


@unmanaged
def search_surface(blob, ints, tab, search, local, nodes, keys, corners, spare, rects, seeded):
    """Find the surface point nearest to the search's segment, to its tolerance: truth ∈ [best − tolerance, best].

    seeded: of a point, and what `seed_point` gives is known already. Returns whether that is proven: not where a point
    was found that is enough.
    """
    if search[LENGTH2] == 0.0:
        outcome = nearest_by_charts(blob, ints, tab, search, local, nodes, spare)
        if outcome == FREE:
            _nearest_step(blob, ints, tab, search)
        if outcome != UNPROVEN:
            onto_surface(blob, ints, search)
            return True
    nearest_on_leaves(blob, ints, tab, search, local, nodes, keys, corners, spare, rects, seeded)
    if search[BEST] < search[ENOUGH]:
        onto_surface(blob, ints, search)
        return False
    _nearest_step(blob, ints, tab, search)
    for owner in range(ints[OWNER_COUNT]):
        o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
        if ints[o + OWNER_KIND] == MODEL:
            continue
        box = blob[ints[o + OWNER_BOX] : ints[o + OWNER_BOX] + 6]
        if box[0] <= box[3] and box_bound(box, search) < search[BEST] - search[TOLERANCE]:
            _nearest_on_owner(blob, ints, owner, search, nodes, keys, corners, spare, rects)
    onto_surface(blob, ints, search)
    if search[BEST] == FAR:
        search[BEST] = np.inf
    return True


@unmanaged
def _signed_distance(blob, ints, tab, x, y, z, tolerance, search, local, nodes, keys, corners, spare, rects):
    """Return the signed distance of a point of the tree's frame; the search then holds the surface point."""
    set_search(search, x, y, z, 0.0, 0.0, 0.0, tolerance)
    search_surface(blob, ints, tab, search, local, nodes, keys, corners, spare, rects, np.bool_(False))
    side = search[SIDE]
    if side == 0.0:
        side = -1.0 if solid_contains(blob, ints, tab, np.int64(0), x, y, z) else 1.0
    return side * search[BEST]


@njit(cache=True, error_model="numpy")
def distance_one(blob, x, y, z, tolerance):
    """Return the signed distance (mm) of one LPS point: NaN where not finite."""
    if not math.isfinite(x + y + z):
        return np.nan
    ints, tab = integers(blob), tables(blob)
    search, local, nodes, keys, corners, spare, rects = near_scratch()
    x, y, z = into_tree(blob, ints, x, y, z)
    return _signed_distance(blob, ints, tab, x, y, z, tolerance, search, local, nodes, keys, corners, spare, rects)


@entry
def nearest_many(blob, points, order, tolerance, distance, foot):
    """Fill (n,) signed distance (mm) and (n, 3) nearest surface point of LPS points (m, 3); NaN where not finite.

    order: (m,) the row of the answers that each is for. Returns how many are not finite.
    """
    ints, tab = integers(blob), tables(blob)
    search, local, nodes, keys, corners, spare, rects = near_scratch()
    bad = 0
    for row in range(order.shape[0]):
        i, x, y, z = order[row], points[row, 0], points[row, 1], points[row, 2]
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            distance[i] = np.nan
            foot[i, 0], foot[i, 1], foot[i, 2] = np.nan, np.nan, np.nan
            bad += 1
            continue
        x, y, z = into_tree(blob, ints, x, y, z)
        distance[i] = _signed_distance(
            blob, ints, tab, x, y, z, tolerance, search, local, nodes, keys, corners, spare, rects
        )
        foot[i, 0], foot[i, 1], foot[i, 2] = out_of_tree(blob, ints, search[FOOT], search[FOOT + 1], search[FOOT + 2])
    return bad
