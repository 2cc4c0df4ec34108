"""The nearest point of a slab's strips to a segment or a point: flat pieces with proven thickness, parted as needed."""

import math

import numpy as np
from numba import njit

from hhsr.kernels.maps import outside_region
from hhsr.kernels.patch import BEST, FINEST, START, TOLERANCE, VECTOR, distance_to, offer
from hhsr.kernels.polygon import clip_polygon, polygon_to_segment
from hhsr.kernels.slab import (
    ENCLOSURE,
    LOBE_COUNT,
    LOBE_INT_SIZE,
    LOBE_SPHERES,
    LOBE_TABLES,
    LOBES,
    SLAB_FRAME,
    TABLE,
    lobe_radius,
)
from hhsr.kernels.slab_bounds import STEP, lobe_model


@njit(cache=True, error_model="numpy")
def _is_surface(blob, ints, slab, lobe, planes, count, x, y, z, u, v, t):
    """Return whether a strip's point lies in the region and in no other lobe."""
    if outside_region(blob, planes, count, x, y, z, 1e-9):
        return False
    for k in range(ints[slab + LOBE_COUNT]):
        other = ints[slab + LOBES] + LOBE_INT_SIZE * k
        if other != lobe:
            o = ints[other + LOBE_TABLES]
            du, dv = u - blob[o], v - blob[o + 1]
            if math.sqrt(du * du + dv * dv) < lobe_radius(blob, ints, other, du, dv, t) - 1e-9:
                return False
    return True


@njit(cache=True, error_model="numpy")
def _offer_strip_point(blob, ints, slab, lobe, planes, count, search, x, y, z, shrink):
    """Move a point near a strip along its ray in the plane to the exact strip and offer it, if that is surface."""
    f = ints[slab + SLAB_FRAME]
    o = ints[lobe + LOBE_TABLES]
    for _ in range(3):
        u = blob[f] * x + blob[f + 1] * y + blob[f + 2] * z - blob[o]
        v = blob[f + 3] * x + blob[f + 4] * y + blob[f + 5] * z - blob[o + 1]
        h = blob[f + 6] * x + blob[f + 7] * y + blob[f + 8] * z - blob[f + 9]
        h = min(max(h, -blob[f + 10]), blob[f + 10])
        t = 0.5 * (h / blob[f + 10] + 1.0)
        length = math.sqrt(u * u + v * v)
        r = lobe_radius(blob, ints, lobe, u, v, t)
        if length == 0.0 or r <= 1e-9:
            return
        u, v, h = u * r / length + blob[o], v * r / length + blob[o + 1], h + blob[f + 9]
        x = u * blob[f] + v * blob[f + 3] + h * blob[f + 6]
        y = u * blob[f + 1] + v * blob[f + 4] + h * blob[f + 7]
        z = u * blob[f + 2] + v * blob[f + 5] + h * blob[f + 8]
        if _is_surface(blob, ints, slab, lobe, planes, count, x, y, z, u, v, t):
            distance, where = distance_to(search, x, y, z)
            offer(search, distance, where, x, y, z)
            return
        worst, at = 1e-9, -1
        for k in range(count):
            q = planes + 4 * k
            excess = blob[q] * x + blob[q + 1] * y + blob[q + 2] * z - blob[q + 3]
            if excess > worst:
                worst, at = excess, q
        if at < 0:
            return
        back = worst + shrink
        x, y, z = x - back * blob[at], y - back * blob[at + 1], z - back * blob[at + 2]


@njit(cache=True, error_model="numpy")
def _within_another(blob, ints, slab, lobe, u, v, extent, t, half_t):
    """Return whether a disc of the plane about (u, v), at t ± half_t, lies inside another lobe: no surface then."""
    for k in range(ints[slab + LOBE_COUNT]):
        other = ints[slab + LOBES] + LOBE_INT_SIZE * k
        if other == lobe:
            continue
        o = ints[other + LOBE_TABLES]
        du, dv = u - blob[o], v - blob[o + 1]
        away = math.sqrt(du * du + dv * dv)
        if away <= extent:
            continue
        angle, half = math.atan2(dv, du), math.asin(extent / away) + 1e-12
        first, last = int((angle - half + math.pi) / STEP), int((angle + half + math.pi) / STEP)
        if first == last and 0 <= first < TABLE and angle - half > -math.pi:
            _, _, _, _, low, _ = lobe_model(blob, ints, other, first, angle, t, half, half_t)
            if away + extent < low:
                return True
    return False


@njit(cache=True, error_model="numpy")
def strip_bound(blob, ints, slab, lobe, segment, planes, count, search, angle, t, half, half_t, corners, spare):
    """Return a lower bound of the segment's distance to a piece of strip in the region; offer a point of it.

    Infinite: no surface there. About the middle the piece is the parallelogram of its linear model, and lies within
    error + r·δ²/2 + |r − r_c|·δ + r·δ³/6 of it (δ the half angle), for the radius turns with the angle.
    """
    r, ga, gt, error, low, high = lobe_model(blob, ints, lobe, segment, angle, t, half, half_t)
    if high <= 0.0:
        return np.inf
    f = ints[slab + SLAB_FRAME]
    o = ints[lobe + LOBE_TABLES]
    d = blob[f + 10]
    cosine, sine = math.cos(angle), math.sin(angle)
    size_r = max(abs(low), abs(high))
    thick = (
        error
        + 0.5 * size_r * half * half
        + (abs(ga) * half + abs(gt) * half_t + error) * half
        + size_r * half * half * half / 6.0
    ) * (1.0 + 1e-9)
    if ints[slab + LOBE_COUNT] > 1:
        extent = abs(ga) * half + abs(gt) * half_t + error + size_r * half + thick
        u, v = blob[o] + r * cosine, blob[o + 1] + r * sine
        if _within_another(blob, ints, slab, lobe, u, v, extent, t, half_t):
            return np.inf
    for corner in range(4):
        da = half if corner == 1 or corner == 2 else -half
        dt = half_t if corner >= 2 else -half_t
        radial, turn = r + ga * da + gt * dt, r * da
        u = blob[o] + radial * cosine - turn * sine
        v = blob[o + 1] + radial * sine + turn * cosine
        h = blob[f + 9] + (2.0 * (t + dt) - 1.0) * d
        for k in range(3):
            corners[corner, k] = u * blob[f + k] + v * blob[f + 3 + k] + h * blob[f + 6 + k]
    ux, uy, uz = corners[1, 0] - corners[0, 0], corners[1, 1] - corners[0, 1], corners[1, 2] - corners[0, 2]
    vx, vy, vz = corners[3, 0] - corners[0, 0], corners[3, 1] - corners[0, 1], corners[3, 2] - corners[0, 2]
    nx, ny, nz = uy * vz - uz * vy, uz * vx - ux * vz, ux * vy - uy * vx
    length = math.sqrt(nx * nx + ny * ny + nz * nz)
    size = np.int64(4)
    for k in range(count):
        q = planes + 4 * k
        size = clip_polygon(corners, size, spare, blob[q], blob[q + 1], blob[q + 2], blob[q + 3] + thick)
        if size == 0:
            return np.inf
    if length < 1e-14:  # a piece without area: its first corner, and as thick as it is long
        grow = math.sqrt((ux + vx) ** 2 + (uy + vy) ** 2 + (uz + vz) ** 2) + abs(r) * half
        distance, _ = distance_to(search, corners[0, 0], corners[0, 1], corners[0, 2])
        _offer_strip_point(
            blob, ints, slab, lobe, planes, count, search, corners[0, 0], corners[0, 1], corners[0, 2], 2.0 * thick
        )
        return distance - grow - 2.0 * half_t * d - thick
    nx, ny, nz = nx / length, ny / length, nz / length
    ox, oy, oz = corners[0, 0] - nx, corners[0, 1] - ny, corners[0, 2] - nz
    for k in range(size):
        corners[k, 0] -= ox
        corners[k, 1] -= oy
        corners[k, 2] -= oz
    distance, _, x, y, z = polygon_to_segment(
        corners,
        size,
        nx,
        ny,
        nz,
        search[START] - ox,
        search[START + 1] - oy,
        search[START + 2] - oz,
        search[VECTOR],
        search[VECTOR + 1],
        search[VECTOR + 2],
    )
    if distance - thick < search[BEST] - search[TOLERANCE]:
        _offer_strip_point(blob, ints, slab, lobe, planes, count, search, x + ox, y + oy, z + oz, 2.0 * thick)
    return distance - thick


@njit(cache=True, error_model="numpy")
def _refine_segment(blob, ints, slab, lobe, segment, planes, count, search, corners, spare, rects):
    """Part the strip over one segment of the tables until nothing left of it can be nearer."""
    d = blob[ints[slab + SLAB_FRAME] + 10]
    rects[0, 0], rects[0, 1], rects[0, 2], rects[0, 3] = (segment + 0.5) * STEP - math.pi, 0.5, 0.5 * STEP, 0.5
    depth = 1
    while depth > 0:
        depth -= 1
        angle, t, half, half_t = rects[depth, 0], rects[depth, 1], rects[depth, 2], rects[depth, 3]
        low = strip_bound(
            blob, ints, slab, lobe, segment, planes, count, search, angle, t, half, half_t, corners, spare
        )
        if low > search[BEST] - search[TOLERANCE]:
            continue
        o = ints[lobe + LOBE_SPHERES] + ENCLOSURE * segment
        wide, tall = half * blob[o + 5], half_t * d
        if max(wide, tall) < FINEST or depth + 2 > rects.shape[0]:
            continue
        if wide >= tall:
            half *= 0.5
            angle -= half
            rects[depth, 0], rects[depth, 1], rects[depth, 2], rects[depth, 3] = angle, t, half, half_t
            rects[depth + 1, 0], rects[depth + 1, 1] = angle + 2.0 * half, t
        else:
            half_t *= 0.5
            t -= half_t
            rects[depth, 0], rects[depth, 1], rects[depth, 2], rects[depth, 3] = angle, t, half, half_t
            rects[depth + 1, 0], rects[depth + 1, 1] = angle, t + 2.0 * half_t
        rects[depth + 1, 2], rects[depth + 1, 3] = half, half_t
        depth += 2


@njit(cache=True, error_model="numpy")
def nearest_on_slab(blob, ints, slab, planes, count, search, corners, spare, rects):
    """Improve the search by the strips of a slab within its region: the nearest segment first, then all that remain."""
    for k in range(ints[slab + LOBE_COUNT]):
        lobe = ints[slab + LOBES] + LOBE_INT_SIZE * k
        spheres = ints[lobe + LOBE_SPHERES]
        best, at = 1e300, np.int64(0)
        for segment in range(TABLE):
            o = spheres + ENCLOSURE * segment
            distance, _ = distance_to(search, blob[o], blob[o + 1], blob[o + 2])
            if distance - blob[o + 3] < best:
                best, at = distance - blob[o + 3], segment
        if best > search[BEST] - search[TOLERANCE]:
            continue
        _refine_segment(blob, ints, slab, lobe, at, planes, count, search, corners, spare, rects)
        for segment in range(TABLE):
            o = spheres + ENCLOSURE * segment
            distance, _ = distance_to(search, blob[o], blob[o + 1], blob[o + 2])
            if segment != at and distance - blob[o + 3] <= search[BEST] - search[TOLERANCE]:
                _refine_segment(blob, ints, slab, lobe, segment, planes, count, search, corners, spare, rects)
