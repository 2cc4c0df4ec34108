"""Intervals as pairs of floats: the few operations that the proven bounds need.

Rounding: every bound that leaves this floor is widened by `SLACK` relative to its magnitude, which is more than a
thousand times what the handful of float64 operations before it can lose.
"""

from hhsr.kernels.unmanaged import unmanaged

SLACK = 1e-11


@unmanaged
def product(lo, hi, other_lo, other_hi):
    """Return the interval of x·y."""
    a = lo * other_lo
    b = lo * other_hi
    c = hi * other_lo
    d = hi * other_hi
    return min(min(a, b), min(c, d)), max(max(a, b), max(c, d))


@unmanaged
def signed(lo, hi, sign):
    """Return the interval of sign·x, sign ±1."""
    if sign >= 0.0:
        return lo, hi
    return -hi, -lo


@unmanaged
def widened(lo, hi):
    """Return the interval rounded outward."""
    slack = SLACK * max(abs(lo), abs(hi))
    return lo - slack, hi + slack
