"""The foot of a point on one smooth leaf: Newton's steps on exact jets, and the proof that nothing lies nearer.

At a point of contact x with the chart's second derivatives bounded by `bend`, the surface rises above the tangent
plane at x by
no more than κ/2 times the squared distance from x: so the ball of radius 1/κ that touches x from the point's side is
free of surface, and with it every smaller ball inside it.
"""

import math

import numpy as np

from hhsr.kernels.cell import chart_of, direction_of, face_of
from hhsr.kernels.jet import has_jets, inverse_radius_jet
from hhsr.kernels.layout import (
    CELLS,
    MODEL,
    OWNER_INT_SIZE,
    OWNER_INTS,
    OWNER_KIND,
    OWNER_PLANE_FLOATS,
    OWNER_PLANES,
    OWNER_RECORD,
)
from hhsr.kernels.maps import bend_over, plane_of
from hhsr.kernels.unmanaged import unmanaged

STEPS = 5
WIDEST = 6  # base cells a side that a ball may cover


@unmanaged
def ball_is_free(px, py, pz, radius, face, a, b, way, w, ga, gb, bend_lo, bend_hi):
    """Return whether no surface over a piece of a face lies nearer to a point than `radius`; all in the leaf's frame.

    (w, ga, gb): exact jet at (a, b); way: the piece lies within that of (a, b), in a and in b. bend_lo, bend_hi: its
    eigenvalues of ∂²W.
    """
    gx, gy, gz = plane_of(face, a, b, w, ga, gb)
    g = math.sqrt(gx * gx + gy * gy + gz * gz)
    height = (gx * px + gy * py + gz * pz - 1.0) / g
    bend = max(-bend_lo, 0.0)
    if height < 0.0:
        height, bend = -height, max(bend_hi, 0.0)
    # Over the piece: m·|W − plane|/|g| is the height, |δ|² ≤ (1 + a² + b²)/m² times the squared distance.
    rise = (abs(ga) + abs(gb) + bend * way) * way
    low, high = w - rise, w + rise
    if not low > 0.25 * w:
        return False
    wide_a, wide_b = abs(a) + way, abs(b) + way
    kappa = bend * (1.0 + wide_a * wide_a + wide_b * wide_b) * high * high / (low * g) * (1.0 + 1e-9)
    x, y, z = direction_of(face, a, b)
    rx, ry, rz = px - x / w, py - y / w, pz - z / w
    away2 = rx * rx + ry * ry + rz * rz
    return kappa * radius < 1.0 and kappa * (away2 - radius * radius) <= 2.0 * (height - radius)


@unmanaged
def step_to_foot(px, py, pz, face, a, b, w, ga, gb):
    """Return (a, b, m) of the foot of a point on a jet's plane, the next contact; m ≤ 0 where there is none."""
    gx, gy, gz = plane_of(face, a, b, w, ga, gb)
    h = (gx * px + gy * py + gz * pz - 1.0) / (gx * gx + gy * gy + gz * gz)
    return chart_of(face, px - h * gx, py - h * gy, pz - h * gz)


@unmanaged
def foot_in_chart(blob, ints, tab, owner, px, py, pz, tolerance, foot):
    """Return (distance, proven) of a point of the owner's region (leaf's frame) to its own leaf along the point's
    chart.

    foot: (3,) filled with the surface point at that distance, leaf frame. Distance is infinite where nothing was found
    in the region. Proven: no surface of the whole solid lies nearer than the distance less the tolerance.
    """
    o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
    leaf = ints[o + OWNER_RECORD]
    if ints[o + OWNER_KIND] != MODEL or not has_jets(ints, leaf) or (px == 0.0 and py == 0.0 and pz == 0.0):
        return np.inf, False
    face, a, b, m = face_of(px, py, pz)
    ca, cb, w, ga, gb, last = a, b, 0.0, 0.0, 0.0, np.inf
    for _ in range(STEPS):
        w, ga, gb = inverse_radius_jet(blob, ints, leaf, face, ca, cb)
        if w == 0.0:
            return np.inf, False
        na, nb, nm = step_to_foot(px, py, pz, face, ca, cb, w, ga, gb)
        move = max(abs(na - ca), abs(nb - cb))
        if not nm > 0.0 or abs(na) > 1.0 or abs(nb) > 1.0 or move > 0.7 * last:
            break
        if move * move < 1e-5 * tolerance * w:
            break
        last = move
        ca, cb = na, nb
    else:
        w, ga, gb = inverse_radius_jet(blob, ints, leaf, face, ca, cb)
        if w == 0.0:
            return np.inf, False
    x, y, z = direction_of(face, ca, cb)
    x, y, z = x / w, y / w, z / w
    foot[0], foot[1], foot[2] = x, y, z
    distance = math.sqrt((px - x) ** 2 + (py - y) ** 2 + (pz - z) ** 2)
    planes = ints[o + OWNER_PLANE_FLOATS]
    gap = np.inf
    for k in range(ints[o + OWNER_PLANES]):
        q = planes + 4 * k
        gap = min(gap, blob[q + 3] - (blob[q] * px + blob[q + 1] * py + blob[q + 2] * pz))
        if blob[q] * x + blob[q + 1] * y + blob[q + 2] * z > blob[q + 3] + 1e-9:
            return np.inf, False
    if gap <= distance or m <= 2.0 * distance:
        return distance, False
    if distance <= tolerance:
        return distance, True
    # Directions of the ball: |a′ − a| ≤ R √(1 + a²)/(m − R).
    reach = distance / (m - distance) * (1.0 + 1e-9)
    reach_a, reach_b = reach * math.sqrt(1.0 + a * a), reach * math.sqrt(1.0 + b * b)
    if abs(a) + reach_a > 1.0 or abs(b) + reach_b > 1.0:
        return distance, False
    n = ints[leaf + CELLS]
    i0, i1 = int((a - reach_a + 1.0) * 0.5 * n), min(int((a + reach_a + 1.0) * 0.5 * n), n - 1)
    j0, j1 = int((b - reach_b + 1.0) * 0.5 * n), min(int((b + reach_b + 1.0) * 0.5 * n), n - 1)
    if i1 - i0 >= WIDEST or j1 - j0 >= WIDEST:
        return distance, False
    bend_lo, bend_hi = bend_over(tab, ints, leaf, face, i0, i1, j0, j1)
    if not (bend_lo > -np.inf and bend_hi < np.inf):
        return distance, False
    way = max(reach_a + abs(ca - a), reach_b + abs(cb - b))
    return distance, ball_is_free(px, py, pz, distance - tolerance, face, ca, cb, way, w, ga, gb, bend_lo, bend_hi)
