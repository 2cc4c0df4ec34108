"""Spans of a stretch of a segment inside the solid: what is known of the depth between two places of it.

A row: t of the first end and a surface point, t of the last end and a surface point, the highest bound between them,
and its t; last, whether a seed was farther than what was known, where the span was parted. At every place of a span the
depth is no more than the distance to either point.
"""

import math

from hhsr.kernels.unmanaged import inlined, unmanaged

VAIN, SPAN_SIZE = 10, 11
NEIGHBOURS = 4.0  # lengths of a span: surface points no farther apart are on one bend of the surface


@inlined
def _highest(px, py, pz, dx, dy, dz, t0, t1, ax, ay, az, bx, by, bz):
    """Return the greatest min(|p(t) − a|, |p(t) − b|)² on [t0, t1], and its t: an upper bound of the distance²."""
    dd = dx * dx + dy * dy + dz * dz
    c0 = (px - ax) ** 2 + (py - ay) ** 2 + (pz - az) ** 2
    c1 = 2.0 * (dx * (px - ax) + dy * (py - ay) + dz * (pz - az))
    e0 = (px - bx) ** 2 + (py - by) ** 2 + (pz - bz) ** 2
    e1 = 2.0 * (dx * (px - bx) + dy * (py - by) + dz * (pz - bz))
    best, where = -1.0, t0
    for k in range(3):
        if k == 0:
            t = t0
        elif k == 1:
            t = t1
        else:
            if c1 == e1:
                continue
            t = (e0 - c0) / (c1 - e1)
            if not t0 < t < t1:
                continue
        value = min(c0 + t * (c1 + t * dd), e0 + t * (e1 + t * dd))
        if value > best:
            best, where = value, t
    return best, where


@unmanaged
def put_span(spans, s, px, py, pz, dx, dy, dz, a, ax, ay, az, b, bx, by, bz):
    """Write a span: its ends' t and surface points, the highest bound between them, and its t."""
    spans[s, 0], spans[s, 1], spans[s, 2], spans[s, 3] = a, ax, ay, az
    spans[s, 4], spans[s, 5], spans[s, 6], spans[s, 7] = b, bx, by, bz
    value2, spans[s, 9] = _highest(px, py, pz, dx, dy, dz, a, b, ax, ay, az, bx, by, bz)
    spans[s, 8] = math.sqrt(value2)


@inlined
def tell_spans(spans, used, px, py, pz, dx, dy, dz, x, y, z):
    """Let a surface point stand for the ends of all spans that it is nearer to than their own."""
    for s in range(used):
        nearer = False
        for o in range(0, 8, 4):
            t = spans[s, o]
            qx, qy, qz = px + t * dx, py + t * dy, pz + t * dz
            own2 = (spans[s, o + 1] - qx) ** 2 + (spans[s, o + 2] - qy) ** 2 + (spans[s, o + 3] - qz) ** 2
            if (x - qx) ** 2 + (y - qy) ** 2 + (z - qz) ** 2 < own2:
                spans[s, o + 1], spans[s, o + 2], spans[s, o + 3] = x, y, z
                nearer = True
        if nearer:
            put_span(
                spans, s, px, py, pz, dx, dy, dz, spans[s, 0], spans[s, 1], spans[s, 2], spans[s, 3], spans[s, 4],
                spans[s, 5], spans[s, 6], spans[s, 7],
            )  # fmt: skip


@unmanaged
def _rise(spans, s, o, px, py, pz, dx, dy, dz):
    """Return (distance, its change with t) at the end of a span whose slots begin at o, by the end's surface point."""
    t = spans[s, o]
    rx, ry, rz = px + t * dx - spans[s, o + 1], py + t * dy - spans[s, o + 2], pz + t * dz - spans[s, o + 3]
    distance = math.sqrt(rx * rx + ry * ry + rz * rz)
    along = rx * dx + ry * dy + rz * dz
    if distance > 0.0:
        return distance, along / distance
    return 0.0, (1.0 if o == 0 else -1.0) * math.sqrt(dx * dx + dy * dy + dz * dz)


@inlined
def summit_of(spans, used, px, py, pz, dx, dy, dz, s, t):
    """Return (s, t) of a span and a place in it where it is likely deepest; those given where none is better.

    In a span that is deeper ahead of its first end and behind its last; where their surface points are near each other
    the slopes say where it is deepest.
    """
    best = 0.0
    for k in range(used):
        first, rise = _rise(spans, k, 0, px, py, pz, dx, dy, dz)
        second, fall = _rise(spans, k, 4, px, py, pz, dx, dy, dz)
        if max(first, second) > best and rise > 0.0 and fall < 0.0:
            best, s, t = max(first, second), k, spans[k, 9]
            a, b = spans[k, 0], spans[k, 4]
            apart2 = (
                (spans[k, 1] - spans[k, 5]) ** 2 + (spans[k, 2] - spans[k, 6]) ** 2 + (spans[k, 3] - spans[k, 7]) ** 2
            )
            if apart2 < (NEIGHBOURS * (b - a)) ** 2 * (dx * dx + dy * dy + dz * dz):
                t = a + (b - a) * rise / (rise - fall)
    return s, t


@inlined
def close_spans(spans, used, high, px, py, pz, dx, dy, dz, begin, end):
    """Take [begin, end] out of the spans that are bounded by more than `high`; return how many spans are left."""
    for s in range(used - 1, -1, -1):
        a, b = spans[s, 0], spans[s, 4]
        if spans[s, 8] <= high or end <= a or begin >= b:
            continue
        if begin <= a and b <= end:
            used -= 1
            for q in range(spans.shape[1]):
                spans[s, q] = spans[used, q]
        elif begin <= a or b <= end:
            a, b = (end, b) if begin <= a else (a, begin)
            put_span(
                spans, s, px, py, pz, dx, dy, dz, a, spans[s, 1], spans[s, 2], spans[s, 3], b, spans[s, 5],
                spans[s, 6], spans[s, 7],
            )  # fmt: skip
    return used
