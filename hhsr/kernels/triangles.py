"""A bounding-volume hierarchy over triangles: nearest point, exact parity, exact crossings.

A tree is four arrays. boxes: (k, 6) x0 y0 z0 x1 y1 z1. links: (k, 2) first and count; count > 0: a leaf with the
triangles first … first + count; count = 0: the children are `first` and `first + 1`. corners: (n, 3, 3) in tree order.
order: (n,) the caller's face index of each.
"""

import math

import numpy as np
from numba import njit

from hhsr.kernels.predicates import column_side, line_side, plane_side
from hhsr.kernels.triangle_build import STACK

ROUNDING = 1e-15
TIE = 1e-12


@njit(cache=True, inline="always")
def box_distance2(box, x, y, z):
    """Return the squared distance of a point to a box (6,); 0 inside."""
    dx = max(box[0] - x, 0.0, x - box[3])
    dy = max(box[1] - y, 0.0, y - box[4])
    dz = max(box[2] - z, 0.0, z - box[5])
    return dx * dx + dy * dy + dz * dz


@njit(cache=True, inline="always")
def _edge_distance2(x, y, z, ux, uy, uz):
    """Return (squared distance, share) of a point to the segment 0 → u."""
    length2 = ux * ux + uy * uy + uz * uz
    t = min(max((x * ux + y * uy + z * uz) / length2, 0.0), 1.0) if length2 > 0.0 else 0.0
    dx, dy, dz = x - t * ux, y - t * uy, z - t * uz
    return dx * dx + dy * dy + dz * dz, t


@njit(cache=True)
def triangle_distance2(corner, px, py, pz):
    """Return (squared distance, v, w); the nearest point of the triangle is a + v (b − a) + w (c − a)."""
    x, y, z = px - corner[0, 0], py - corner[0, 1], pz - corner[0, 2]
    ux, uy, uz = corner[1, 0] - corner[0, 0], corner[1, 1] - corner[0, 1], corner[1, 2] - corner[0, 2]
    vx, vy, vz = corner[2, 0] - corner[0, 0], corner[2, 1] - corner[0, 1], corner[2, 2] - corner[0, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    area2 = nx * nx + ny * ny + nz * nz
    if area2 > 0.0:
        # Barycentric coordinates by n · (u × p) and n · (p × v): stable for slivers, where Gram determinants are not.
        w = (nx * (uy * z - uz * y) + ny * (uz * x - ux * z) + nz * (ux * y - uy * x)) / area2
        v = (nx * (y * vz - z * vy) + ny * (z * vx - x * vz) + nz * (x * vy - y * vx)) / area2
        if v >= 0.0 and w >= 0.0 and v + w <= 1.0:
            dx, dy, dz = x - v * ux - w * vx, y - v * uy - w * vy, z - v * uz - w * vz
            return dx * dx + dy * dy + dz * dz, v, w
    best, t = _edge_distance2(x, y, z, ux, uy, uz)
    best_v, best_w = t, 0.0
    d2, t = _edge_distance2(x, y, z, vx, vy, vz)
    if d2 < best:
        best, best_v, best_w = d2, 0.0, t
    d2, t = _edge_distance2(x - ux, y - uy, z - uz, vx - ux, vy - uy, vz - uz)
    if d2 < best:
        best, best_v, best_w = d2, 1.0 - t, t
    return best, best_v, best_w


@njit(cache=True)
def nearest_triangle(boxes, links, corners, x, y, z, limit2, hint, stack, keys):
    """Return (index in tree order, squared distance, v, w) of the nearest triangle within √limit2; −1 where none.

    hint: a triangle to start from (its distance bounds the search), or −1. stack, keys: (STACK,) scratch.
    """
    best, best_v, best_w, found = limit2, 0.0, 0.0, -1
    if hint >= 0:
        d2, v, w = triangle_distance2(corners[hint], x, y, z)
        if d2 <= best:
            best, best_v, best_w, found = d2, v, w, hint
    depth = 0
    if corners.shape[0] > 0:
        stack[0] = 0
        keys[0] = box_distance2(boxes[0], x, y, z)
        depth = 1
    while depth > 0:
        depth -= 1
        if keys[depth] >= best and found >= 0:
            continue
        node = stack[depth]
        first, count = links[node, 0], links[node, 1]
        if count > 0:
            for i in range(first, first + count):
                d2, v, w = triangle_distance2(corners[i], x, y, z)
                if d2 < best or (d2 == best and found < 0):
                    best, best_v, best_w, found = d2, v, w, i
            continue
        near, far = box_distance2(boxes[first], x, y, z), box_distance2(boxes[first + 1], x, y, z)
        a, b = first, first + 1
        if far < near:
            near, far, a, b = far, near, b, a
        if far <= best:
            stack[depth], keys[depth] = b, far
            depth += 1
        if near <= best:
            stack[depth], keys[depth] = a, near
            depth += 1
    return found, best, best_v, best_w


@njit(cache=True, nogil=True)
def nearest_points(boxes, links, corners, order, points, distance, nearest, face):
    """Fill (n,) distance, (n, 3) nearest and (n,) face for (n, 3) points; the last answer starts the next search."""
    stack, keys = np.empty(STACK, dtype=np.int64), np.empty(STACK)
    hint = -1
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        hint, d2, v, w = nearest_triangle(boxes, links, corners, x, y, z, np.inf, hint, stack, keys)
        distance[i] = math.sqrt(d2)
        face[i] = order[hint]
        for k in range(3):
            a = corners[hint, 0, k]
            nearest[i, k] = a + v * (corners[hint, 1, k] - a) + w * (corners[hint, 2, k] - a)


@njit(cache=True)
def inside_parity(boxes, links, corners, point, stack):
    """Return whether the closed triangles hold the point (3,): parity of the exact crossings above it.

    A point on a triangle is inside.
    """
    x, y, z = point[0], point[1], point[2]
    odd = False
    depth = 0
    if corners.shape[0] > 0:
        stack[0] = 0
        depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        box = boxes[node]
        if x < box[0] or x > box[3] or y < box[1] or y > box[4] or z > box[5]:
            continue
        first, count = links[node, 0], links[node, 1]
        if count == 0:
            stack[depth], stack[depth + 1] = first, first + 1
            depth += 2
            continue
        for i in range(first, first + count):
            corner = corners[i]
            if z >= box[2] and triangle_distance2(corner, x, y, z)[0] == 0.0:
                return True
            side = column_side(corner[0], corner[1], point)
            if side == 0 or column_side(corner[1], corner[2], point) != side:
                continue
            if column_side(corner[2], corner[0], point) != side:
                continue
            if plane_side(corner[0], corner[1], corner[2], point) == -side:
                odd = not odd
    return odd


@njit(cache=True, nogil=True)
def inside_points(boxes, links, corners, points, inside):
    """Fill (n,) bool for (n, 3) points."""
    stack = np.empty(STACK, dtype=np.int64)
    for i in range(points.shape[0]):
        inside[i] = inside_parity(boxes, links, corners, points[i], stack)


@njit(cache=True, inline="always")
def segment_meets_box(box, start, inverse, limit):
    """Return the t in [0, limit] where the segment enters the box (6,), or −1; never misses by rounding.

    inverse: (3,) 1/d per axis, 0 where d = 0.
    """
    t0, t1 = 0.0, limit
    for k in range(3):
        if inverse[k] == 0.0:
            if start[k] < box[k] or start[k] > box[3 + k]:
                return -1.0
            continue
        a, b = (box[k] - start[k]) * inverse[k], (box[3 + k] - start[k]) * inverse[k]
        if a > b:
            a, b = b, a
        t0, t1 = max(t0, a), min(t1, b)
    if t0 * (1.0 - ROUNDING) > t1 * (1.0 + ROUNDING):
        return -1.0
    return t0 * (1.0 - ROUNDING)


@njit(cache=True)
def segment_triangle(corner, start, end):
    """Return (hit, t): 1 where the segment goes out through the triangle, −1 in, 0 misses it; t in [0, 1]."""
    a, b, c = corner[0], corner[1], corner[2]
    side = line_side(start, end, a, b)
    if side == 0 or line_side(start, end, b, c) != side or line_side(start, end, c, a) != side:
        return 0, 0.0
    before, after = plane_side(a, b, c, start), plane_side(a, b, c, end)
    if before == after:
        return 0, 0.0
    nx = (b[1] - a[1]) * (c[2] - a[2]) - (b[2] - a[2]) * (c[1] - a[1])
    ny = (b[2] - a[2]) * (c[0] - a[0]) - (b[0] - a[0]) * (c[2] - a[2])
    nz = (b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])
    h0 = nx * (start[0] - a[0]) + ny * (start[1] - a[1]) + nz * (start[2] - a[2])
    h1 = nx * (end[0] - a[0]) + ny * (end[1] - a[1]) + nz * (end[2] - a[2])
    t = h0 / (h0 - h1) if h0 != h1 else 0.0
    return after, min(max(t, 0.0), 1.0)


@njit(cache=True)
def invert_direction(start, end, inverse):
    """Fill (3,) 1/(end − start), 0 where it is 0 (or so small that its inverse is not finite)."""
    for k in range(3):
        d = end[k] - start[k]
        inverse[k] = 0.0
        if d != 0.0:
            r = 1.0 / d
            inverse[k] = r if math.isfinite(r) else 0.0


@njit(cache=True)
def segment_crossings(boxes, links, corners, start, end, t, index, out, inverse, stack):
    """Fill t, index (tree order) and out (1 leaving, −1 entering) of all crossings, unsorted; return their number.

    A number greater than t.size says how much room is needed: the rest was not written.
    """
    invert_direction(start, end, inverse)
    found = 0
    depth = 0
    if corners.shape[0] > 0:
        stack[0] = 0
        depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        if segment_meets_box(boxes[node], start, inverse, 1.0) < 0.0:
            continue
        first, count = links[node, 0], links[node, 1]
        if count == 0:
            stack[depth], stack[depth + 1] = first, first + 1
            depth += 2
            continue
        for i in range(first, first + count):
            hit, where = segment_triangle(corners[i], start, end)
            if hit != 0:
                if found < t.shape[0]:
                    t[found], index[found], out[found] = where, i, hit
                found += 1
    return found


@njit(cache=True)
def sort_crossings(t, index, out, count):
    """Sort the first `count` crossings by t, in place.

    Where t ties to rounding, the order is chosen so that entering and leaving alternate, as on closed triangles.
    """
    for i in range(1, count):
        ti, fi, oi = t[i], index[i], out[i]
        j = i - 1
        while j >= 0 and t[j] > ti:
            t[j + 1], index[j + 1], out[j + 1] = t[j], index[j], out[j]
            j -= 1
        t[j + 1], index[j + 1], out[j + 1] = ti, fi, oi
    if count > 1 and not _alternate(t, index, out, count, out[0]):
        _alternate(t, index, out, count, -out[0])


@njit(cache=True)
def _alternate(t, index, out, count, want):
    """Exchange tied crossings until out = want, −want, …; return False at the first that no tied one can mend."""
    for i in range(count):
        j = i
        while j < count and t[j] - t[i] <= TIE and out[j] != want:
            j += 1
        if j == count or t[j] - t[i] > TIE:
            return False
        index[i], index[j] = index[j], index[i]
        out[i], out[j] = out[j], out[i]
        want = -want
    return True


@njit(cache=True, nogil=True)
def all_crossings(boxes, links, corners, order, starts, ends):
    """Return (offsets, t, face, out) of all crossings of (n, 3) → (n, 3) segments, each segment's in order of t."""
    n = starts.shape[0]
    offsets = np.zeros(n + 1, dtype=np.int64)
    room = max(4 * n, 16)
    all_t, all_face, all_out = np.empty(room), np.empty(room, dtype=np.int64), np.empty(room, dtype=np.int8)
    t, index, out = np.empty(64), np.empty(64, dtype=np.int64), np.empty(64, dtype=np.int8)
    inverse, stack = np.empty(3), np.empty(STACK, dtype=np.int64)
    for i in range(n):
        found = segment_crossings(boxes, links, corners, starts[i], ends[i], t, index, out, inverse, stack)
        if found > t.shape[0]:
            t, index, out = np.empty(2 * found), np.empty(2 * found, dtype=np.int64), np.empty(2 * found, dtype=np.int8)
            found = segment_crossings(boxes, links, corners, starts[i], ends[i], t, index, out, inverse, stack)
        sort_crossings(t, index, out, found)
        base = offsets[i]
        offsets[i + 1] = base + found
        if base + found > room:
            grown = 2 * (base + found)
            new_t, new_face = np.empty(grown), np.empty(grown, dtype=np.int64)
            new_out = np.empty(grown, dtype=np.int8)
            new_t[:base], new_face[:base], new_out[:base] = all_t[:base], all_face[:base], all_out[:base]
            all_t, all_face, all_out, room = new_t, new_face, new_out, grown
        for j in range(found):
            all_t[base + j], all_face[base + j], all_out[base + j] = t[j], order[index[j]], out[j]
    total = offsets[n]
    return offsets, all_t[:total].copy(), all_face[:total].copy(), all_out[:total].copy()


@njit(cache=True)
def first_triangle(boxes, links, corners, start, end, inverse, stack, keys):
    """Return (index in tree order, t) of the first crossing of start → end, or (−1, NaN)."""
    invert_direction(start, end, inverse)
    best, found = 1.0, -1
    depth = 0
    if corners.shape[0] > 0:
        stack[0] = 0
        keys[0] = segment_meets_box(boxes[0], start, inverse, 1.0)
        depth = 1
    while depth > 0:
        depth -= 1
        if keys[depth] < 0.0 or keys[depth] > best:
            continue
        first, count = links[stack[depth], 0], links[stack[depth], 1]
        if count > 0:
            for i in range(first, first + count):
                hit, t = segment_triangle(corners[i], start, end)
                if hit != 0 and (t < best or found < 0):
                    best, found = t, i
            continue
        near = segment_meets_box(boxes[first], start, inverse, best)
        far = segment_meets_box(boxes[first + 1], start, inverse, best)
        a, b = first, first + 1
        if far < near:
            near, far, a, b = far, near, b, a
        stack[depth], keys[depth] = b, far
        stack[depth + 1], keys[depth + 1] = a, near
        depth += 2
    return found, best if found >= 0 else np.nan


@njit(cache=True, nogil=True)
def first_crossings(boxes, links, corners, order, starts, ends, t, face):
    """Fill (n,) t in [0, 1] (NaN: none) and (n,) face (−1: none) of each segment's first crossing."""
    inverse, stack, keys = np.empty(3), np.empty(STACK, dtype=np.int64), np.empty(STACK)
    for i in range(starts.shape[0]):
        found, t[i] = first_triangle(boxes, links, corners, starts[i], ends[i], inverse, stack, keys)
        face[i] = order[found] if found >= 0 else -1
