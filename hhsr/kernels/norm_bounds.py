"""Proven ranges of the superquadric's norm N and of its gradient over a box of directions (DESIGN §4).

Over a box that straddles no coordinate plane |x|, |y|, |z| are monotone, so every factor below is monotone in the
ratios, azimuth and elevation, and its range is given by the box's ends. With the p-norm's weights in [0, 1] and
∂M/∂ε = M·H(w)/2 (H the entropy of the weights, at most ln 2) nothing blows up at poles and coordinate planes.
"""

import math

from hhsr.kernels.interval import product, signed
from hhsr.kernels.spline import HALF_RANGE
from hhsr.kernels.superquadric import p_norm
from hhsr.kernels.unmanaged import unmanaged

LN2 = math.log(2.0)


@unmanaged
def cubic_range(c0, c1, c2, c3, x0, x1):
    """Return the range of a cubic on [x0, x1]: its ends and its extremes between them."""
    f0 = c0 + x0 * (c1 + x0 * (c2 + x0 * c3))
    f1 = c0 + x1 * (c1 + x1 * (c2 + x1 * c3))
    lo, hi = min(f0, f1), max(f0, f1)
    a, b, c = 3.0 * c3, 2.0 * c2, c1
    root = b * b - 4.0 * a * c
    if root > 0.0:
        q = -0.5 * (b + math.copysign(math.sqrt(root), b))
        for k in range(2):
            if k == 0:
                x = q / a if a != 0.0 else x0
            else:
                x = c / q if q != 0.0 else x0
            if x0 < x < x1:
                f = c0 + x * (c1 + x * (c2 + x * c3))
                lo, hi = min(lo, f), max(hi, f)
    return lo, hi


@unmanaged
def exponent_range(coefficients, share0, share1):
    """Return (ε_lo, ε_hi, slope_lo, slope_hi) over shares [share0, share1] of the knots' range."""
    n = coefficients.shape[0]
    s_lo, s_hi, d_lo, d_hi = 1e300, -1e300, 1e300, -1e300
    first = min(max(int(share0 * n - 1e-9), 0), n - 1)
    last = min(max(int(share1 * n + 1e-9), 0), n - 1)
    for segment in range(first, last + 1):
        x0 = max(share0 * n - segment - 1e-9, -1e-9)
        x1 = min(share1 * n - segment + 1e-9, 1.0 + 1e-9)
        c0, c1 = coefficients[segment, 0], coefficients[segment, 1]
        c2, c3 = coefficients[segment, 2], coefficients[segment, 3]
        lo, hi = cubic_range(c0, c1, c2, c3, x0, x1)
        s_lo, s_hi = min(s_lo, lo), max(s_hi, hi)
        lo, hi = cubic_range(c1, 2.0 * c2, 3.0 * c3, 0.0, x0, x1)
        d_lo, d_hi = min(d_lo, lo), max(d_hi, hi)
    g_lo, g_hi = math.tanh(0.5 * s_lo), math.tanh(0.5 * s_hi)
    k0, k1 = 1.0 - g_lo * g_lo, 1.0 - g_hi * g_hi
    k_hi = 1.0 if s_lo <= 0.0 <= s_hi else max(k0, k1)
    lo, hi = product(d_lo * n, d_hi * n, 0.5 * HALF_RANGE * min(k0, k1), 0.5 * HALF_RANGE * k_hi)
    return 1.0 + HALF_RANGE * g_lo, 1.0 + HALF_RANGE * g_hi, lo, hi


@unmanaged
def _power_range(ratio_lo, ratio_hi, e_lo, e_hi):
    """Return the range of ratio^(2/ε)."""
    if ratio_lo <= 0.0:
        lo = 0.0
    else:
        lo = math.exp(math.log(ratio_lo) * (2.0 / (e_lo if ratio_lo < 1.0 else e_hi)))
    if ratio_hi <= 0.0:
        hi = 0.0
    elif ratio_hi > 1e15:
        hi = 1e300
    else:
        hi = math.exp(math.log(ratio_hi) * (2.0 / (e_hi if ratio_hi < 1.0 else e_lo)))
    return lo, hi


@unmanaged
def _weight_range(s_lo, s_hi, e_lo, e_hi):
    """Return the range of S^−(1 − ε/2): ∂M/∂x of the p-norm, S = 1 + (y/x)^p."""
    return s_hi ** -(1.0 - 0.5 * e_lo), s_lo ** -(1.0 - 0.5 * e_hi)


@unmanaged
def _entropy(w):
    if w <= 0.0 or w >= 1.0:
        return 0.0
    return -w * math.log(w) - (1.0 - w) * math.log(1.0 - w)


@unmanaged
def _entropy_range(w_lo, w_hi):
    """Return the range of the binary entropy, concave with its top at 1/2."""
    h0, h1 = _entropy(w_lo), _entropy(w_hi)
    top = LN2 if w_lo <= 0.5 <= w_hi else max(h0, h1)
    return min(h0, h1), top


@unmanaged
def _ratio(y, x):
    return y / x if x > 0.0 else (1e300 if y > 0.0 else 0.0)


@unmanaged
def norm_range(x0, x1, y0, y1, z0, z1, sx, sy, sz, half_axes, azimuth, elevation):
    """Return the ranges (N, ∂N/∂x, ∂N/∂y, ∂N/∂z) as eight floats over |x| ∈ [x0, x1] …, with signs sx, sy, sz = ±1.

    Outward rounding is left to the caller. At a pole (x0 = y0 = 0) the azimuth is taken as the whole quadrant.
    """
    ax = half_axes[0] if sx > 0.0 else half_axes[1]
    ay = half_axes[2] if sy > 0.0 else half_axes[3]
    az = half_axes[4] if sz > 0.0 else half_axes[5]
    theta0, theta1 = math.atan2(y0, x1), (math.atan2(y1, x0) if y1 > 0.0 or x0 > 0.0 else 0.5 * math.pi)
    e2_lo = e2_hi = 1.0
    d2_lo = d2_hi = 0.0
    has_azimuth = azimuth.shape[0] > 0
    if has_azimuth:
        if sx > 0.0:
            t0, t1 = (theta0, theta1) if sy > 0.0 else (-theta1, -theta0)
        else:
            t0, t1 = (math.pi - theta1, math.pi - theta0) if sy > 0.0 else (theta0 - math.pi, theta1 - math.pi)
        e2_lo, e2_hi, d2_lo, d2_hi = exponent_range(azimuth, t0 / (2.0 * math.pi) + 0.5, t1 / (2.0 * math.pi) + 0.5)
        d2_lo, d2_hi = d2_lo / (2.0 * math.pi), d2_hi / (2.0 * math.pi)
        if x0 == 0.0 and y0 == 0.0:  # the pole itself is evaluated at azimuth 0
            pole = exponent_range(azimuth, 0.5, 0.5)
            e2_lo, e2_hi = min(e2_lo, pole[0]), max(e2_hi, pole[1])
    ring0, ring1 = math.sqrt(x0 * x0 + y0 * y0), math.sqrt(x1 * x1 + y1 * y1)
    phi0, phi1 = math.atan2(z0, ring1), math.atan2(z1, ring0)
    e1_lo = e1_hi = 1.0
    d1_lo = d1_hi = 0.0
    has_elevation = elevation.shape[0] > 0
    if has_elevation:
        p0, p1 = signed(phi0, phi1, sz)
        e1_lo, e1_hi, d1_lo, d1_hi = exponent_range(elevation, p0 / math.pi + 0.5, p1 / math.pi + 0.5)
        d1_lo, d1_hi = d1_lo / math.pi, d1_hi / math.pi
    X0, X1, Y0, Y1, Z0, Z1 = x0 / ax, x1 / ax, y0 / ay, y1 / ay, z0 / az, z1 / az
    m_lo, m_hi = p_norm(X0, Y0, e2_lo), p_norm(X1, Y1, e2_hi)
    n_lo, n_hi = p_norm(m_lo, Z0, e1_lo), p_norm(m_hi, Z1, e1_hi)
    # Weights of the outer norm, S = 1 + (Z/M)^p, and of the inner one.
    r_lo, r_hi = _power_range(_ratio(Z0, m_hi), _ratio(Z1, m_lo), e1_lo, e1_hi)
    wm_lo, wm_hi = _weight_range(1.0 + r_lo, 1.0 + r_hi, e1_lo, e1_hi)
    h1_lo, h1_hi = _entropy_range(1.0 / (1.0 + r_hi), 1.0 / (1.0 + r_lo))
    r_lo, r_hi = _power_range(_ratio(m_lo, Z1), _ratio(m_hi, Z0), e1_lo, e1_hi)
    wz_lo, wz_hi = _weight_range(1.0 + r_lo, 1.0 + r_hi, e1_lo, e1_hi)
    r_lo, r_hi = _power_range(_ratio(Y0, X1), _ratio(Y1, X0), e2_lo, e2_hi)
    wx_lo, wx_hi = _weight_range(1.0 + r_lo, 1.0 + r_hi, e2_lo, e2_hi)
    h2_lo, h2_hi = _entropy_range(1.0 / (1.0 + r_hi), 1.0 / (1.0 + r_lo))
    r_lo, r_hi = _power_range(_ratio(X0, Y1), _ratio(X1, Y0), e2_lo, e2_hi)
    wy_lo, wy_hi = _weight_range(1.0 + r_lo, 1.0 + r_hi, e2_lo, e2_hi)
    gx_lo, gx_hi = signed(wm_lo * wx_lo / ax, wm_hi * wx_hi / ax, sx)
    gy_lo, gy_hi = signed(wm_lo * wy_lo / ay, wm_hi * wy_hi / ay, sy)
    gz_lo, gz_hi = signed(wz_lo / az, wz_hi / az, sz)
    if has_azimuth:
        c0, c1, s0, s1 = math.cos(theta1), math.cos(theta0), math.sin(theta0), math.sin(theta1)
        c0 = max(c0, 0.0)
        k_lo = wm_lo * p_norm(c0 / ax, s0 / ay, e2_lo) * 0.5 * h2_lo
        k_hi = wm_hi * p_norm(c1 / ax, s1 / ay, e2_hi) * 0.5 * h2_hi
        f_lo, f_hi = product(d2_lo, d2_hi, k_lo, k_hi)
        lo, hi = signed(s0, s1, -sy)
        lo, hi = product(f_lo, f_hi, lo, hi)
        gx_lo, gx_hi = gx_lo + lo, gx_hi + hi
        lo, hi = signed(c0, c1, sx)
        lo, hi = product(f_lo, f_hi, lo, hi)
        gy_lo, gy_hi = gy_lo + lo, gy_hi + hi
    if has_elevation:
        l0, l1 = math.sqrt(ring0 * ring0 + z0 * z0), math.sqrt(ring1 * ring1 + z1 * z1)
        f_lo, f_hi = product(d1_lo, d1_hi, n_lo * 0.5 * h1_lo / l1, n_hi * 0.5 * h1_hi / l0)
        c0, c1, s0, s1 = max(math.cos(theta1), 0.0), math.cos(theta0), math.sin(theta0), math.sin(theta1)
        q0, q1 = math.sin(phi0), math.sin(phi1)
        lo, hi = signed(q0 * c0, q1 * c1, -sz * sx)
        lo, hi = product(f_lo, f_hi, lo, hi)
        gx_lo, gx_hi = gx_lo + lo, gx_hi + hi
        lo, hi = signed(q0 * s0, q1 * s1, -sz * sy)
        lo, hi = product(f_lo, f_hi, lo, hi)
        gy_lo, gy_hi = gy_lo + lo, gy_hi + hi
        lo, hi = product(f_lo, f_hi, max(math.cos(phi1), 0.0), math.cos(phi0))
        gz_lo, gz_hi = gz_lo + lo, gz_hi + hi
    return n_lo, n_hi, gx_lo, gx_hi, gy_lo, gy_hi, gz_lo, gz_hi
