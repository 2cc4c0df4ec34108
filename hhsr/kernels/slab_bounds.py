"""Proven ranges and linear models of a lobe's radius r(α, t) over pieces of angle and height (DESIGN §2, §4)."""

import math

import numpy as np

from hhsr.kernels.interval import SLACK, product, signed
from hhsr.kernels.norm_bounds import norm_range
from hhsr.kernels.slab import (
    LOBE_AXES,
    LOBE_CENTRES,
    LOBE_COUNT_CENTRES,
    LOBE_EXTENT,
    LOBE_SEGMENTS,
    LOBE_SPHERES,
    LOBE_SPLINE,
    LOBE_TABLES,
    LOBE_WEIGHTS,
    SLAB_FRAME,
    TABLE,
    lobe_contour,
)
from hhsr.kernels.unmanaged import entry, unmanaged

STEP = 2.0 * math.pi / TABLE
MAX_SCALE = 0.95


@unmanaged
def circle_scale_range(blob, ints, lobe, angle, half):
    """Return (s_lo, s_hi, s'_lo, s'_hi) of the contour's scale field over angle ± half, by each centre's own range."""
    k = ints[lobe + LOBE_COUNT_CENTRES]
    c, w, inverse = ints[lobe + LOBE_CENTRES], ints[lobe + LOBE_WEIGHTS], blob[ints[lobe + LOBE_EXTENT]]
    cosine, sine = math.cos(angle), math.sin(angle)
    value = slope = spread = 0.0
    for j in range(k):
        # d = 1 − cos(α − α_j); nearest and farthest over the piece.
        near = cosine * blob[c + 2 * j] + sine * blob[c + 2 * j + 1]
        gap = math.acos(min(max(near, -1.0), 1.0))
        h_lo = (1.0 - math.cos(max(gap - half - 2e-8, 0.0))) * inverse
        if h_lo >= 1.0:
            continue
        far = min(gap + half + 2e-8, math.pi)
        rest = 1.0 - h_lo
        e = math.exp(-4.0 * h_lo)
        d1 = e * rest * (4.0 * rest + 2.0)
        d2 = e * (16.0 * rest * rest + 16.0 * rest + 2.0)
        top = 1.0 if gap - half <= 0.5 * math.pi <= far else max(math.sin(far), math.sin(max(gap - half, 0.0)))
        weight = blob[w + j]
        spread += abs(weight) * inverse * (d2 * inverse * top * top + d1) * half
        h = (1.0 - near) * inverse
        if h < 1.0:
            rest = 1.0 - h
            e = math.exp(-4.0 * h)
            value += weight * e * rest * rest
            turn = -sine * blob[c + 2 * j] + cosine * blob[c + 2 * j + 1]  # d(cos(α − α_j))/dα
            slope += weight * inverse * e * rest * (4.0 * rest + 2.0) * turn
    lo, hi = slope - spread, slope + spread
    reach = half * max(-lo, hi)
    if value + reach > MAX_SCALE:
        lo, hi = min(lo, 0.0), max(hi, 0.0)
    return min(value - reach, MAX_SCALE), min(value + reach, MAX_SCALE), lo, hi


@unmanaged
def contour_range(blob, ints, lobe, angle, half):
    """Return (C, C_lo, C_hi, C'_lo, C'_hi) over angle ± half, a piece of one quadrant; C at the angle itself."""
    n = ints[lobe + LOBE_SEGMENTS]
    axes, s = ints[lobe + LOBE_AXES], ints[lobe + LOBE_SPLINE]
    middle = lobe_contour(blob, ints, lobe, math.cos(angle), math.sin(angle))
    sx = 1.0 if abs(angle) < 0.5 * math.pi else -1.0
    sy = 1.0 if angle >= 0.0 else -1.0
    # Angle from the x-axis within the quadrant.
    inner = abs(angle) if sx > 0.0 else math.pi - abs(angle)
    a0, a1 = max(inner - half, 0.0), min(inner + half, 0.5 * math.pi)
    c0, c1, s0, s1 = max(math.cos(a1), 0.0), math.cos(a0), math.sin(a0), math.sin(a1)
    none = blob[s:s].reshape(0, 4)
    n_lo, n_hi, gx0, gx1, gy0, gy1, _, _ = norm_range(
        c0, c1, s0, s1, 0.0, 0.0, sx, sy, 1.0, blob[axes : axes + 6], blob[s : s + 4 * n].reshape(n, 4), none
    )
    # dN/dα = −sin α · N_x + cos α · N_y.
    lo, hi = signed(s0, s1, -sy)
    p0, p1 = product(gx0, gx1, lo, hi)
    lo, hi = signed(c0, c1, sx)
    q0, q1 = product(gy0, gy1, lo, hi)
    t_lo, t_hi = p0 + q0, p1 + q1
    s_lo, s_hi, d_lo, d_hi = circle_scale_range(blob, ints, lobe, angle, half)
    # C = (1 − s)/N, C' = −(s' + C·N')/N.
    low, high = (1.0 - s_hi) / n_hi, (1.0 - s_lo) / n_lo
    g_lo = g_hi = 0.0
    for _ in range(2):
        p0, p1 = product(low, high, t_lo, t_hi)
        g_lo, g_hi = product(-(d_hi + p1), -(d_lo + p0), 1.0 / n_hi, 1.0 / n_lo)
        reach = half * max(-g_lo, g_hi)
        low, high = max(low, middle - reach), min(high, middle + reach)
    grow = SLACK * (abs(g_lo) + abs(g_hi) + high)
    return middle, low - grow, high + grow, g_lo - grow, g_hi + grow


@unmanaged
def lobe_model(blob, ints, lobe, segment, angle, t, half, half_t):
    """Return (r, r_α, r_t, error, lo, hi): r within ± error of its linear model over angle ± half, t ± half_t.

    The piece lies in one segment of the tables and t ± half_t in [0, 1]. r may be negative here: no solid then.
    """
    middle, c_lo, c_hi, d_lo, d_hi = contour_range(blob, ints, lobe, angle, half)
    o = ints[lobe + LOBE_TABLES] + 2 + segment
    x = (angle + math.pi) / STEP - segment
    left_slope, right_slope = (blob[o + 1] - blob[o]) / STEP, (blob[o + TABLE + 2] - blob[o + TABLE + 1]) / STEP
    left, right = blob[o] + x * left_slope * STEP, blob[o + TABLE + 1] + x * right_slope * STEP
    t0, t1 = max(t - half_t, 0.0), min(t + half_t, 1.0)
    # r = L (1−t)(1−2t) + 4 t (1−t) C + R t (2t−1): slopes over the piece, by the range of each weight.
    wl0, wl1 = _weight(t0, t1, True)
    wr0, wr1 = _weight(t0, t1, False)
    wc0, wc1 = min(4.0 * t0 * (1.0 - t0), 4.0 * t1 * (1.0 - t1)), max(4.0 * t0 * (1.0 - t0), 4.0 * t1 * (1.0 - t1))
    if t0 < 0.5 < t1:
        wc1 = 1.0
    p0, p1 = product(left_slope, left_slope, wl0, wl1)
    q0, q1 = product(right_slope, right_slope, wr0, wr1)
    k0, k1 = product(d_lo, d_hi, wc0, wc1)
    a_lo, a_hi = p0 + q0 + k0, p1 + q1 + k1
    # r_t = L (4t − 3) + 4 C (1 − 2t) + R (4t − 1).
    l_lo, l_hi = left - abs(left_slope) * half, left + abs(left_slope) * half
    r_lo, r_hi = right - abs(right_slope) * half, right + abs(right_slope) * half
    p0, p1 = product(l_lo, l_hi, 4.0 * t0 - 3.0, 4.0 * t1 - 3.0)
    q0, q1 = product(r_lo, r_hi, 4.0 * t0 - 1.0, 4.0 * t1 - 1.0)
    k0, k1 = product(4.0 * c_lo, 4.0 * c_hi, 1.0 - 2.0 * t1, 1.0 - 2.0 * t0)
    t_lo, t_hi = p0 + q0 + k0, p1 + q1 + k1
    u = 1.0 - t
    value = left * u * (1.0 - 2.0 * t) + 4.0 * t * u * middle + right * t * (2.0 * t - 1.0)
    slope_a, slope_t = 0.5 * (a_lo + a_hi), 0.5 * (t_lo + t_hi)
    error = 0.5 * (a_hi - a_lo) * half + 0.5 * (t_hi - t_lo) * half_t + SLACK * (abs(left) + abs(right) + middle)
    reach = abs(slope_a) * half + abs(slope_t) * half_t + error
    return value, slope_a, slope_t, error, value - reach, value + reach


@unmanaged
def _weight(t0, t1, left):
    """Return the range of (1 − t)(1 − 2t), or of t (2t − 1), over [t0, t1]."""
    if left:
        a, b, turn, low = (1.0 - t0) * (1.0 - 2.0 * t0), (1.0 - t1) * (1.0 - 2.0 * t1), 0.75, -0.125
    else:
        a, b, turn, low = t0 * (2.0 * t0 - 1.0), t1 * (2.0 * t1 - 1.0), 0.25, -0.125
    return (low if t0 <= turn <= t1 else min(a, b)), max(a, b)


@unmanaged
def lobe_range(blob, ints, lobe, angle0, angle1, t0, t1):
    """Return the range of r over [angle0, angle1] (within [−π, π], spanning few segments) and [t0, t1]."""
    lo, hi = 1e300, -1e300
    first = min(max(int((angle0 + math.pi) / STEP - 1e-9), 0), TABLE - 1)
    last = min(max(int((angle1 + math.pi) / STEP + 1e-9), 0), TABLE - 1)
    for segment in range(first, last + 1):
        a0 = max(angle0, segment * STEP - math.pi)
        a1 = min(angle1, (segment + 1) * STEP - math.pi)
        half = max(0.5 * (a1 - a0), 0.0) + 1e-12
        _, _, _, _, low, high = lobe_model(
            blob, ints, lobe, segment, 0.5 * (a0 + a1), 0.5 * (t0 + t1), half, 0.5 * (t1 - t0)
        )
        lo, hi = min(lo, low), max(hi, high)
    return lo, hi


@entry
def fill_lobe_spheres(blob, ints, slab, lobe, spheres):
    """Fill (TABLE, 6): sphere of each segment's strip (tree frame) 4, least and greatest r."""
    f = ints[slab + SLAB_FRAME]
    d = blob[f + 10]
    o = ints[lobe + LOBE_TABLES]
    for segment in range(TABLE):
        lo, hi = 1e300, -1e300
        angle = (segment + 0.5) * STEP - math.pi
        for k in range(8):
            _, _, _, _, low, high = lobe_model(
                blob, ints, lobe, segment, angle, (k + 0.5) / 8.0, 0.5 * STEP * (1.0 + 1e-12), 1.0 / 16.0
            )
            lo, hi = min(lo, low), max(hi, high)
        lo, hi = max(lo, 0.0), max(hi, 0.0)
        r = 0.5 * (lo + hi)
        u, v = blob[o] + r * math.cos(angle), blob[o + 1] + r * math.sin(angle)
        for k in range(3):
            spheres[segment, k] = u * blob[f + k] + v * blob[f + 3 + k] + blob[f + 9] * blob[f + 6 + k]
        spheres[segment, 3] = math.sqrt(
            (0.5 * (hi - lo) + hi * STEP * STEP / 8.0) ** 2 + (0.5 * hi * STEP) ** 2 + d * d
        )
        spheres[segment, 4], spheres[segment, 5] = lo, hi


@unmanaged
def lobe_limits(blob, ints, lobe):
    """Return the least and the greatest r of a lobe."""
    o = ints[lobe + LOBE_SPHERES]
    lo, hi = np.inf, 0.0
    for segment in range(TABLE):
        lo, hi = min(lo, blob[o + 6 * segment + 4]), max(hi, blob[o + 6 * segment + 5])
    return lo, hi
