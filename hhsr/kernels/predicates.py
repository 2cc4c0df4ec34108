"""Exact signs of small determinants (Shewchuk 1997): a floating-point filter, then sums without rounding.

Ties are broken as if the query were moved by (ε, ε², ε³), the same for every triangle (simulation of simplicity,
Edelsbrunner and Mücke 1990), so a line never passes through a vertex or an edge, and a closed mesh is always crossed an
even number of times.
"""

import numpy as np
from numba import njit

from hhsr.kernels.unmanaged import managed

SPLITTER = 134217729.0  # 2^27 + 1
DET2_BOUND = 3.3306690738754716e-16  # (3 + 16 u) u, u = 2^-53
DET3_BOUND = 7.771561172376103e-16  # (7 + 56 u) u


@njit(cache=True, inline="always")
def two_sum(a, b):
    """Return (s, e) with s = fl(a + b) and s + e = a + b exactly."""
    s = a + b
    bb = s - a
    return s, (a - (s - bb)) + (b - bb)


@njit(cache=True, inline="always")
def two_product(a, b):
    """Return (p, e) with p = fl(a · b) and p + e = a · b exactly (Dekker)."""
    p = a * b
    c = SPLITTER * a
    ah = c - (c - a)
    al = a - ah
    c = SPLITTER * b
    bh = c - (c - b)
    bl = b - bh
    return p, al * bl - (((p - ah * bh) - al * bh) - ah * bl)


@njit(cache=True)
def _grow(total, count, value):
    """Add `value` to the expansion total[:count] without rounding; return its new length."""
    carry = value
    kept = 0
    for i in range(count):
        carry, rest = two_sum(carry, total[i])
        if rest != 0.0:
            total[kept] = rest
            kept += 1
    if carry != 0.0:
        total[kept] = carry
        kept += 1
    return kept


@njit(cache=True)
def _sign_of_sum(total, count):
    if count == 0:
        return 0
    return 1 if total[count - 1] > 0.0 else -1


@managed
def _exact_det3(m):
    """Return the sign of the determinant of the (3, 3, 2) matrix of exact sums (value, rounding rest)."""
    total = np.empty(200)
    count = 0
    for turn in range(6):
        j = turn % 3
        k = (j + 1) % 3 if turn < 3 else (j + 2) % 3
        third = 3 - j - k
        sign = 1.0 if turn < 3 else -1.0
        for p in range(2):
            x = m[0, j, p]
            if x == 0.0:
                continue
            for q in range(2):
                y = m[1, k, q]
                if y == 0.0:
                    continue
                xy, xy_rest = two_product(x, y)
                for r in range(2):
                    z = m[2, third, r]
                    if z == 0.0:
                        continue
                    high, rest = two_product(xy, z)
                    count = _grow(total, count, sign * rest)
                    count = _grow(total, count, sign * high)
                    high, rest = two_product(xy_rest, z)
                    count = _grow(total, count, sign * rest)
                    count = _grow(total, count, sign * high)
    return _sign_of_sum(total, count)


@managed
def det3_sign(a, b, c, origin):
    """Return the exact sign (−1, 0, 1) of det(a − origin, b − origin, c − origin) of four points (3,)."""
    ax, ay, az = a[0] - origin[0], a[1] - origin[1], a[2] - origin[2]
    bx, by, bz = b[0] - origin[0], b[1] - origin[1], b[2] - origin[2]
    cx, cy, cz = c[0] - origin[0], c[1] - origin[1], c[2] - origin[2]
    p0, p1 = by * cz, bz * cy
    p2, p3 = bz * cx, bx * cz
    p4, p5 = bx * cy, by * cx
    det = ax * (p0 - p1) + ay * (p2 - p3) + az * (p4 - p5)
    bound = DET3_BOUND * (abs(ax) * (abs(p0) + abs(p1)) + abs(ay) * (abs(p2) + abs(p3)) + abs(az) * (abs(p4) + abs(p5)))
    if det > bound:
        return 1
    if -det > bound:
        return -1
    m = np.empty((3, 3, 2))
    for k in range(3):
        m[0, k, 0], m[0, k, 1] = two_sum(a[k], -origin[k])
        m[1, k, 0], m[1, k, 1] = two_sum(b[k], -origin[k])
        m[2, k, 0], m[2, k, 1] = two_sum(c[k], -origin[k])
    return _exact_det3(m)


@managed
def det2_sign(p, p0, q, q0, j, k):
    """Return the exact sign of u_j v_k − u_k v_j with u = p − p0, v = q − q0, of points (3,)."""
    uj, uk, vj, vk = p[j] - p0[j], p[k] - p0[k], q[j] - q0[j], q[k] - q0[k]
    left, right = uj * vk, uk * vj
    det = left - right
    bound = DET2_BOUND * (abs(left) + abs(right))
    if det > bound:
        return 1
    if -det > bound:
        return -1
    m = np.empty((4, 2))
    m[0, 0], m[0, 1] = two_sum(p[j], -p0[j])
    m[1, 0], m[1, 1] = two_sum(q[k], -q0[k])
    m[2, 0], m[2, 1] = two_sum(p[k], -p0[k])
    m[3, 0], m[3, 1] = two_sum(q[j], -q0[j])
    total = np.empty(20)
    count = 0
    for term in range(2):
        sign = 1.0 - 2.0 * term
        for r in range(2):
            for s in range(2):
                high, rest = two_product(m[2 * term, r], m[2 * term + 1, s])
                count = _grow(total, count, sign * rest)
                count = _grow(total, count, sign * high)
    return _sign_of_sum(total, count)


@njit(cache=True)
def cross_sign(p, p0, q, q0):
    """Return the sign of the first component of (p − p0) × (q − q0) that is not 0: the tie rule of both tests below."""
    for turn in range(3):
        s = det2_sign(p, p0, q, q0, (turn + 1) % 3, (turn + 2) % 3)
        if s != 0:
            return s
    return 0


@njit(cache=True)
def line_side(start, end, a, b):
    """Return on which side (±1) of the edge a → b the line start → end passes; 0 only where they are parallel.

    f = d · ((a − s) × (b − s)); moved by δ it gains δ · (d × (b − a)).
    """
    sign = det3_sign(end, a, b, start)
    return sign if sign != 0 else cross_sign(end, start, b, a)


@njit(cache=True)
def plane_side(a, b, c, point):
    """Return on which side (±1) of the triangle's plane a point lies, 1 where its normal points; 0: no area."""
    sign = det3_sign(b, c, point, a)
    return sign if sign != 0 else cross_sign(b, a, c, a)


@njit(cache=True)
def column_side(a, b, point):
    """Return `line_side` of the line through the point along +z."""
    uj, uk, vj, vk = a[0] - point[0], a[1] - point[1], b[0] - point[0], b[1] - point[1]
    left, right = uj * vk, uk * vj
    det = left - right
    bound = DET2_BOUND * (abs(left) + abs(right))
    if det > bound:
        return 1
    if -det > bound:
        return -1
    sign = det2_sign(a, point, b, point, np.int64(0), np.int64(1))  # no literals: each would be compiled anew
    if sign != 0:
        return sign
    if b[1] != a[1]:
        return 1 if b[1] < a[1] else -1
    if b[0] != a[0]:
        return 1 if b[0] > a[0] else -1
    return 0
