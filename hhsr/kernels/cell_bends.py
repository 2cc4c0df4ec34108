"""Second derivatives of W over a rectangle of directions where the base has exponents: by ranges (DESIGN §4)."""

import math

from hhsr.kernels.interval import plus, times
from hhsr.kernels.layout import AZIMUTH, AZIMUTH_COUNT, ELEVATION, ELEVATION_COUNT, HALF_AXES
from hhsr.kernels.norm_bends import norm_bends
from hhsr.kernels.superquadric import superquadric_norm
from hhsr.kernels.unmanaged import unmanaged

MOST = 1e6  # of W: a bound of its second derivative that is beyond this many times itself is none


@unmanaged
def _bends(blob, ints, leaf, face, x, y, z, sx, sy, sz):
    """Return the ranges (N_a, N_b, N_aa, N_ab, N_bb) over |x|, |y|, |z| (pairs) with signs."""
    h, p, q = ints[leaf + HALF_AXES], ints[leaf + AZIMUTH_COUNT], ints[leaf + ELEVATION_COUNT]
    o, e = ints[leaf + AZIMUTH], ints[leaf + ELEVATION]
    return norm_bends(
        x, y, z, sx, sy, sz, blob[h : h + 6], blob[o : o + 4 * p].reshape(p, 4), blob[e : e + 4 * q].reshape(q, 4), face
    )


@unmanaged
def norm_jet(blob, ints, leaf, face, a, b):
    """Return (N, N_a, N_b, N_aa, N_ab, N_bb) at (a, b); infinite or NaN where there is no second derivative."""
    m = 1.0 if face % 2 == 0 else -1.0
    if face < 2:
        x, y, z = m, a, b
    elif face < 4:
        x, y, z = b, m, a
    else:
        x, y, z = a, b, m
    if x == 0.0 and y == 0.0:
        return 1.0, 0.0, 0.0, math.inf, math.inf, math.inf
    na, nb, naa, nab, nbb = _bends(
        blob, ints, leaf, face, (abs(x), abs(x)), (abs(y), abs(y)), (abs(z), abs(z)),
        1.0 if x >= 0.0 else -1.0, 1.0 if y >= 0.0 else -1.0, 1.0 if z >= 0.0 else -1.0,
    )  # fmt: skip
    h, p, q = ints[leaf + HALF_AXES], ints[leaf + AZIMUTH_COUNT], ints[leaf + ELEVATION_COUNT]
    o, e = ints[leaf + AZIMUTH], ints[leaf + ELEVATION]
    norm = superquadric_norm(
        x, y, z, blob[h : h + 6], blob[o : o + 4 * p].reshape(p, 4), blob[e : e + 4 * q].reshape(q, 4)
    )
    return norm, na[0], nb[0], naa[0], nab[0], nbb[0]


@unmanaged
def _composed(bend, first, second, slope_first, slope_second, s_bend, d, w):
    """Return the range of W_ij = D (N_ij + W_i s_j + W_j s_i + W s_ij)."""
    mixed = plus(times(first, slope_second), times(second, slope_first))
    return times(d, plus(bend, plus(mixed, times(w, s_bend))))


@unmanaged
def _met(p, middle, reach):
    """Return the part of a range within `reach` of its middle."""
    return max(p[0], middle - reach), min(p[1], middle + reach)


@unmanaged
def _widest(p):
    return max(abs(p[0]), abs(p[1]))


@unmanaged
def rectangle_bends(blob, ints, leaf, face, chart, x, y, z, sx, sy, sz, norm, field, sa, sb, d, w, wa, wb):
    """Return (W_a, W_b, W_aa, W_ab, W_bb, kink): W's derivatives at the centre of a rectangle, and how far ∂²W strays.

    chart: (a, b, half_a, half_b). x, y, z: |coordinates| of its directions, with signs. field: s, s_a, s_b, s_aa, s_ab,
    s_bb at the centre, and how far ∂²s strays from it. sa … wb: proven ranges over the rectangle, of D = 1/(1 − s) and
    W too. Kink is infinite where it is not known.
    """
    a, b, half_a, half_b = chart
    s, s_a, s_b, s_aa, s_ab, s_bb, rest = field
    _, n_a, n_b, n_aa, n_ab, n_bb = norm_jet(blob, ints, leaf, face, a, b)
    c = 1.0 / (1.0 - s)
    value = norm * c
    w_a, w_b = c * (n_a + value * s_a), c * (n_b + value * s_b)
    w_aa = c * (n_aa + 2.0 * w_a * s_a + value * s_aa)
    w_ab = c * (n_ab + w_a * s_b + w_b * s_a + value * s_ab)
    w_bb = c * (n_bb + 2.0 * w_b * s_b + value * s_bb)
    _, _, naa, nab, nbb = _bends(blob, ints, leaf, face, x, y, z, sx, sy, sz)
    if not _widest(naa) + _widest(nab) + _widest(nbb) < MOST * value:
        return w_a, w_b, 0.0, 0.0, 0.0, math.inf
    saa, sab, sbb = (s_aa - rest, s_aa + rest), (s_ab - rest, s_ab + rest), (s_bb - rest, s_bb + rest)
    aa = ab = bb = (0.0, 0.0)
    for turn in range(2):
        aa, bb = _composed(naa, wa, wa, sa, sa, saa, d, w), _composed(nbb, wb, wb, sb, sb, sbb, d, w)
        ab = _composed(nab, wa, wb, sa, sb, sab, d, w)
        if turn == 0:  # the slopes stray no more than these let them
            cross = _widest(ab)
            wa = _met(wa, w_a, (half_a * _widest(aa) + half_b * cross) * (1.0 + 1e-9))
            wb = _met(wb, w_b, (half_b * _widest(bb) + half_a * cross) * (1.0 + 1e-9))
    round_off = 1e-9 * (_widest(aa) + _widest(ab) + _widest(bb) + value)
    kink = max(_away(aa, w_aa), _away(bb, w_bb)) + _away(ab, w_ab) + round_off
    return w_a, w_b, w_aa, w_ab, w_bb, (kink if kink < MOST * value else math.inf)


@unmanaged
def _away(p, middle):
    """Return how far a range reaches from a value in it."""
    return max(p[1] - middle, middle - p[0])
