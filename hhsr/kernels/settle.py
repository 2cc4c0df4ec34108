"""A cell of a leaf's surface settled against a search: its nearest point offered, or proven that it holds none.

Most are by the quadratic in the table; others are parted, each part by its exact jet.
"""

import math

import numpy as np

from hhsr.kernels.cell import direction_of, inverse_radius, minor_parts
from hhsr.kernels.clipped_quadratic import clipped_is_clear
from hhsr.kernels.jet import inverse_radius_bend
from hhsr.kernels.layout import KINK, THIRD
from hhsr.kernels.maps import jet_of, outside_region
from hhsr.kernels.patch import BEST, ENOUGH, FINEST, NODE_ROOM, TOLERANCE, distance_to, offer
from hhsr.kernels.quadratic import square_is_clear
from hhsr.kernels.unmanaged import inlined, unmanaged

WIDEST = 1e60  # mm: no surface lies beyond, and its fourth power is still a number
ASIDE = 0.02  # tolerances: how far from a cut a point is offered that would lie beyond it
MOVES = 5


@unmanaged
def improves(blob, ints, leaf, planes, count, search, face, a, b, wa, wb):
    """Offer the surface point over (a, b), moved into the region where W has the slopes (wa, wb); return whether it is
    the best one now.
    """
    for _ in range(MOVES):
        w = inverse_radius(blob, ints, leaf, face, a, b)
        x, y, z = direction_of(face, a, b)
        distance, t = distance_to(search, x / w, y / w, z / w)
        if not distance < search[BEST]:
            return False
        worst, at = 1e-9, -1
        for k in range(count):
            o = planes + 4 * k
            excess = (blob[o] * x + blob[o + 1] * y + blob[o + 2] * z) / w - blob[o + 3]
            if excess > worst:
                worst, at = excess, o
        if at < 0:
            offer(search, distance, t, x / w, y / w, z / w)
            return True
        na, nb = minor_parts(face, blob[at], blob[at + 1], blob[at + 2])
        na, nb = na - blob[at + 3] * wa, nb - blob[at + 3] * wb
        step = (worst + ASIDE * search[TOLERANCE]) * w / (na * na + nb * nb)
        a, b = a - step * na, b - step * nb
        if not max(abs(a), abs(b)) <= 1.0:
            return False
    return False


@unmanaged
def _is_clear(
    blob, planes, count, search, stray, face, a, b, half, w, wa, wb, waa, wab, wbb, kink, third, error, corners, spare
):  # fmt: skip
    """Return (clear, δa, δb) of the part of a square that lies in the region: `square_is_clear`.

    stray (mm), error (of W): how far the surface may lie along a ray from that of the quadratic, kink and third.
    """
    radius = min(search[BEST] - search[TOLERANCE], WIDEST)
    if radius <= 0.0:
        return True, 0.0, 0.0
    if count == 0:
        return square_is_clear(search, radius + stray, face, a, b, half, w, wa, wb, waa, wab, wbb, kink, third)
    return clipped_is_clear(
        blob, planes, count, search, radius + stray, face, a, b, half, w, wa, wb, waa, wab, wbb, kink, third, error,
        corners, spare,
    )  # fmt: skip


@unmanaged
def _table_stray(a, b, half, w, wa, wb, waa, wab, wbb, kink, third):
    """Return (how far (mm) the surface of a cell can lie along a ray from the table's quadratic, how far W from it).

    Infinite where it is not known.
    """
    r = half * math.sqrt(2.0)
    bend = 0.5 * abs(waa + wbb) + math.sqrt(0.25 * (waa - wbb) ** 2 + wab * wab)
    error = (0.5 * kink + third * r / 6.0) * r * r + 1e-6 * w
    low = w - (math.sqrt(wa * wa + wb * wb) + 0.5 * bend * r) * r - error
    if not low > 0.5 * w:
        return math.inf, error
    far_a, far_b = abs(a) + half, abs(b) + half
    return math.sqrt(1.0 + far_a * far_a + far_b * far_b) * error / (low * low) * (1.0 + 1e-9), error


@inlined
def settle_cell(blob, ints, tab, leaf, planes, count, search, face, o, a, b, half, corners, spare, rects):
    """Settle a cell (leaf's frame): offer its nearest point, or prove that it holds none; return whether it could.

    o: the cell's float32 slot. count: planes of the region that may touch the cell. corners, spare: (ROOM, 3), rects:
    (NODE_ROOM, 6), scratch.

    The table's jet is that of a surface that lies along each ray within 1e-6·|x| of the true one.
    """
    w, sa, sb, aa, ab, bb = jet_of(tab, o, half)
    kink, third = np.float64(tab[o + KINK]), np.float64(tab[o + THIRD])
    if math.isnan(w) or not third < math.inf:
        return False
    stray = 1e-6 * math.sqrt(1.0 + a * a + b * b) / w
    for turn in range(2):
        clear, da, db = _is_clear(
            blob, planes, count, search, stray, face, a, b, half, w, sa, sb, aa, ab, bb, kink, third,
            0.0, corners, spare,
        )  # fmt: skip
        if clear:
            return True
        if turn == 1 or not improves(blob, ints, leaf, planes, count, search, face, a + da, b + db, sa, sb):
            break
    if search[BEST] < search[ENOUGH]:
        return True  # the search ends here
    cell_a, cell_b, cell_half, cell_w = a, b, half, w
    aside, error = _table_stray(a, b, half, w, sa, sb, aa, ab, bb, kink, third)
    # From here on the bounds are asked between any two points of the cell, not from its middle: twice as much.
    kink, third = 2.0 * kink, 2.0 * third
    depth = _part(rects, 0, a, b, half)
    while depth > 0:
        depth -= 1
        a, b, half = rects[depth, 0], rects[depth, 1], rects[depth, 2]
        if 4.0 * half > cell_half and aside < search[TOLERANCE]:
            # A quarter, first by the table's quadratic about its own middle: an exact jet costs several times as much.
            da, db = a - cell_a, b - cell_b
            ra, rb = aa * da + ab * db, ab * da + bb * db
            clear, _, _ = _is_clear(
                blob, planes, count, search, aside, face, a, b, half,
                cell_w + (sa + 0.5 * ra) * da + (sb + 0.5 * rb) * db, sa + ra, sb + rb, aa, ab, bb, 0.0, 0.0, error,
                corners, spare,
            )  # fmt: skip
            if clear:
                continue
        w, wa, wb, waa, wab, wbb = inverse_radius_bend(blob, ints, leaf, face, a, b)
        if w == 0.0:
            return False
        clear = False
        for turn in range(2):
            clear, da, db = _is_clear(
                blob, planes, count, search, 0.0, face, a, b, half, w, wa, wb, waa, wab, wbb, kink, third, 0.0,
                corners, spare,
            )  # fmt: skip
            if (
                clear
                or turn == 1
                or not improves(blob, ints, leaf, planes, count, search, face, a + da, b + db, wa, wb)
            ):
                break
        if clear:
            continue
        if search[BEST] < search[ENOUGH]:
            return True
        if half / w < FINEST:
            x, y, z = direction_of(face, a, b)
            if not outside_region(blob, planes, count, x / w, y / w, z / w, FINEST):
                distance, t = distance_to(search, x / w, y / w, z / w)
                offer(search, distance, t, x / w, y / w, z / w)
            continue
        if depth + 4 > NODE_ROOM:
            return False
        depth = _part(rects, depth, a, b, half)
    return True


@unmanaged
def _part(rects, depth, a, b, half):
    """Push the four quarters of a square; return the new depth."""
    half *= 0.5
    for corner in range(4):
        rects[depth, 0] = a + (half if corner & 1 else -half)
        rects[depth, 1] = b + (half if corner & 2 else -half)
        rects[depth, 2] = half
        depth += 1
    return depth
