"""The extended superquadric as a norm, homogeneous of degree 1: N(p) = |p| / q(p/|p|) (PAPER Eq. 2, DESIGN §1)."""

import math

from numba import njit

from hhsr.kernels.spline import exponent_and_slope


@njit(cache=True)
def p_norm(x, y, exponent):
    """Return (x^(2/ε) + y^(2/ε))^(ε/2) of x, y ≥ 0, divided by the larger first: 2/ε reaches 20."""
    large, small = (x, y) if x >= y else (y, x)
    if small == 0.0:
        return large
    if exponent == 1.0:
        return math.sqrt(x * x + y * y)
    return large * math.exp(0.5 * exponent * math.log1p(math.exp(math.log(small / large) * (2.0 / exponent))))


@njit(cache=True)
def superquadric_norm(x, y, z, half_axes, azimuth, elevation):
    """Return N(x, y, z), the factor by which the superquadric must grow to reach the point; 0 at the centre.

    half_axes: (6,) a₊ a₋ b₊ b₋ c₊ c₋. azimuth, elevation: spline coefficients (n, 4) of the exponents' logits.
    Exponents are taken at the point's true azimuth and elevation, so N(k·p) = k·N(p).
    """
    e1 = e2 = 1.0
    ring = math.sqrt(x * x + y * y)
    if azimuth.shape[0] > 0:
        theta = math.atan2(y, x) if ring > 0.0 else 0.0
        e2 = exponent_and_slope(azimuth, theta / (2.0 * math.pi) + 0.5)[0]
    if elevation.shape[0] > 0 and (ring > 0.0 or z != 0.0):
        e1 = exponent_and_slope(elevation, math.atan2(z, ring) / math.pi + 0.5)[0]
    sx = x / half_axes[0] if x >= 0.0 else -x / half_axes[1]
    sy = y / half_axes[2] if y >= 0.0 else -y / half_axes[3]
    sz = z / half_axes[4] if z >= 0.0 else -z / half_axes[5]
    return p_norm(p_norm(sx, sy, e2), sz, e1)


@njit(cache=True)
def superellipse_norm(x, y, half_axes, angle):
    """Return the 2-D counterpart: the factor by which the superellipse must grow to reach (x, y)."""
    e = 1.0
    if angle.shape[0] > 0 and (x != 0.0 or y != 0.0):
        e = exponent_and_slope(angle, math.atan2(y, x) / (2.0 * math.pi) + 0.5)[0]
    sx = x / half_axes[0] if x >= 0.0 else -x / half_axes[1]
    sy = y / half_axes[2] if y >= 0.0 else -y / half_axes[3]
    return p_norm(sx, sy, e)
