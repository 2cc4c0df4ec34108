"""Convex polygons in space or in a chart: clipped by half-spaces, and their distance to a point or a segment."""

import math

from hhsr.kernels.unmanaged import inlined, unmanaged

ROOM = 24  # corners: four, and one more for each clipping plane


@unmanaged
def clip_polygon(corners, count, spare, nx, ny, nz, limit):
    """Clip corners (ROOM, 3)[:count] to n·p ≤ limit, in place; return the new count, 0 where nothing is left."""
    crossed = False
    kept = False
    for i in range(count):
        if nx * corners[i, 0] + ny * corners[i, 1] + nz * corners[i, 2] > limit:
            crossed = True
        else:
            kept = True
    if not crossed:
        return count
    if not kept:
        return 0
    new = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        hi = nx * corners[i, 0] + ny * corners[i, 1] + nz * corners[i, 2] - limit
        hj = nx * corners[j, 0] + ny * corners[j, 1] + nz * corners[j, 2] - limit
        if hi <= 0.0 and new < ROOM:
            for k in range(3):
                spare[new, k] = corners[i, k]
            new += 1
        if (hi <= 0.0) != (hj <= 0.0) and new < ROOM:
            x = hi / (hi - hj)
            for k in range(3):
                spare[new, k] = corners[i, k] + x * (corners[j, k] - corners[i, k])
            new += 1
    for i in range(new):
        for k in range(3):
            corners[i, k] = spare[i, k]
    return new


@inlined
def clip_in_chart(corners, count, spare, na, nb, limit):
    """Clip corners (ROOM, 3)[:count], (a, b, scratch), to na·a + nb·b ≤ limit, in place; return the new count."""
    beyond = 0
    for i in range(count):
        corners[i, 2] = na * corners[i, 0] + nb * corners[i, 1] - limit
        beyond += 1 if corners[i, 2] > 0.0 else 0
    if beyond == 0:
        return count
    if beyond == count:
        return 0
    new = 0
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        hi, hj = corners[i, 2], corners[j, 2]
        if hi <= 0.0 and new < ROOM:
            spare[new, 0], spare[new, 1] = corners[i, 0], corners[i, 1]
            new += 1
        if (hi <= 0.0) != (hj <= 0.0) and new < ROOM:
            x = hi / (hi - hj)
            spare[new, 0] = corners[i, 0] + x * (corners[j, 0] - corners[i, 0])
            spare[new, 1] = corners[i, 1] + x * (corners[j, 1] - corners[i, 1])
            new += 1
    for i in range(new):
        corners[i, 0], corners[i, 1] = spare[i, 0], spare[i, 1]
    return new


@unmanaged
def segment_to_segment(px, py, pz, dx, dy, dz, ax, ay, az, bx, by, bz):
    """Return (squared distance, t, s) between p + t·d and a + s·b, t and s in [0, 1]."""
    rx, ry, rz = px - ax, py - ay, pz - az
    dd = dx * dx + dy * dy + dz * dz
    bb = bx * bx + by * by + bz * bz
    br = bx * rx + by * ry + bz * rz
    dr = dx * rx + dy * ry + dz * rz
    db = dx * bx + dy * by + dz * bz
    if dd == 0.0:
        t = 0.0
        s = min(max(br / bb, 0.0), 1.0) if bb > 0.0 else 0.0
    elif bb == 0.0:
        s = 0.0
        t = min(max(-dr / dd, 0.0), 1.0)
    else:
        det = dd * bb - db * db
        t = min(max((db * br - dr * bb) / det, 0.0), 1.0) if det > 1e-14 * dd * bb else 0.0
        s = (db * t + br) / bb
        if s < 0.0:
            s = 0.0
            t = min(max(-dr / dd, 0.0), 1.0)
        elif s > 1.0:
            s = 1.0
            t = min(max((db - dr) / dd, 0.0), 1.0)
    x, y, z = rx + t * dx - s * bx, ry + t * dy - s * by, rz + t * dz - s * bz
    return x * x + y * y + z * z, t, s


@unmanaged
def _holds(corners, count, gx, gy, gz, x, y, z):
    """Return whether a point of the polygon's plane lies in the polygon, whichever way it turns."""
    left = right = False
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        ux, uy, uz = corners[j, 0] - corners[i, 0], corners[j, 1] - corners[i, 1], corners[j, 2] - corners[i, 2]
        vx, vy, vz = x - corners[i, 0], y - corners[i, 1], z - corners[i, 2]
        side = gx * (uy * vz - uz * vy) + gy * (uz * vx - ux * vz) + gz * (ux * vy - uy * vx)
        if side > 0.0:
            left = True
        elif side < 0.0:
            right = True
    return not (left and right)


@unmanaged
def polygon_to_segment(corners, count, gx, gy, gz, px, py, pz, dx, dy, dz):
    """Return (distance, t, x, y, z): of p + t·d, t in [0, 1], to the polygon in the plane g·x = 1, and its point.

    A point is a segment with d = 0.
    """
    gg = gx * gx + gy * gy + gz * gz
    best, bt, bx, by, bz = 1e300, 0.0, 0.0, 0.0, 0.0
    h0 = gx * px + gy * py + gz * pz - 1.0
    dh = gx * dx + gy * dy + gz * dz
    moving = dx != 0.0 or dy != 0.0 or dz != 0.0
    for end in range(3 if moving else 1):
        if end == 2:
            if dh == 0.0:
                continue
            t = -h0 / dh
            if not 0.0 < t < 1.0:
                continue
        else:
            t = float(end)
        h = h0 + t * dh
        x, y, z = px + t * dx - h / gg * gx, py + t * dy - h / gg * gy, pz + t * dz - h / gg * gz
        distance = abs(h) / math.sqrt(gg) if end < 2 else 0.0
        if distance < best and _holds(corners, count, gx, gy, gz, x, y, z):
            best, bt, bx, by, bz = distance, t, x, y, z
    if best == 0.0 or (not moving and best < 1e300):
        return best, bt, bx, by, bz
    for i in range(count):
        j = i + 1 if i + 1 < count else 0
        ux, uy, uz = corners[j, 0] - corners[i, 0], corners[j, 1] - corners[i, 1], corners[j, 2] - corners[i, 2]
        d2, t, s = segment_to_segment(px, py, pz, dx, dy, dz, corners[i, 0], corners[i, 1], corners[i, 2], ux, uy, uz)
        if d2 < best * best:
            best, bt = math.sqrt(d2), t
            bx, by, bz = corners[i, 0] + s * ux, corners[i, 1] + s * uy, corners[i, 2] + s * uz
    return best, bt, bx, by, bz
