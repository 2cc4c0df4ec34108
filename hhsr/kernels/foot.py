"""The foot of a point on one smooth leaf: Newton's steps on exact jets, and the proof that nothing lies nearer.

At a point of contact x the surface rises towards the point by no more than κ/2 times the squared distance from x, where
κ bounds the second derivatives of F = m·W over its gradient at x: so the ball of radius 1/κ that touches x from the
point's side is free of surface, and with it every smaller ball inside it.
"""

import math

import numpy as np

from hhsr.kernels.box_state import directions_of
from hhsr.kernels.cell import axis_scale, chart_of, direction_of, face_of
from hhsr.kernels.jet import inverse_radius_bend, inverse_radius_jet
from hhsr.kernels.layout import (
    CELLS,
    HALF_AXES,
    MODEL,
    OWNER_INT_SIZE,
    OWNER_INTS,
    OWNER_KIND,
    OWNER_PLANE_FLOATS,
    OWNER_PLANES,
    OWNER_RECORD,
    SLOPE_A,
    SLOPE_B,
    VALUE,
)
from hhsr.kernels.maps import bend_over, cell_at, index_of, plane_of, rests_over
from hhsr.kernels.patch import FOOT, LENGTH2, SIDE, START
from hhsr.kernels.quadratic import square_is_clear
from hhsr.kernels.unmanaged import unmanaged

STEPS = 5
CLOSE = 1.0  # tolerances: a foot this near to where the next step would go is one
WIDEST = 6  # base cells a side that a ball may cover
NEARBY = 0.1  # of the depth below its face: farther from a point a surface's own bends make many feet of one
FARTHEST = 0.12  # of the depth below its face: no foot is proven that is farther along an axis
UNPROVEN, FREE, PROVEN = 0, 1, 2


@unmanaged
def _bend(tab, ints, leaf, face, a_lo, a_hi, b_lo, b_hi, least_m, way):
    """Return a bound of how F bends over directions of a face from least_m on: infinite where they are too many.

    way: −1 where F must not bend down, 1 where not up.
    """
    n = ints[leaf + CELLS]
    i0, i1, j0, j1 = index_of(a_lo, n), index_of(a_hi, n), index_of(b_lo, n), index_of(b_hi, n)
    if i1 - i0 >= WIDEST or j1 - j0 >= WIDEST:
        return np.inf
    bend_lo, bend_hi = bend_over(tab, ints, leaf, face, i0, i1, j0, j1)
    far_a, far_b = max(abs(a_lo), abs(a_hi)), max(abs(b_lo), abs(b_hi))
    # The second derivative of F along v is that of W along v − (a, b)·v_m, over m.
    return max(-bend_lo if way < 0 else bend_hi, 0.0) * (1.0 + far_a * far_a + far_b * far_b) / least_m * (1.0 + 1e-9)


@unmanaged
def _bend_beyond(tab, ints, leaf, radius, way, q, e):
    """Return `_bend` of a ball that lies on several faces. q: (3,) its centre; e: (3,) scratch."""
    e[0] = e[1] = e[2] = radius * (1.0 + 1e-9)
    most = 0.0
    for face in range(6):
        m_lo, m_hi, a_lo, a_hi, b_lo, b_hi = directions_of(face, q, e)
        if m_hi > 0.0:
            most = max(most, _bend(tab, ints, leaf, face, a_lo, a_hi, b_lo, b_hi, m_lo, way))
    return most


@unmanaged
def jump_over(blob, ints, leaf, face, a, b, half, w):
    """Return a bound of how far ∂²W jumps where the half axes change sides within a square about (a, b).

    w: W there, of which it may be half as much again over the square.
    """
    h = ints[leaf + HALF_AXES]
    axis = face // 2
    most = 0.0
    for k in range(2):
        if abs(a if k == 0 else b) <= half:
            minor = 2 * ((axis + 1 + k) % 3)
            most += abs(axis_scale(blob, h, minor, 1.0) - axis_scale(blob, h, minor, -1.0))
    # ∂²N jumps by that over N; W = N·D, and N² is no less than the major axis' part of it.
    return 1.5 * w * most / axis_scale(blob, h, 2 * axis, 1.0 if face % 2 == 0 else -1.0)


@unmanaged
def square_is_free(blob, ints, tab, leaf, local, radius, face, a, b, half):
    """Return whether no surface over the square about (a, b) lies nearer to the search's segment: by the jet there."""
    if max(abs(a), abs(b)) + half > 1.0:
        return False
    kink, third = rests_over(tab, ints, leaf, face, a - half, a + half, b - half, b + half)
    if not third < np.inf:
        return False
    w, wa, wb, waa, wab, wbb = inverse_radius_bend(blob, ints, leaf, face, a, b)
    if w == 0.0:
        return False
    kink += jump_over(blob, ints, leaf, face, a, b, half, w)
    clear, _, _ = square_is_clear(local, radius, face, a, b, half, w, wa, wb, waa, wab, wbb, kink, third)
    return clear


@unmanaged
def _step(px, py, pz, face, a, b, w, ga, gb):
    """Return (a, b, m) of the foot of a point on a plane of W, the next contact; m ≤ 0 where there is none."""
    gx, gy, gz = plane_of(face, a, b, w, ga, gb)
    h = (gx * px + gy * py + gz * pz - 1.0) / (gx * gx + gy * gy + gz * gz)
    return chart_of(face, px - h * gx, py - h * gy, pz - h * gz)


@unmanaged
def _descend(blob, ints, tab, leaf, face, a, b, depth, px, py, pz, tolerance):
    """Return (found, a, b, w, wa, wb) of the foot of a point on a leaf's surface, with the jet there; all on one face.

    (a, b), depth: the point's own chart. Found: as nearly as the tolerance asks, and where a proof is likely at all.
    """
    c, ca, cb, _ = cell_at(ints, leaf, face, a, b)
    # The first step is the table's.
    w, wa, wb = np.float64(tab[c + VALUE]), np.float64(tab[c + SLOPE_A]), np.float64(tab[c + SLOPE_B])
    ca, cb, m = _step(px, py, pz, face, ca, cb, w, wa, wb)
    last = max(abs(ca - a), abs(cb - b))
    if not m > 0.0 or abs(ca) > 1.0 or abs(cb) > 1.0 or max(abs(m - depth), m * last) > FARTHEST * depth:
        return False, ca, cb, w, wa, wb
    for _ in range(STEPS):
        w, wa, wb = inverse_radius_jet(blob, ints, leaf, face, ca, cb)
        if w == 0.0:
            return False, ca, cb, w, wa, wb
        na, nb, m = _step(px, py, pz, face, ca, cb, w, wa, wb)
        move = max(abs(na - ca), abs(nb - cb))
        if not m > 0.0 or abs(na) > 1.0 or abs(nb) > 1.0 or move > 0.7 * last:
            return True, ca, cb, w, wa, wb
        if move < CLOSE * tolerance * w:
            return True, ca, cb, w, wa, wb
        last = move
        ca, cb = na, nb
    w, wa, wb = inverse_radius_jet(blob, ints, leaf, face, ca, cb)
    return w > 0.0, ca, cb, w, wa, wb


@unmanaged
def _ball_is_free(blob, ints, tab, leaf, local, spare, radius, reach, away2, face, a, b, m, ca, cb, w, wa, wb):
    """Return whether no surface of a leaf lies nearer than `radius` to a point; its frame, the point: local's START.

    (a, b, m): the point's chart. (ca, cb), w, wa, wb: its foot, squared distance away2, and the jet there. reach: no
    less than radius and the distance of the foot.
    """
    if m <= 2.0 * reach:
        return False
    gx, gy, gz = plane_of(face, ca, cb, w, wa, wb)
    g = math.sqrt(gx * gx + gy * gy + gz * gz)
    height = (gx * local[START] + gy * local[START + 1] + gz * local[START + 2] - 1.0) / g
    way = -1 if height > 0.0 else 1
    # Directions of the ball: |a′ − a| ≤ R √(1 + a²)/(m − R).
    turn = reach / (m - reach) * (1.0 + 1e-9)
    turn_a, turn_b = turn * math.sqrt(1.0 + a * a), turn * math.sqrt(1.0 + b * b)
    if abs(a) + turn_a > 1.0 or abs(b) + turn_b > 1.0:
        bend = _bend_beyond(tab, ints, leaf, reach, way, local, spare[0])
    else:
        bend = _bend(tab, ints, leaf, face, a - turn_a, a + turn_a, b - turn_b, b + turn_b, m - reach, way)
    if bend == np.inf:
        return False
    kappa = bend / g
    if kappa * radius < 1.0 and kappa * (away2 - radius * radius) <= 2.0 * (abs(height) - radius):
        local[SIDE] = 1.0 if height > 0.0 else -1.0  # of the ball that touches the surface, and the point is in it
        return True
    local[LENGTH2] = 0.0
    half = max(turn_a + abs(ca - a), turn_b + abs(cb - b))
    return square_is_free(blob, ints, tab, leaf, local, radius, face, ca, cb, half)


@unmanaged
def foot_in_chart(blob, ints, tab, owner, px, py, pz, tolerance, local, spare):
    """Return (distance, outcome) of a point of the owner's region (leaf's frame) to its own leaf, along the chart.

    FREE: no surface of this leaf lies nearer than the distance less the tolerance; PROVEN: nor any other. Distance is
    infinite where nothing was found in the region; else local's FOOT is the surface point, and SIDE
    is the point's. spare: (ROOM, 3) scratch.
    """
    o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
    leaf = ints[o + OWNER_RECORD]
    if ints[o + OWNER_KIND] != MODEL or (px == 0.0 and py == 0.0 and pz == 0.0):
        return np.inf, UNPROVEN
    face, a, b, m = face_of(px, py, pz)
    found, ca, cb, w, wa, wb = _descend(blob, ints, tab, leaf, face, a, b, m, px, py, pz, tolerance)
    if not found:
        return np.inf, UNPROVEN
    x, y, z = direction_of(face, ca, cb)
    x, y, z = x / w, y / w, z / w
    planes = ints[o + OWNER_PLANE_FLOATS]
    gap = np.inf
    for k in range(ints[o + OWNER_PLANES]):
        q = planes + 4 * k
        gap = min(gap, blob[q + 3] - (blob[q] * px + blob[q + 1] * py + blob[q + 2] * pz))
        if blob[q] * x + blob[q + 1] * y + blob[q + 2] * z > blob[q + 3] + 1e-9:
            return np.inf, UNPROVEN
    local[FOOT], local[FOOT + 1], local[FOOT + 2] = x, y, z
    local[START], local[START + 1], local[START + 2] = px, py, pz
    local[SIDE] = 0.0
    rx, ry, rz = px - x, py - y, pz - z
    away2 = rx * rx + ry * ry + rz * rz
    distance = math.sqrt(away2)
    if gap <= distance and distance > NEARBY * m:
        return distance, UNPROVEN
    if distance > tolerance and not _ball_is_free(
        blob, ints, tab, leaf, local, spare, distance - tolerance, distance, away2, face, a, b, m, ca, cb, w, wa, wb
    ):
        return distance, UNPROVEN
    return distance, (FREE if gap <= distance and distance > tolerance else PROVEN)


@unmanaged
def leaf_is_free(blob, ints, tab, leaf, px, py, pz, radius, tolerance, local, spare):
    """Return whether no surface of a leaf, in its region or beyond, is nearer than `radius` to a point of its frame."""
    if px == 0.0 and py == 0.0 and pz == 0.0:
        return False
    face, a, b, m = face_of(px, py, pz)
    found, ca, cb, w, wa, wb = _descend(blob, ints, tab, leaf, face, a, b, m, px, py, pz, tolerance)
    if not found:
        return False
    x, y, z = direction_of(face, ca, cb)
    rx, ry, rz = px - x / w, py - y / w, pz - z / w
    away2 = rx * rx + ry * ry + rz * rz
    distance = math.sqrt(away2)
    if distance < radius:
        return False
    local[START], local[START + 1], local[START + 2] = px, py, pz
    return _ball_is_free(blob, ints, tab, leaf, local, spare, radius, distance, away2, face, a, b, m, ca, cb, w, wa, wb)
