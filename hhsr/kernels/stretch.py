"""Where a straight line crosses one leaf's own function F = N/(1 − s), along a stretch over which its bend is known.

With one exact value and slope at t, and a bound B of the second derivative along the line, a Newton step leaves no
more than B·Δ²/2.
"""

import math

import numpy as np

from hhsr.kernels.along import excess_of, field_along, ray_along
from hhsr.kernels.cell import block_of, chart_of, face_of, norm_at, scale_in_block
from hhsr.kernels.layout import BEND_SIZE, BEND_TABLE, BLOCK_DATA, BLOCK_ROWS, BLOCKS, CELLS, HALF_AXES
from hhsr.kernels.leaf import MAX_SCALE
from hhsr.kernels.maps import index_of
from hhsr.kernels.unmanaged import inlined, unmanaged

MOST_BENDS = 9  # base cells that are worth the look


@inlined
def change(state, new, t, gap, out, count):
    """Record a change of state at t, or drop the last where it is within `gap`: a touch; return (state, count).

    A count above out.size says how much room is needed.
    """
    if state != new:
        if 0 < count <= out.shape[0] and t - out[count - 1] <= gap:
            return new, count - 1
        if count < out.shape[0]:
            out[count] = t
        return new, count + 1
    return state, count


@unmanaged
def excess(blob, ints, leaf, x, y, z):
    """Return F − 1 at a point of the leaf's frame by the exact formula: ≤ 0 inside."""
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return -1.0
    face, a, b, _ = face_of(x, y, z)
    s = scale_in_block(blob, ints, leaf, block_of(face, a, b), x / length, y / length, z / length)
    return norm_at(blob, ints, leaf, x, y, z) / (1.0 - min(s, MAX_SCALE)) - 1.0


@inlined
def centres_of(ints, leaf, block):
    """Return (float slot, count) of the centres of a block of directions."""
    start = ints[leaf + BLOCKS] + block
    return ints[leaf + BLOCK_DATA] + ints[start], (ints[start + 1] - ints[start]) // BLOCK_ROWS


@inlined
def excess_along(blob, ints, leaf, x, y, z, dx, dy, dz):
    """Return (F − 1, ∂F/∂d) at a point of the frame of a leaf with an ellipsoid for a base, where nothing is capped."""
    face, a, b, _ = face_of(x, y, z)
    o, n = centres_of(ints, leaf, block_of(face, a, b))
    unit, way = ray_along(x, y, z, dx, dy, dz)
    s, ds = field_along(blob, o, n, unit, way)
    return excess_of(blob, ints[leaf + HALF_AXES], x, y, z, dx, dy, dz, s, ds)


@inlined
def share_across(x, y, z, dx, dy, dz, reach):
    """Return a bound of what is left of the bend in space along a line by its direction, within `reach` of t here.

    As in `bend_along` d²F/dt² = cᵀ·∂²W·c/m³, and the bend in space is no less than |∂²W|·(p/m)²/m·d² at any point of
    the line: c²/(p²·d²) of it is left. c is p × d but for its part along the axis of the face.
    """
    px, py, pz = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
    length2, way2 = x * x + y * y + z * z, dx * dx + dy * dy + dz * dz
    nearest2 = length2 - 2.0 * reach * abs(x * dx + y * dy + z * dz)
    if nearest2 <= 0.5 * length2:
        return 1.0
    across2 = px * px + py * py + pz * pz
    x, y, z, wx, wy, wz = abs(x), abs(y), abs(z), reach * abs(dx), reach * abs(dy), reach * abs(dz)
    # The face may change along the way: then all of p × d counts.
    if x - wx > max(y + wy, z + wz):
        across2 -= px * px
    elif y - wy > max(x + wx, z + wz):
        across2 -= py * py
    elif z - wz > max(x + wx, y + wy):
        across2 -= pz * pz
    return min(across2 / (nearest2 * way2) * (1.0 + 1e-6) + 1e-12, 1.0)


@unmanaged
def bend_along(ints, tab, leaf, px, py, pz, dx, dy, dz, begin, end):
    """Return a bound of |d²F/dt²| of p + t·d (leaf's frame) for t in [begin, end]; infinite: not known.

    On a face p = m·(1, a, b) and F = m·W(a, b). Along the line (a, b) moves by c/m², with a c that stays, so
    d²F/dt² = cᵀ·∂²W·c/m³. ∂²W is bounded over the base cells between those of the two ends.
    """
    t = 0.5 * (begin + end)
    face, _, _, _ = face_of(px + t * dx, py + t * dy, pz + t * dz)
    a0, b0, m0 = chart_of(face, px + begin * dx, py + begin * dy, pz + begin * dz)
    a1, b1, m1 = chart_of(face, px + end * dx, py + end * dy, pz + end * dz)
    if not (m0 > 0.0 and m1 > 0.0 and max(max(abs(a0), abs(b0)), max(abs(a1), abs(b1))) <= 1.0):
        return math.inf
    n, most = ints[leaf + CELLS], 0.0
    i0, i1 = index_of(min(a0, a1), n), index_of(max(a0, a1), n)
    j0, j1 = index_of(min(b0, b1), n), index_of(max(b0, b1), n)
    if (i1 - i0 + 1) * (j1 - j0 + 1) > MOST_BENDS:
        return math.inf
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            o = ints[leaf + BEND_TABLE] + BEND_SIZE * ((face * n + i) * n + j)
            most = max(most, max(-np.float64(tab[o]), np.float64(tab[o + 1])))
    once = m0 * m1 / (end - begin)
    ca, cb, m = (a1 - a0) * once, (b1 - b0) * once, min(m0, m1)
    return most * (ca * ca + cb * cb) / (m * m * m) * (1.0 + 1e-6)


@inlined
def improve(turn, lo, hi, t, f, slope, rises, least, bend, tolerance):
    """Return (whether t is the place of the crossing, lo, hi, t) after (F − 1, dF/dt) is known at t in [lo, hi].

    F is proven to cross 1 once there, rising or falling; least: a bound of |dF/dt|; bend: of |d²F/dt²|; tolerance: of
    t. turn: how often it was improved before.
    """
    if not rises:
        f, slope = -f, -slope
    steep = max(slope - bend * (hi - lo), least, 1e-30)
    far = abs(f) / steep
    step = f / max(slope, steep)
    if 0.5 * bend * far * far <= tolerance * steep:
        return True, lo, hi, min(max(t - step, lo), hi)
    if f < 0.0:
        lo = t
    else:
        hi = t
    if hi - lo <= tolerance:
        return True, lo, hi, 0.5 * (lo + hi)
    t -= step
    if not lo < t < hi or turn % 3 == 2:
        t = 0.5 * (lo + hi)
    return turn >= 100, lo, hi, t


@unmanaged
def root_by_values(blob, ints, leaf, px, py, pz, dx, dy, dz, lo, hi, t, rises, least, most, tolerance):
    """Return the same where only values may be asked; most: a bound of |dF/dt| too."""
    mean, spread = 0.5 * (least + most), 0.5 * (most - least)
    for turn in range(100):
        f = excess(blob, ints, leaf, px + t * dx, py + t * dy, pz + t * dz)
        if not rises:
            f = -f
        if abs(f) <= least * tolerance:
            return t
        if abs(f) * spread <= tolerance * mean * least:
            return min(max(t - f / mean, lo), hi)
        if f < 0.0:
            lo = t
        else:
            hi = t
        if hi - lo <= tolerance:
            break
        t -= f / mean
        if not lo < t < hi or turn % 3 == 2:
            t = 0.5 * (lo + hi)
    return 0.5 * (lo + hi)
