"""The point of the model leaves' surface nearest to a segment (a point is a segment of no length): branch and bound.

A node of the facets' hierarchy is discarded when its disc lies no nearer than the best point less the tolerance; a
facet
when its flat quad, clipped to the region and widened by its proven thickness, does; what is left is settled at the end.
"""

import math

import numpy as np
from numba import njit

from hhsr.kernels.cell import direction_of, face_of, inverse_radius
from hhsr.kernels.facets import DISC_SIZE, FAN, RADIUS, THICK, facet_cell
from hhsr.kernels.foot import step_to_foot
from hhsr.kernels.jet import has_jets, inverse_radius_jet
from hhsr.kernels.layout import (
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
    SLOPE_A,
    SLOPE_B,
    VALUE,
)
from hhsr.kernels.maps import outside_region
from hhsr.kernels.patch import (
    BEST,
    BEST_T,
    FOOT,
    LATE,
    LENGTH2,
    NODE_ROOM,
    START,
    TOLERANCE,
    VECTOR,
    cell_bound,
    distance_to,
    offer,
    settle_cell,
)
from hhsr.kernels.tree import into_leaf, turn_into_leaf, turn_out_of_leaf


@njit(cache=True, error_model="numpy")
def node_bound(tab, o, search):
    """Return a lower bound of the segment's distance to a node's disc."""
    nx, ny, nz = np.float64(tab[o + 3]), np.float64(tab[o + 4]), np.float64(tab[o + 5])
    thick, radius = np.float64(tab[o + THICK]), np.float64(tab[o + RADIUS])
    rx, ry, rz = search[START] - tab[o], search[START + 1] - tab[o + 1], search[START + 2] - tab[o + 2]
    h = rx * nx + ry * ny + rz * nz
    if search[LENGTH2] == 0.0:
        aside = math.sqrt(max(rx * rx + ry * ry + rz * rz - h * h, 0.0)) - radius
        along = max(abs(h) - thick, 0.0)
        return math.sqrt(along * along + aside * aside) if aside > 0.0 else along
    # A segment: by the slab about the disc's plane, and by the ball about the disc.
    dx, dy, dz = search[VECTOR], search[VECTOR + 1], search[VECTOR + 2]
    g = h + dx * nx + dy * ny + dz * nz
    slab = min(abs(h), abs(g)) - thick if (h > 0.0) == (g > 0.0) else 0.0
    t = min(max(-(rx * dx + ry * dy + rz * dz) / search[LENGTH2], 0.0), 1.0)
    rx, ry, rz = rx + t * dx, ry + t * dy, rz + t * dz
    return max(slab, math.sqrt(rx * rx + ry * ry + rz * rz) - math.sqrt(radius * radius + thick * thick))


@njit(cache=True, error_model="numpy")
def _facet(blob, ints, tab, code, refine, search, local, corners, spare, rects):
    """Return a lower bound of the distance to a facet, having offered a point of it; if `refine`, settle it."""
    owner = ints[OWNER_INTS] + OWNER_INT_SIZE * (code >> 24)
    leaf, planes = ints[owner + OWNER_RECORD], ints[owner + OWNER_PLANE_FLOATS]
    count = 0 if code & 1 else ints[owner + OWNER_PLANES]
    frame = ints[leaf + FRAME]
    qx, qy, qz = into_leaf(blob, ints, leaf, search[START], search[START + 1], search[START + 2])
    local[START], local[START + 1], local[START + 2] = qx, qy, qz
    if search[LENGTH2] > 0.0:
        dx, dy, dz = turn_into_leaf(blob, frame, search[VECTOR], search[VECTOR + 1], search[VECTOR + 2])
        local[VECTOR], local[VECTOR + 1], local[VECTOR + 2] = dx, dy, dz
    local[BEST] = search[BEST]
    o, face, a, b, half = facet_cell(ints, leaf, code)
    low = -1.0
    if refine:
        settle_cell(blob, ints, tab, leaf, planes, count, local, face, o, a, b, half, corners, spare, rects)
    else:
        low = cell_bound(
            blob, ints, leaf, planes, count, local, face, a, b, half, np.float64(tab[o + VALUE]),
            np.float64(tab[o + SLOPE_A]), np.float64(tab[o + SLOPE_B]), np.float64(tab[o + ERROR]), corners, spare,
        )  # fmt: skip
    if local[BEST] < search[BEST]:
        x, y, z = turn_out_of_leaf(blob, frame, local[FOOT], local[FOOT + 1], local[FOOT + 2])
        offer(search, local[BEST], local[BEST_T], x + blob[frame], y + blob[frame + 1], z + blob[frame + 2])
    return low


@njit(cache=True, error_model="numpy")
def _first_guess(blob, ints, tab, search, local, corners, spare, rects):
    """Offer a point of the facets under the nearest node of each level, and Newton's steps from it: an early bound."""
    levels, codes = ints[FACET_LEVELS], ints[FACET_CODES]
    i = 0
    for level in range(ints[levels] - 1, -1, -1):
        start, size = ints[levels + 1 + 2 * level], ints[levels + 2 + 2 * level]
        nearest, at = np.inf, i
        for q in range(FAN * i, min(FAN * i + FAN, size)):
            o = start + DISC_SIZE * q
            distance, _ = distance_to(search, np.float64(tab[o]), np.float64(tab[o + 1]), np.float64(tab[o + 2]))
            if distance < nearest:
                nearest, at = distance, q
        i = at
    chosen = -1
    for q in range(FAN * i, FAN * i + FAN):
        code = ints[codes + q]
        if code >= 0:
            before = search[BEST]
            _facet(blob, ints, tab, code, False, search, local, corners, spare, rects)
            if search[BEST] < before:
                chosen = code
    if chosen < 0 or search[LENGTH2] > 0.0:
        return
    owner = ints[OWNER_INTS] + OWNER_INT_SIZE * (chosen >> 24)
    leaf = ints[owner + OWNER_RECORD]
    if not has_jets(ints, leaf):
        return
    frame = ints[leaf + FRAME]
    px, py, pz = into_leaf(blob, ints, leaf, search[START], search[START + 1], search[START + 2])
    x, y, z = into_leaf(blob, ints, leaf, search[FOOT], search[FOOT + 1], search[FOOT + 2])
    face, a, b, _ = face_of(x, y, z)
    for _ in range(3):
        w, ga, gb = inverse_radius_jet(blob, ints, leaf, face, a, b)
        if w == 0.0:
            return
        a, b, m = step_to_foot(px, py, pz, face, a, b, w, ga, gb)
        if not (m > 0.0 and abs(a) <= 1.0 and abs(b) <= 1.0):
            return
        w = inverse_radius(blob, ints, leaf, face, a, b)
        x, y, z = direction_of(face, a, b)
        x, y, z = x / w, y / w, z / w
        distance = math.sqrt((px - x) ** 2 + (py - y) ** 2 + (pz - z) ** 2)
        if not distance < search[BEST] - 0.1 * search[TOLERANCE] or outside_region(
            blob, ints[owner + OWNER_PLANE_FLOATS], ints[owner + OWNER_PLANES], x, y, z, 1e-9
        ):
            return
        x, y, z = turn_out_of_leaf(blob, frame, x, y, z)
        offer(search, distance, 0.0, x + blob[frame], y + blob[frame + 1], z + blob[frame + 2])


@njit(cache=True, error_model="numpy")
def nearest_on_leaves(blob, ints, tab, search, local, nodes, keys, corners, spare, rects):
    """Improve the search (tree's frame) by the surface of all model leaves, each within its region.

    nodes, keys: (LATE + NODE_ROOM,) scratch: pending nodes and their bounds, and from LATE on the facets yet to be
    settled.
    """
    if ints[FACET_COUNT] == 0:
        return
    levels, codes = ints[FACET_LEVELS], ints[FACET_CODES]
    level = ints[levels]
    local[VECTOR], local[VECTOR + 1], local[VECTOR + 2] = 0.0, 0.0, 0.0
    local[LENGTH2], local[TOLERANCE] = search[LENGTH2], search[TOLERANCE]
    _first_guess(blob, ints, tab, search, local, corners, spare, rects)
    depth, waiting = 1, 0
    nodes[0], keys[0] = level << 40, 0.0  # the node above the highest level
    while depth > 0:
        depth -= 1
        if keys[depth] > search[BEST] - search[TOLERANCE]:
            continue
        level, i = nodes[depth] >> 40, nodes[depth] & 0xFFFFFFFFFF
        if level == 0:
            for q in range(FAN * i, min(FAN * i + FAN, ints[FACET_COUNT])):
                code = ints[codes + q]
                if code < 0:
                    continue
                low = _facet(blob, ints, tab, code, False, search, local, corners, spare, rects)
                if low <= search[BEST] - search[TOLERANCE]:
                    if waiting == NODE_ROOM:  # the late ones begin where the nodes may reach
                        _facet(blob, ints, tab, code, True, search, local, corners, spare, rects)
                        continue
                    # Sorted, the nearest last: they are settled when the search is over, against a tight bound.
                    waiting += 1
                    k = LATE + waiting - 1
                    while k > LATE and keys[k - 1] < low:
                        keys[k], nodes[k] = keys[k - 1], nodes[k - 1]
                        k -= 1
                    keys[k], nodes[k] = low, code
            continue
        level -= 1
        start, size = ints[levels + 1 + 2 * level], ints[levels + 2 + 2 * level]
        base = depth
        for q in range(FAN * i, min(FAN * i + FAN, size)):
            low = node_bound(tab, start + DISC_SIZE * q, search)
            if low > search[BEST] - search[TOLERANCE]:
                continue
            k = depth
            while k > base and keys[k - 1] < low:
                keys[k], nodes[k] = keys[k - 1], nodes[k - 1]
                k -= 1
            keys[k], nodes[k] = low, (level << 40) + q
            depth += 1
    while waiting > 0:
        waiting -= 1
        if keys[LATE + waiting] <= search[BEST] - search[TOLERANCE]:
            _facet(blob, ints, tab, nodes[LATE + waiting], True, search, local, corners, spare, rects)


@njit(cache=True, error_model="numpy")
def owner_planes(ints, owner):
    """Return (float slot, number) of the planes of an owner's region, in the owner's frame."""
    return ints[owner + OWNER_PLANE_FLOATS], ints[owner + OWNER_PLANES]
