"""A cell's surface against a point or a segment, by the exact jet of second order at its middle.

One quadratic settles most cells.

At δ from x₀ = dir₀/W₀ in the chart W = T + E, T linear, |E − ½ δᵀB₀δ| ≤ ½ (kink + third·r/3) |δ|² for |δ| ≤ r. With s
the surface point, v = q − x₀, A = |v|, U δ = e_a δa + e_b δb − dir₀ (∂W·δ)/W₀ and k = A² − R² + 2 v·dir₀/W₀:

    W (|s − q|² − R²) = (W₀ + ∂W·δ)(A² − R²) − 2 v·Uδ + k E + |U δ − (E/W₀) dir₀|²/W

exactly; what is not quadratic in δ is taken at its worst. For a segment the same holds of all vectors' parts across it:
that is its line's distance, which is the segment's where no end is nearer.
"""

import math

import numpy as np

from hhsr.kernels.cell import direction_of, inverse_radius
from hhsr.kernels.jet import inverse_radius_bend
from hhsr.kernels.layout import BEND_AA, BEND_AB, BEND_BB, KINK, SLOPE_A, SLOPE_B, THIRD, VALUE
from hhsr.kernels.maps import outside_region
from hhsr.kernels.patch import BEST, FINEST, LENGTH2, NODE_ROOM, START, TOLERANCE, VECTOR, distance_to, offer
from hhsr.kernels.unmanaged import unmanaged

WIDEST = 1e60  # mm: no surface lies beyond, and its fourth power is still a number


@unmanaged
def _along_edge(c, linear, square, half):
    """Return (least, where) of c + linear·x + square·x² for |x| ≤ half."""
    x = -half if linear > 0.0 else half
    if square > 0.0:
        x = min(max(-0.5 * linear / square, -half), half)
    return c + (linear + square * x) * x, x


@unmanaged
def least_over_square(c, ca, cb, aa, ab, bb, half):
    """Return (least, a, b) of c + ca·a + cb·b + aa·a² + 2·ab·a·b + bb·b² over |a|, |b| ≤ half."""
    det = aa * bb - ab * ab
    if det > 0.0 and aa > 0.0:
        a, b = 0.5 * (ab * cb - bb * ca) / det, 0.5 * (ab * ca - aa * cb) / det
        if abs(a) <= half and abs(b) <= half:
            return c + 0.5 * (ca * a + cb * b), a, b
    least, where_a, where_b = np.inf, 0.0, 0.0
    for end in range(4):
        x = half if end % 2 == 0 else -half
        if end < 2:
            value, y = _along_edge(c + (ca + aa * x) * x, cb + 2.0 * ab * x, bb, half)
            if value < least:
                least, where_a, where_b = value, x, y
        else:
            value, y = _along_edge(c + (cb + bb * x) * x, ca + 2.0 * ab * x, aa, half)
            if value < least:
                least, where_a, where_b = value, y, x
    return least, where_a, where_b


@unmanaged
def square_is_clear(search, radius, face, a, b, half, w, wa, wb, waa, wab, wbb, kink, third):
    """Return (clear, δa, δb): no surface over the square about (a, b) lies within `radius` of the search's segment.

    All in the leaf's frame. (w, wa, …): exact jet there. δ: where the quadratic is least, a good guess of the nearest
    point. Never clear where W may vanish on the square.
    """
    x, y, z = direction_of(face, a, b)
    ell = math.sqrt(x * x + y * y + z * z)
    fa, fb = wa / w, wb / w
    gaa = 1.0 - 2.0 * fa * a + fa * fa * ell * ell
    gbb = 1.0 - 2.0 * fb * b + fb * fb * ell * ell
    gab = fa * fb * ell * ell - fa * b - fb * a
    longest = math.sqrt(0.5 * (gaa + gbb) + math.sqrt(0.25 * (gaa - gbb) ** 2 + gab * gab))
    bend = 0.5 * abs(waa + wbb) + math.sqrt(0.25 * (waa - wbb) ** 2 + wab * wab)
    r = half * math.sqrt(2.0)
    rest = kink + third * r / 3.0
    change = (math.sqrt(wa * wa + wb * wb) + 0.5 * (bend + rest) * r) * r
    if not change < 0.5 * w:
        return False, 0.0, 0.0
    vx, vy, vz = search[START] - x / w, search[START + 1] - y / w, search[START + 2] - z / w
    if search[LENGTH2] > 0.0:
        dx, dy, dz = search[VECTOR], search[VECTOR + 1], search[VECTOR + 2]
        over = 1.0 / math.sqrt(search[LENGTH2])
        nx, ny, nz = dx * over, dy * over, dz * over
        ahead = -(vx * nx + vy * ny + vz * nz)
        size = (longest * r + 0.5 * (bend + rest) * r * r * ell / w) / (w - change)
        if ahead - size > search[LENGTH2] * over:
            vx, vy, vz = vx + dx, vy + dy, vz + dz  # the end is nearer than the line between
        elif ahead + size > 0.0:
            vx, vy, vz = vx + ahead * nx, vy + ahead * ny, vz + ahead * nz
            if face < 2:
                na, nb = ny, nz
            elif face < 4:
                na, nb = nz, nx
            else:
                na, nb = nx, ny
            cross = nx * x + ny * y + nz * z
            na, nb = na - fa * cross, nb - fb * cross
            gaa, gab, gbb = gaa - na * na, gab - na * nb, gbb - nb * nb
    away2 = vx * vx + vy * vy + vz * vz
    if face < 2:
        va, vb = vy, vz
    elif face < 4:
        va, vb = vz, vx
    else:
        va, vb = vx, vy
    along = vx * x + vy * y + vz * z
    over = 1.0 / (w + change)
    gap = away2 - radius * radius
    k = gap + 2.0 * along / w
    less = 0.5 * abs(k) * rest + longest * ell * (bend + rest) * r / (w * (w - change))
    least, da, db = least_over_square(
        w * gap, wa * gap - 2.0 * (va - fa * along), wb * gap - 2.0 * (vb - fb * along),
        gaa * over + 0.5 * k * waa - less, gab * over + 0.5 * k * wab, gbb * over + 0.5 * k * wbb - less, half,
    )  # fmt: skip
    slack = 1e-11 * (w + abs(wa) + abs(wb)) * (away2 + radius * radius)
    return least > slack, da, db


@unmanaged
def _improves(blob, ints, leaf, planes, count, search, face, a, b):
    """Offer the surface point over (a, b), if it lies in the region; return whether it is the best one now."""
    x, y, z = direction_of(face, a, b)
    m = 1.0 / inverse_radius(blob, ints, leaf, face, a, b)
    x, y, z = x * m, y * m, z * m
    distance, t = distance_to(search, x, y, z)
    if not distance < search[BEST] or outside_region(blob, planes, count, x, y, z, 1e-9):
        return False
    offer(search, distance, t, x, y, z)
    return True


@unmanaged
def settle_cell(blob, ints, tab, leaf, planes, count, search, face, o, a, b, half, rects):
    """Settle a cell (leaf's frame): offer its nearest point, or prove that it holds none; return whether it could.

    o: the cell's float32 slot. count: planes of the region that may touch the cell: such a one is not parted, for
    beyond a cut no nearness is excluded. rects: (NODE_ROOM, 6) scratch.

    Its own quadratic is in the table. W₀ and ∂W are right to 2e-7·W there: they are those of a surface that lies along
    each ray within 1e-6·|x| of the true one.
    """
    aa, ab, bb = np.float64(tab[o + BEND_AA]), np.float64(tab[o + BEND_AB]), np.float64(tab[o + BEND_BB])
    kink, third = np.float64(tab[o + KINK]), np.float64(tab[o + THIRD])
    if math.isnan(aa) or not third < math.inf:
        return False
    w = np.float64(tab[o + VALUE]) - 0.25 * half * half * (aa + bb)
    stray = 1e-6 * math.sqrt(1.0 + a * a + b * b) / w
    for turn in range(2):
        radius = min(search[BEST] - search[TOLERANCE], WIDEST)
        if radius <= 0.0:
            return True
        clear, da, db = square_is_clear(
            search, radius + stray, face, a, b, half, w, np.float64(tab[o + SLOPE_A]), np.float64(tab[o + SLOPE_B]),
            aa, ab, bb, kink, third,
        )  # fmt: skip
        if clear:
            return True
        if turn == 1 or not _improves(blob, ints, leaf, planes, count, search, face, a + da, b + db):
            break
    if count > 0:
        return False
    # From here on the bounds are asked between any two points of the cell, not from its middle: twice as much.
    return settle_parts(blob, ints, leaf, planes, count, search, face, a, b, half, 2.0 * kink, 2.0 * third, rects)


@unmanaged
def settle_parts(blob, ints, leaf, planes, count, search, face, a, b, half, kink, third, rects):
    """Do as `settle_cell` by jets at the middles of the cell's quarters, and of theirs.

    kink, third: ∂²W at two points of the cell differs by no more than kink + third times their distance.
    """
    depth = _part(rects, 0, a, b, half)
    while depth > 0:
        depth -= 1
        a, b, half = rects[depth, 0], rects[depth, 1], rects[depth, 2]
        w, wa, wb, waa, wab, wbb = inverse_radius_bend(blob, ints, leaf, face, a, b)
        if w == 0.0:
            return False
        clear = False
        for turn in range(2):
            radius = min(search[BEST] - search[TOLERANCE], WIDEST)
            if radius <= 0.0:
                return True
            clear, da, db = square_is_clear(search, radius, face, a, b, half, w, wa, wb, waa, wab, wbb, kink, third)
            if clear or turn == 1 or not _improves(blob, ints, leaf, planes, count, search, face, a + da, b + db):
                break
        if clear or half / w < FINEST:
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
