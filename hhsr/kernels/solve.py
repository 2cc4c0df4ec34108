"""One crossing in a piece where a proof says that there is exactly one: its place, by exact values."""

from hhsr.kernels.cell import inverse_radius
from hhsr.kernels.unmanaged import unmanaged


@unmanaged
def solve_in_cell(blob, ints, leaf, face, a0, b0, w0, a1, b1, w1, x0, x1, f0, f1, slope, steep, tolerance):
    """Return the share x in [x0, x1] where w = W: Newton on the proven slope, safeguarded by the bracket.

    f0, f1: w − W (exact, or its linear model) at x0 and x1, of opposite sign. slope, steep: least and greatest
    |d(w − W)/dx|, proven: a step by their mean from an exact value leaves no more than their spread can.
    """
    mean, spread = 0.5 * (slope + steep), 0.5 * (steep - slope)
    lo, hi, f_lo, f_hi = x0, x1, f0, f1
    x = lo + (hi - lo) * f_lo / (f_lo - f_hi)
    for _ in range(60):
        x = min(max(x, lo), hi)
        f = w0 + x * (w1 - w0) - inverse_radius(blob, ints, leaf, face, a0 + x * (a1 - a0), b0 + x * (b1 - b0))
        if abs(f) <= slope * tolerance:
            return x
        if abs(f) * spread <= tolerance * mean * slope:
            return min(max(x + (abs(f) if (f > 0.0) == (f_lo > 0.0) else -abs(f)) / mean, lo), hi)
        if (f > 0.0) == (f_lo > 0.0):
            lo, f_lo = x, f
            f_hi = 0.5 * f_hi if _ > 2 else f_hi
        else:
            hi, f_hi = x, f
            f_lo = 0.5 * f_lo if _ > 2 else f_lo
        if hi - lo <= tolerance:
            return 0.5 * (lo + hi)
        x = lo + (hi - lo) * f_lo / (f_lo - f_hi)
        if _ > 12:
            x = 0.5 * (lo + hi)
    return 0.5 * (lo + hi)


@unmanaged
def share_to_t(x, t0, t1, w0, w1):
    """Return t of the point at share x of a piece in the chart: t is linear in space, x in the projection."""
    p, q = (1.0 - x) * w0, x * w1
    return (t0 * p + t1 * q) / (p + q)
