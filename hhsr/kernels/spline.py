"""Cubic splines on equal knots: the exponent functions ε1(φ), ε2(θ) of an extended superquadric (DESIGN §1)."""

import math

import numpy as np
from numba import njit

HALF_RANGE = 0.9


def periodic_coefficients(values):
    """Return (n, 4) power-basis coefficients, per segment in x ∈ [0, 1], of the periodic spline through (n,) values."""
    n = len(values)
    if n <= 1:
        return np.array([[v, 0.0, 0.0, 0.0] for v in values]).reshape(n, 4)
    if n == 2:
        raise ValueError("a periodic spline needs 0, 1 or at least 3 knots, got 2")
    matrix = 4.0 * np.eye(n)
    matrix[np.arange(n), (np.arange(n) + 1) % n] += 1.0
    matrix[np.arange(n), (np.arange(n) - 1) % n] += 1.0
    v = np.asarray(values, dtype=np.float64)
    slopes = np.linalg.solve(matrix, 3.0 * (np.roll(v, -1) - np.roll(v, 1)))
    return _hermite(v, np.roll(v, -1), slopes, np.roll(slopes, -1))


def clamped_coefficients(values):
    """Return (m − 1, 4) coefficients of the spline through (m,) values, flat at both ends; (1, 4) for one."""
    m = len(values)
    if m <= 1:
        return np.array([[v, 0.0, 0.0, 0.0] for v in values]).reshape(m, 4)
    v = np.asarray(values, dtype=np.float64)
    slopes = np.zeros(m)
    if m > 2:
        matrix = 4.0 * np.eye(m - 2) + np.eye(m - 2, k=1) + np.eye(m - 2, k=-1)
        slopes[1:-1] = np.linalg.solve(matrix, 3.0 * (v[2:] - v[:-2]))
    return _hermite(v[:-1], v[1:], slopes[:-1], slopes[1:])


def _hermite(v0, v1, s0, s1):
    return np.ascontiguousarray(np.stack([v0, s0, 3.0 * (v1 - v0) - 2.0 * s0 - s1, 2.0 * (v0 - v1) + s0 + s1], axis=1))


@njit(cache=True, inline="never")
def exponent_and_slope(coefficients, share):
    """Return (ε, dε/dshare) at share ∈ [0, 1] of the knots' range; (1, 0) where there are no knots.

    ε = 1 + 0.9·tanh(S(share)/2) = 0.1 + 1.8/(1 + e^−S): in [0.1, 1.9] without a clip, which would break the Jacobian.
    """
    n = coefficients.shape[0]
    if n == 0:
        return 1.0, 0.0
    position = share * n
    segment = min(max(int(position), 0), n - 1)
    x = position - segment
    c0, c1, c2, c3 = (
        coefficients[segment, 0],
        coefficients[segment, 1],
        coefficients[segment, 2],
        coefficients[segment, 3],
    )
    value = c0 + x * (c1 + x * (c2 + x * c3))
    slope = (c1 + x * (2.0 * c2 + 3.0 * x * c3)) * n
    squash = math.tanh(0.5 * value)
    return 1.0 + HALF_RANGE * squash, 0.5 * HALF_RANGE * (1.0 - squash * squash) * slope
