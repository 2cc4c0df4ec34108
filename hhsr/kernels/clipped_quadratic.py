"""A square of a leaf's directions that cuts part, against a point or a segment: the quadratic over the region's part.

A cut n·p ≤ c is n·dir ≤ c·W in the chart: a line there, but for c times what W strays from its tangent. Where lines do
not decide, a multiple of n·dir − c·W is added, which is not above 0 in the region: with the right one the least value
is that of the region's part.
"""

import math

import numpy as np

from hhsr.kernels.cell import direction_of, minor_parts
from hhsr.kernels.polygon import clip_in_chart
from hhsr.kernels.quadratic import bounding_quadratic, least_over_square
from hhsr.kernels.unmanaged import inlined, unmanaged

ROUNDING = 1e-6  # what the table's float32 leave of a cut's place, relative


@inlined
def least_over_polygon(c, ca, cb, aa, ab, bb, corners, size):
    """Return (least, a, b) of c + ca·a + cb·b + aa·a² + 2·ab·a·b + bb·b² over a convex polygon. corners: (size, 3)."""
    det = aa * bb - ab * ab
    if det > 0.0 and aa > 0.0:
        a, b = 0.5 * (ab * cb - bb * ca) / det, 0.5 * (ab * ca - aa * cb) / det
        left = right = False
        for i in range(size):
            j = i + 1 if i + 1 < size else 0
            turn = (corners[j, 0] - corners[i, 0]) * (b - corners[i, 1])
            turn -= (corners[j, 1] - corners[i, 1]) * (a - corners[i, 0])
            left, right = left or turn > 0.0, right or turn < 0.0
        if not (left and right):
            return c + 0.5 * (ca * a + cb * b), a, b
    least, where_a, where_b = np.inf, 0.0, 0.0
    for i in range(size):
        j = i + 1 if i + 1 < size else 0
        a, b = corners[i, 0], corners[i, 1]
        ua, ub = corners[j, 0] - a, corners[j, 1] - b
        base = c + ca * a + cb * b + aa * a * a + 2.0 * ab * a * b + bb * b * b
        linear = ca * ua + cb * ub + 2.0 * (aa * a * ua + ab * (a * ub + b * ua) + bb * b * ub)
        square = aa * ua * ua + 2.0 * ab * ua * ub + bb * ub * ub
        if square > 0.0:
            x = min(max(-0.5 * linear / square, 0.0), 1.0)
        elif linear + square < 0.0:
            x = 1.0
        else:
            x = 0.0
        value = base + (linear + square * x) * x
        if value < least:
            least, where_a, where_b = value, a + x * ua, b + x * ub
    return least, where_a, where_b


@inlined
def _square(half, corners):
    """Write the corners of a square about 0; return how many they are."""
    for corner in range(4):
        corners[corner, 0] = half if corner == 1 or corner == 2 else -half
        corners[corner, 1] = half if corner >= 2 else -half
    return 4


@inlined
def clipped_is_clear(
    blob, planes, count, search, radius, face, a, b, half, w, wa, wb, waa, wab, wbb, kink, third, error, corners, spare
):  # fmt: skip
    """Return (clear, δa, δb) as `square_is_clear` does, of the surface over the square that lies in a region.

    planes, count: of the region, n·p ≤ c from a float slot on, leaf's frame. error: how far W may lie from its
    quadratic but for kink and third; by what that moves the surface the radius is greater.
    corners, spare: (ROOM, 3) scratch.
    """
    c, ca, cb, aa, ab, bb, slack = bounding_quadratic(
        search, radius, face, a, b, half, w, wa, wb, waa, wab, wbb, kink, third
    )
    if slack == np.inf:
        return False, 0.0, 0.0
    size = np.int64(0)  # corners of what is left; 0: the square as it is
    x, y, z = direction_of(face, a, b)
    bend = 0.5 * abs(waa + wbb) + math.sqrt(0.25 * (waa - wbb) ** 2 + wab * wab)
    rest = kink + third * half * math.sqrt(2.0) / 3.0
    strays = (bend + rest) * half * half
    for k in range(count):
        o = planes + 4 * k
        nx, ny, nz, place = blob[o], blob[o + 1], blob[o + 2], blob[o + 3]
        along = nx * x + ny * y + nz * z
        na, nb = minor_parts(face, nx, ny, nz)
        room = abs(place) * (strays + error) + ROUNDING * (abs(along) + abs(place) * w) - (along - place * w)
        na, nb = na - place * wa, nb - place * wb
        reach = (abs(na) + abs(nb)) * half
        if reach <= room:
            continue
        if size == 0:
            size = _square(half, corners)
        size = clip_in_chart(corners, size, spare, na, nb, room)
        if size == 0:
            return True, 0.0, 0.0
    if size == 0:
        least, da, db = least_over_square(c, ca, cb, aa, ab, bb, half)
    else:
        least, da, db = least_over_polygon(c, ca, cb, aa, ab, bb, corners, size)
    if least > slack:
        return True, da, db
    clear = _clear_beyond_cuts(
        blob, planes, count, face, x, y, z, half, w, wa, wb, waa, wab, wbb, rest, error, c, ca, cb, aa, ab, bb, slack,
        da, db,
    )  # fmt: skip
    return clear, da, db


@unmanaged
def _clear_beyond_cuts(
    blob, planes, count, face, x, y, z, half, w, wa, wb, waa, wab, wbb, rest, error, c, ca, cb, aa, ab, bb, slack, da,
    db,
):  # fmt: skip
    """Return whether a multiple of a cut's own quadratic, not above 0 in the region, lifts the other above the slack.

    Unlike a line in the chart it has W's bend. δ: where the quadratic is least by lines; there the multiple balances
    both. rest: W strays from its quadratic by no more than rest/2·|δ|² and the error.
    """
    fa, fb = ca + 2.0 * (aa * da + ab * db), cb + 2.0 * (ab * da + bb * db)
    edge = half * (1.0 - 1e-9)
    for k in range(count):
        o = planes + 4 * k
        nx, ny, nz, place = blob[o], blob[o + 1], blob[o + 2], blob[o + 3]
        along = nx * x + ny * y + nz * z
        na, nb = minor_parts(face, nx, ny, nz)
        na, nb = na - place * wa, nb - place * wb
        ga, gb = na - place * (waa * da + wab * db), nb - place * (wab * da + wbb * db)
        if abs(da) > edge:
            ga = 0.0
        if abs(db) > edge:
            gb = 0.0
        steep = ga * ga + gb * gb
        times = -(fa * ga + fb * gb) / steep if steep > 0.0 else 0.0
        if times <= 0.0:
            continue
        bent = 0.5 * times * place
        more = 0.5 * times * abs(place) * rest
        room = abs(place) * error + ROUNDING * (abs(along) + abs(place) * w)
        least, _, _ = least_over_square(
            c + times * (along - place * w - room), ca + times * na, cb + times * nb, aa - bent * waa - more,
            ab - bent * wab, bb - bent * wbb - more, half,
        )  # fmt: skip
        if least > slack:
            return True
    return False
