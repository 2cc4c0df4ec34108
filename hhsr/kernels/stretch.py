"""Where a straight line crosses one leaf's own function F = N/(1 − s), along a stretch over which its bend is known.

With one exact value and slope at t, and a bound B of the second derivative along the line, a Newton step leaves no
more than B·Δ²/2.
"""

import math

from hhsr.kernels.cell import axis_scale, block_of, face_of, norm_at, scale_in_block
from hhsr.kernels.layout import BLOCK_DATA, BLOCK_ROWS, BLOCKS, HALF_AXES
from hhsr.kernels.leaf import MAX_SCALE
from hhsr.kernels.sphere_rbf import gaussian_along
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
    inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
    ux, uy, uz = x * inverse, y * inverse, z * inverse
    face, a, b, _ = face_of(x, y, z)
    start = ints[leaf + BLOCKS] + block_of(face, a, b)
    o = ints[leaf + BLOCK_DATA] + ints[start]
    n = (ints[start + 1] - ints[start]) // BLOCK_ROWS
    radial = dx * ux + dy * uy + dz * uz
    s, ds = gaussian_along(
        blob[o : o + n], blob[o + n : o + 2 * n], blob[o + 2 * n : o + 3 * n], blob[o + 3 * n : o + 4 * n],
        blob[o + 4 * n : o + 5 * n], ux, uy, uz,
        (dx - radial * ux) * inverse, (dy - radial * uy) * inverse, (dz - radial * uz) * inverse,
    )  # fmt: skip
    h = ints[leaf + HALF_AXES]
    cx, cy, cz = axis_scale(blob, h, 0, x), axis_scale(blob, h, 2, y), axis_scale(blob, h, 4, z)
    norm = math.sqrt(cx * x * x + cy * y * y + cz * z * z)
    d = 1.0 / (1.0 - s)
    f = norm * d
    return f - 1.0, ((cx * x * dx + cy * y * dy + cz * z * dz) / norm + f * ds) * d


@unmanaged
def root_in(blob, ints, leaf, px, py, pz, dx, dy, dz, lo, hi, guess, rises, least, most, bend, tolerance):
    """Return t in [lo, hi] where F = 1 on p + t·d (leaf's frame), to the tolerance (of t).

    F is proven to cross 1 once there, rising or falling; least, most: bounds of |dF/dt|; bend: of |d²F/dt²|, infinite
    where only values may be asked.
    """
    smooth = bend < math.inf
    mean, spread = 0.5 * (least + most), 0.5 * (most - least)
    t = guess
    for turn in range(100):
        t = min(max(t, lo), hi)
        x, y, z = px + t * dx, py + t * dy, pz + t * dz
        if smooth:
            f, slope = excess_along(blob, ints, leaf, x, y, z, dx, dy, dz)
            if not rises:
                f, slope = -f, -slope
            steep = max(slope - bend * (hi - lo), least, 1e-30)
            far = abs(f) / steep
            if 0.5 * bend * far * far <= tolerance * steep:
                return min(max(t - f / max(slope, steep), lo), hi)
            step = f / max(slope, steep)
        else:
            f = excess(blob, ints, leaf, x, y, z)
            if not rises:
                f = -f
            if abs(f) <= least * tolerance:
                return t
            if abs(f) * spread <= tolerance * mean * least:
                return min(max(t - f / mean, lo), hi)
            step = f / mean
        if f < 0.0:
            lo = t
        else:
            hi = t
        if hi - lo <= tolerance:
            break
        t -= step
        if not lo < t < hi or turn % 3 == 2:
            t = 0.5 * (lo + hi)
    return 0.5 * (lo + hi)
