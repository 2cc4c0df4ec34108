"""Intervals as pairs of floats: the few operations that the proven bounds need.

Rounding: every bound that leaves this floor is widened by `SLACK` relative to its magnitude, which is more than a
thousand times what the handful of float64 operations before it can lose.
"""

import math

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


@unmanaged
def plus(p, q):
    """Return the interval of x + y of two intervals (lo, hi)."""
    return p[0] + q[0], p[1] + q[1]


@unmanaged
def times(p, q):
    """Return the interval of x·y of two intervals (lo, hi)."""
    return product(p[0], p[1], q[0], q[1])


@unmanaged
def scaled(p, factor):
    """Return the interval of factor·x."""
    return (p[0] * factor, p[1] * factor) if factor >= 0.0 else (p[1] * factor, p[0] * factor)


@unmanaged
def squared(p):
    """Return the interval of x²."""
    a, b = p[0] * p[0], p[1] * p[1]
    return (0.0 if p[0] <= 0.0 <= p[1] else min(a, b)), max(a, b)


@unmanaged
def inverse(p):
    """Return the interval of 1/x, x > 0; infinite where it begins at 0."""
    return 1.0 / p[1], (1.0 / p[0] if p[0] > 0.0 else math.inf)
