"""The nearest point of one owner's surface to a segment (a point is a segment of no length): branch and bound.

A search is a float array: SEARCH_* slots hold the segment in the owner's frame, and the best point so far. A node of
the cube map is discarded when its enclosing sphere, cut off by no plane of the region, lies no nearer than the best
point less the tolerance; a cell when its flat quad, clipped to the region and widened by its proven thickness, does;
what is left is parted, down to the tolerance.
"""

import math

import numpy as np
from numba import njit

from hhsr.kernels.cell import cell_model, chart_of, direction_of, inverse_radius
from hhsr.kernels.layout import (
    BOX,
    CELL_SIZE,
    CELL_TABLE,
    CELLS,
    ERROR,
    OWNER_PLANE_FLOATS,
    OWNER_PLANES,
    RADIUS,
    SLOPE_A,
    SLOPE_B,
    SPHERE_TABLE,
    VALUE,
)
from hhsr.kernels.maps import cell_sphere, level_start, model_thickness, quad_radius_ok
from hhsr.kernels.polygon import clip_polygon, polygon_to_segment

# Slots of a search: start 3, vector 3, squared length; best distance, t, point 3 (owner's frame); tolerance.
START, VECTOR, LENGTH2, BEST, BEST_T, FOOT, TOLERANCE = 0, 3, 6, 7, 8, 9, 12
SEARCH_SIZE = 16
NODE_ROOM = 256
FAR = 1e150  # mm: no surface point found yet; finite, so that "no surface here" (infinite) is beyond it
FINEST = 1e-5  # mm: a piece of surface smaller than this is taken as a point


@njit(cache=True, error_model="numpy")
def distance_to(search, x, y, z):
    """Return (distance, t) of a point to the search's segment."""
    dx, dy, dz = search[VECTOR], search[VECTOR + 1], search[VECTOR + 2]
    rx, ry, rz = x - search[START], y - search[START + 1], z - search[START + 2]
    t = 0.0
    if search[LENGTH2] > 0.0:
        t = min(max((rx * dx + ry * dy + rz * dz) / search[LENGTH2], 0.0), 1.0)
        rx, ry, rz = rx - t * dx, ry - t * dy, rz - t * dz
    return math.sqrt(rx * rx + ry * ry + rz * rz), t


@njit(cache=True, error_model="numpy")
def offer(search, distance, t, x, y, z):
    """Take a surface point as the best one if it is nearer."""
    if distance < search[BEST]:
        search[BEST], search[BEST_T] = distance, t
        search[FOOT], search[FOOT + 1], search[FOOT + 2] = x, y, z


@njit(cache=True, error_model="numpy")
def outside_region(blob, planes, count, x, y, z, radius):
    """Return whether a ball lies wholly outside the region."""
    for k in range(count):
        o = planes + 4 * k
        if blob[o] * x + blob[o + 1] * y + blob[o + 2] * z - blob[o + 3] > radius:
            return True
    return False


@njit(cache=True, error_model="numpy")
def offer_patch_point(blob, ints, leaf, planes, count, search, face, x, y, z, shrink):
    """Project a point near a patch along its ray to the exact surface and offer it, if it lies in the region.

    shrink: mm; where the projection leaves the region by a plane, the point is moved back by its excess and this much.
    """
    for _ in range(3):
        a, b, m = chart_of(face, x, y, z)
        if not (m > 0.0 and abs(a) <= 1.0 + 1e-9 and abs(b) <= 1.0 + 1e-9):
            return
        w = inverse_radius(blob, ints, leaf, face, a, b)
        ux, uy, uz = direction_of(face, a, b)
        sx, sy, sz = ux / w, uy / w, uz / w
        worst, at = 1e-9, -1
        for k in range(count):
            o = planes + 4 * k
            h = blob[o] * sx + blob[o + 1] * sy + blob[o + 2] * sz - blob[o + 3]
            if h > worst:
                worst, at = h, o
        if at < 0:
            distance, t = distance_to(search, sx, sy, sz)
            offer(search, distance, t, sx, sy, sz)
            return
        back = worst + shrink
        x, y, z = sx - back * blob[at], sy - back * blob[at + 1], sz - back * blob[at + 2]


@njit(cache=True, error_model="numpy")
def cell_bound(
    blob, ints, leaf, planes, count, search, face, a, b, half_a, half_b, value, ga, gb, error, corners, spare
):
    """Return a lower bound of the segment's distance to the cell's surface in the region; offer a point of it.

    Infinite where no surface of the cell lies in the region. A cell too steep for its plane is bounded by a sphere.
    """
    if not quad_radius_ok(value, ga, gb, error, half_a, half_b):
        reach = abs(ga) * half_a + abs(gb) * half_b + error
        lo = max(value - reach, 1.0 / blob[ints[leaf + BOX] + 7])
        x, y, z, radius = cell_sphere(face, a, b, half_a, half_b, value, ga, gb, error, lo, value + reach)
        if outside_region(blob, planes, count, x, y, z, radius):
            return np.inf
        distance, _ = distance_to(search, x, y, z)
        x, y, z = direction_of(face, a, b)
        offer_patch_point(blob, ints, leaf, planes, count, search, face, x, y, z, radius)
        return distance - radius
    thick = model_thickness(face, a, b, half_a, half_b, value, ga, gb, error)
    c = value - ga * a - gb * b
    if face % 2 == 1:
        c = -c
    if face < 2:
        gx, gy, gz = c, ga, gb
    elif face < 4:
        gx, gy, gz = gb, c, ga
    else:
        gx, gy, gz = ga, gb, c
    if search[LENGTH2] == 0.0:
        # A point: its distance to the whole plane is often bound enough, and where its foot lies in the quad, exact.
        gg = gx * gx + gy * gy + gz * gz
        h = gx * search[START] + gy * search[START + 1] + gz * search[START + 2] - 1.0
        low = abs(h) / math.sqrt(gg) - thick
        if low > search[BEST] - search[TOLERANCE]:
            return low
    for corner in range(4):
        da = half_a if corner == 1 or corner == 2 else -half_a
        db = half_b if corner >= 2 else -half_b
        x, y, z = direction_of(face, a + da, b + db)
        m = 1.0 / (value + ga * da + gb * db)
        corners[corner, 0], corners[corner, 1], corners[corner, 2] = x * m, y * m, z * m
    size = 4
    for k in range(count):
        o = planes + 4 * k
        size = clip_polygon(corners, size, spare, blob[o], blob[o + 1], blob[o + 2], blob[o + 3] + thick)
        if size == 0:
            return np.inf
    distance, _, x, y, z = polygon_to_segment(
        corners,
        size,
        gx,
        gy,
        gz,
        search[START],
        search[START + 1],
        search[START + 2],
        search[VECTOR],
        search[VECTOR + 1],
        search[VECTOR + 2],
    )
    low = distance - thick
    if low < search[BEST] - search[TOLERANCE]:
        offer_patch_point(blob, ints, leaf, planes, count, search, face, x, y, z, 2.0 * thick)
    return low


@njit(cache=True, error_model="numpy")
def refine_cell(blob, ints, leaf, planes, count, search, face, a, b, half, corners, spare, rects):
    """Part a cell of the finest level until what is left of it can hold no nearer point."""
    depth = 0
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
            value, ga, gb, error, _, _, lo, _ = cell_model(blob, ints, leaf, face, ca, cb, half, half)
            low = cell_bound(
                blob, ints, leaf, planes, count, search, face, ca, cb, half, half, value, ga, gb, error, corners, spare
            )
            if low > search[BEST] - search[TOLERANCE]:
                continue
            if half / lo < FINEST:
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


@njit(cache=True, error_model="numpy")
def nearest_on_leaf(blob, ints, tab, leaf, planes, count, search, nodes, keys, corners, spare, rects):
    """Improve the search by the surface of a model leaf within its region. nodes: scratch; keys: their bounds."""
    n = ints[leaf + CELLS]
    spheres = ints[leaf + SPHERE_TABLE]
    depth = 0
    for face in range(6):
        o = spheres + 4 * (level_start(n, 1) + face)
        distance, _ = distance_to(search, tab[o], tab[o + 1], tab[o + 2])
        low = distance - tab[o + 3]
        k = depth
        while k > 0 and keys[k - 1] < low:
            keys[k], nodes[k] = keys[k - 1], nodes[k - 1]
            k -= 1
        keys[k], nodes[k] = low, ((0 * 8 + face) * 1024 + 0) * 1024
        depth += 1
    while depth > 0:
        depth -= 1
        if keys[depth] > search[BEST] - search[TOLERANCE]:
            continue
        code = nodes[depth]
        j, i, face, level = code % 1024, (code // 1024) % 1024, (code // 1048576) % 8, code // 8388608
        side = 2 << level
        base = depth
        start = 0 if side == n else spheres + 4 * (level_start(n, side) + face * side * side)
        for corner in range(4):
            ci, cj = 2 * i + (corner & 1), 2 * j + (corner >> 1)
            if side < n:
                o = start + 4 * (ci * side + cj)
                x, y, z, radius = tab[o], tab[o + 1], tab[o + 2], tab[o + 3]
                distance, _ = distance_to(search, x, y, z)
                low = distance - radius
                if low > search[BEST] - search[TOLERANCE] or outside_region(blob, planes, count, x, y, z, radius):
                    continue
            else:
                o = ints[leaf + CELL_TABLE] + CELL_SIZE * ((face * n + ci) * n + cj)
                a, b, half = (2 * ci + 1) / n - 1.0, (2 * cj + 1) / n - 1.0, 1.0 / n
                m = 1.0 / tab[o + VALUE]
                x, y, z = direction_of(face, a, b)
                x, y, z, radius = x * m, y * m, z * m, tab[o + RADIUS]
                distance, _ = distance_to(search, x, y, z)
                if distance - radius > search[BEST] - search[TOLERANCE]:
                    continue
                if outside_region(blob, planes, count, x, y, z, radius):
                    continue
                low = cell_bound(
                    blob, ints, leaf, planes, count, search, face, a, b, half, half,
                    tab[o + VALUE], tab[o + SLOPE_A], tab[o + SLOPE_B], tab[o + ERROR], corners, spare,
                )  # fmt: skip
                if low > search[BEST] - search[TOLERANCE]:
                    continue
            k = depth
            while k > base and keys[k - 1] < low:
                keys[k], nodes[k] = keys[k - 1], nodes[k - 1]
                k -= 1
            keys[k], nodes[k] = low, (((level + 1) * 8 + face) * 1024 + ci) * 1024 + cj
            depth += 1
        while depth > base and side == n:  # the finest cells that are left: part them
            depth -= 1
            if keys[depth] > search[BEST] - search[TOLERANCE]:
                continue
            code = nodes[depth]
            cj, ci = code % 1024, (code // 1024) % 1024
            refine_cell(
                blob, ints, leaf, planes, count, search, face,
                (2 * ci + 1) / n - 1.0, (2 * cj + 1) / n - 1.0, 1.0 / n, corners, spare, rects,
            )  # fmt: skip


@njit(cache=True, error_model="numpy")
def owner_planes(ints, owner):
    """Return (float slot, number) of the planes of an owner's region, in the owner's frame."""
    return ints[owner + OWNER_PLANE_FLOATS], ints[owner + OWNER_PLANES]
