"""Where a straight line crosses one leaf's own function F = N/(1 − s), along a stretch over which its bend is known.

With one exact value and slope at t, and a bound B of the second derivative along the line, a Newton step leaves no
more than B·Δ²/2.
"""

import math

from hhsr.kernels.along import excess_of, ray_along
from hhsr.kernels.cell import block_of, centres_of, face_of, norm_at, scale_in_block
from hhsr.kernels.field_sums import field_along
from hhsr.kernels.layout import HALF_AXES
from hhsr.kernels.leaf import MAX_SCALE
from hhsr.kernels.unmanaged import inlined, unmanaged


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
def excess_along(blob, ints, leaf, x, y, z, dx, dy, dz):
    """Return (F − 1, ∂F/∂d) at a point of the frame of a leaf with an ellipsoid for a base, where nothing is capped."""
    face, a, b, _ = face_of(x, y, z)
    o, n = centres_of(ints, leaf, block_of(face, a, b))
    unit, way = ray_along(x, y, z, dx, dy, dz)
    s, ds = field_along(blob, o, n, unit, way)
    return excess_of(blob, ints[leaf + HALF_AXES], x, y, z, dx, dy, dz, s, ds)


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
