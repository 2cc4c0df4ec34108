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

from hhsr.kernels.cell import direction_of
from hhsr.kernels.patch import LENGTH2, START, VECTOR
from hhsr.kernels.unmanaged import inlined, unmanaged


@unmanaged
def _along_edge(c, linear, square, half):
    """Return (least, where) of c + linear·x + square·x² for |x| ≤ half."""
    x = -half if linear > 0.0 else half
    if square > 0.0:
        x = min(max(-0.5 * linear / square, -half), half)
    return c + (linear + square * x) * x, x


@inlined
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


@inlined
def bounding_quadratic(search, radius, face, a, b, half, w, wa, wb, waa, wab, wbb, kink, third):
    """Return (c, ca, cb, aa, ab, bb, slack) of a quadratic of δ: where it is > slack over the square about (a, b), no
    surface over it lies within `radius` of the search's segment. Slack is infinite where W may vanish on the square.

    All in the leaf's frame. (w, wa, …): exact jet there.
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
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, np.inf
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
    slack = 1e-11 * (w + abs(wa) + abs(wb)) * (away2 + radius * radius)
    return (
        w * gap, wa * gap - 2.0 * (va - fa * along), wb * gap - 2.0 * (vb - fb * along),
        gaa * over + 0.5 * k * waa - less, gab * over + 0.5 * k * wab, gbb * over + 0.5 * k * wbb - less, slack,
    )  # fmt: skip


@inlined
def square_is_clear(search, radius, face, a, b, half, w, wa, wb, waa, wab, wbb, kink, third):
    """Return (clear, δa, δb): no surface over the square about (a, b) lies within `radius` of the search's segment.

    All in the leaf's frame. (w, wa, …): exact jet there. δ: where the quadratic is least, a good guess of the nearest
    point. Never clear where W may vanish on the square.
    """
    c, ca, cb, aa, ab, bb, slack = bounding_quadratic(
        search, radius, face, a, b, half, w, wa, wb, waa, wab, wbb, kink, third
    )
    if slack == math.inf:
        return False, 0.0, 0.0
    least, da, db = least_over_square(c, ca, cb, aa, ab, bb, half)
    return least > slack, da, db
