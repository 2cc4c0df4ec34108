"""The band between two parts: lobes r(α, t) about centres on the cutting plane (DESIGN §2)."""

import math

from hhsr.kernels.leaf import contour_radius
from hhsr.kernels.unmanaged import unmanaged

# Slab record, integers: float slot of the frame (rows e1, e2, n, then offset, half width), number of lobes, integer
# slot of the lobes' records.
SLAB_FRAME, LOBE_COUNT, LOBES = 0, 1, 2
SLAB_INT_SIZE = 3
# Lobe record, integers: float slot of centre 2 and the tables L, R of TABLE + 1 radii (the last repeats the first);
# the contour's half axes 4 (and two ones, for the bounds), spline coefficients, centres (k, 2), weights, inverse
# extent; the strip's enclosures, per table segment a sphere 4, the least and greatest r, a bound of |C''|.
LOBE_TABLES, LOBE_AXES, LOBE_SPLINE, LOBE_SEGMENTS, LOBE_CENTRES, LOBE_COUNT_CENTRES = 0, 1, 2, 3, 4, 5
LOBE_WEIGHTS, LOBE_EXTENT, LOBE_SPHERES = 6, 7, 8
LOBE_INT_SIZE = 9
TABLE, ENCLOSURE = 256, 7


@unmanaged
def lobe_contour(blob, ints, lobe, cosine, sine):
    """Return C(α), the radius of the fitted contour in direction (cos α, sin α)."""
    axes, n, k = ints[lobe + LOBE_AXES], ints[lobe + LOBE_SEGMENTS], ints[lobe + LOBE_COUNT_CENTRES]
    s, c, w = ints[lobe + LOBE_SPLINE], ints[lobe + LOBE_CENTRES], ints[lobe + LOBE_WEIGHTS]
    return contour_radius(
        cosine,
        sine,
        blob[axes : axes + 4],
        blob[s : s + 4 * n].reshape(n, 4),
        blob[c : c + 2 * k].reshape(k, 2),
        blob[ints[lobe + LOBE_EXTENT]],
        blob[w : w + k],
    )


@unmanaged
def lobe_ends(blob, ints, lobe, angle):
    """Return (L, R) at an angle in [−π, π]: linear between the 256 exact section radii."""
    share = (angle / (2.0 * math.pi) + 0.5) * TABLE
    i = min(max(int(share), 0), TABLE - 1)
    x = share - i
    o = ints[lobe + LOBE_TABLES] + 2 + i
    left = blob[o] + x * (blob[o + 1] - blob[o])
    o += TABLE + 1
    return left, blob[o] + x * (blob[o + 1] - blob[o])


@unmanaged
def lobe_radius(blob, ints, lobe, du, dv, t):
    """Return r(α, t) ≥ 0 in the in-plane direction (du, dv), t ∈ [0, 1] from h = −d to h = d."""
    length = math.sqrt(du * du + dv * dv)
    if length == 0.0:
        du, dv, length = -1.0, 0.0, 1.0
    left, right = lobe_ends(blob, ints, lobe, math.atan2(dv, du))
    middle = 2.0 * lobe_contour(blob, ints, lobe, du / length, dv / length) - 0.5 * (left + right)
    u = 1.0 - t
    return max(u * u * left + 2.0 * t * u * middle + t * t * right, 0.0)


@unmanaged
def slab_coordinates(blob, frame, x, y, z):
    """Return (u, v, t) of a point of the tree's frame: in-plane coordinates, and height as t ∈ [0, 1] in the slab."""
    f = frame
    h = blob[f + 6] * x + blob[f + 7] * y + blob[f + 8] * z - blob[f + 9]
    u = blob[f] * x + blob[f + 1] * y + blob[f + 2] * z
    v = blob[f + 3] * x + blob[f + 4] * y + blob[f + 5] * z
    return u, v, min(max(0.5 * (h / blob[f + 10] + 1.0), 0.0), 1.0)


@unmanaged
def slab_contains(blob, ints, slab, x, y, z):
    """Return whether some lobe of the slab holds a point of the tree's frame."""
    return slab_field(blob, ints, slab, x, y, z) <= 0.0


@unmanaged
def slab_field(blob, ints, slab, x, y, z):
    """Return the least (|p∥ − c| − r)/r over the lobes; 1e9 where every r is 0."""
    u, v, t = slab_coordinates(blob, ints[slab + SLAB_FRAME], x, y, z)
    best = 1e9
    for k in range(ints[slab + LOBE_COUNT]):
        lobe = ints[slab + LOBES] + LOBE_INT_SIZE * k
        o = ints[lobe + LOBE_TABLES]
        du, dv = u - blob[o], v - blob[o + 1]
        r = lobe_radius(blob, ints, lobe, du, dv, t)
        if r > 0.0:
            best = min(best, (math.sqrt(du * du + dv * dv) - r) / r)
    return best
