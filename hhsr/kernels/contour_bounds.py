"""Proven ranges of a fitted contour's radius C(α) and its derivatives over an arc of one quadrant (DESIGN §1, §4)."""

import math

from hhsr.kernels.interval import SLACK, product, signed
from hhsr.kernels.norm_bounds import norm_range
from hhsr.kernels.slab import (
    LOBE_AXES,
    LOBE_CENTRES,
    LOBE_COUNT_CENTRES,
    LOBE_EXTENT,
    LOBE_SEGMENTS,
    LOBE_SPLINE,
    LOBE_WEIGHTS,
    lobe_contour,
)
from hhsr.kernels.unmanaged import unmanaged

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
def _quadrant(blob, ints, lobe, angle):
    """Return (1/a², 1/b²) of the half axes of the quadrant that holds an angle."""
    axes = ints[lobe + LOBE_AXES]
    a = blob[axes + (0 if abs(angle) < 0.5 * math.pi else 1)]
    b = blob[axes + (2 if angle >= 0.0 else 3)]
    return 1.0 / (a * a), 1.0 / (b * b)


@unmanaged
def contour_jet(blob, ints, lobe, angle):
    """Return (C, C') at an angle, for a contour without exponents whose scale field stays below its cap."""
    k = ints[lobe + LOBE_COUNT_CENTRES]
    c, w, inverse = ints[lobe + LOBE_CENTRES], ints[lobe + LOBE_WEIGHTS], blob[ints[lobe + LOBE_EXTENT]]
    cosine, sine = math.cos(angle), math.sin(angle)
    value = slope = 0.0
    for j in range(k):
        h = (1.0 - (cosine * blob[c + 2 * j] + sine * blob[c + 2 * j + 1])) * inverse
        if h < 1.0:
            rest = 1.0 - h
            e = blob[w + j] * math.exp(-4.0 * h) * rest
            value += e * rest
            slope += e * (4.0 * rest + 2.0) * (cosine * blob[c + 2 * j + 1] - sine * blob[c + 2 * j])
    over_a, over_b = _quadrant(blob, ints, lobe, angle)
    norm = math.sqrt(cosine * cosine * over_a + sine * sine * over_b)
    radius = (1.0 - value) / norm
    return radius, -(slope * inverse + radius * (over_b - over_a) * cosine * sine / norm) / norm


@unmanaged
def _circle_bend_range(blob, ints, lobe, angle, half):
    """Return the range of the contour's scale field's second derivative over angle ± half, each centre by itself."""
    k = ints[lobe + LOBE_COUNT_CENTRES]
    c, w, inverse = ints[lobe + LOBE_CENTRES], ints[lobe + LOBE_WEIGHTS], blob[ints[lobe + LOBE_EXTENT]]
    cosine, sine = math.cos(angle), math.sin(angle)
    lo = hi = 0.0
    for j in range(k):
        near = cosine * blob[c + 2 * j] + sine * blob[c + 2 * j + 1]
        gap = math.acos(min(max(near, -1.0), 1.0))
        g0, g1 = max(gap - half - 2e-8, 0.0), min(gap + half + 2e-8, math.pi)
        c0, c1 = math.cos(g1), math.cos(g0)
        h0, h1 = (1.0 - c1) * inverse, (1.0 - c0) * inverse
        if h0 >= 1.0:
            continue
        # ψ(h) = (1 − h)² e^(−4h): |ψ'| and ψ'' fall with h, to 0 and to 2 e^(−4), then 0.
        rest, e = 1.0 - h0, math.exp(-4.0 * h0)
        d1_hi, d2_hi = e * rest * (4.0 * rest + 2.0), e * (16.0 * rest * rest + 16.0 * rest + 2.0)
        d1_lo = d2_lo = 0.0
        if h1 < 1.0:
            rest, e = 1.0 - h1, math.exp(-4.0 * h1)
            d1_lo, d2_lo = e * rest * (4.0 * rest + 2.0), e * (16.0 * rest * rest + 16.0 * rest + 2.0)
        s0, s1 = math.sin(g0), math.sin(g1)
        top = 1.0 if g0 <= 0.5 * math.pi <= g1 else max(s0, s1)
        low = min(s0, s1)
        # ψ'' (h')² + ψ' h'', with h' = sin γ/(1 − cos σ) and h'' = cos γ/(1 − cos σ).
        p0, p1 = d2_lo * low * low * inverse, d2_hi * top * top * inverse
        q0, q1 = product(-d1_hi, -d1_lo, c0, c1)
        p0, p1 = product((p0 + q0) * inverse, (p1 + q1) * inverse, blob[w + j], blob[w + j])
        lo, hi = lo + p0, hi + p1
    return lo, hi


@unmanaged
def contour_bend(blob, ints, lobe, angle, half):
    """Return a bound of |C''| over angle ± half, within one quadrant; infinite where none is known.

    From C·N = 1 − s: C'' = −(s'' + 2 C' N' + C N'')/N; without exponents N² = cos²α/a² + sin²α/b².
    """
    _, s_hi, _, _ = circle_scale_range(blob, ints, lobe, angle, half)
    if ints[lobe + LOBE_SEGMENTS] > 0 or s_hi >= MAX_SCALE:
        return math.inf
    _, c_lo, c_hi, d_lo, d_hi = contour_range(blob, ints, lobe, angle, half)
    over_a, over_b = _quadrant(blob, ints, lobe, angle)
    inner = abs(angle) if abs(angle) < 0.5 * math.pi else math.pi - abs(angle)
    a0, a1 = max(inner - half, 0.0), min(inner + half, 0.5 * math.pi)
    c0, c1, s0, s1 = max(math.cos(a1), 0.0), math.cos(a0), math.sin(a0), math.sin(a1)
    first, last = over_a + (over_b - over_a) * s0 * s0, over_a + (over_b - over_a) * s1 * s1
    n_lo, n_hi = math.sqrt(min(first, last)), math.sqrt(max(first, last))
    turn = over_b - over_a
    # N N' = (1/b² − 1/a²) sin α cos α, with the sign of the quadrant; N N'' = (1/b² − 1/a²) cos 2α − N'².
    way = 1.0 if (abs(angle) < 0.5 * math.pi) == (angle >= 0.0) else -1.0
    lo, hi = product(c0 * s0, c1 * s1, way * turn, way * turn)
    n1_lo, n1_hi = product(lo, hi, 1.0 / n_hi, 1.0 / n_lo)
    most, least = max(n1_lo * n1_lo, n1_hi * n1_hi), min(n1_lo * n1_lo, n1_hi * n1_hi)
    lo, hi = product(c0 * c0 - s1 * s1, c1 * c1 - s0 * s0, turn, turn)
    n2_lo, n2_hi = product(lo - most, hi - least, 1.0 / n_hi, 1.0 / n_lo)
    lo, hi = _circle_bend_range(blob, ints, lobe, angle, half)
    p0, p1 = product(2.0 * d_lo, 2.0 * d_hi, n1_lo, n1_hi)
    q0, q1 = product(c_lo, c_hi, n2_lo, n2_hi)
    return max(abs(lo + p0 + q0), abs(hi + p1 + q1)) / n_lo * (1.0 + 1e-9)
