"""One cell of a leaf's cube map: exact values and proven linear models of W over a rectangle of directions.

On a face of the cube of directions, with major axis k and minor coordinates (a, b), a point is p = m·(1, a, b).
W(a, b) = |dir|/ρ = N(dir)/(1 − s), so p is inside where 1/m > W: (a, b, 1/m) is a projective map, in which segments
stay straight and the surface is a height field (DESIGN §4).
"""

import math

from hhsr.kernels.cell_bends import rectangle_bends
from hhsr.kernels.field_sums import field_at
from hhsr.kernels.interval import product, widened
from hhsr.kernels.layout import (
    AZIMUTH,
    AZIMUTH_COUNT,
    BLOCK_DATA,
    BLOCK_ROWS,
    BLOCKS,
    BLOCKS_PER_SIDE,
    ELEVATION,
    ELEVATION_COUNT,
    HALF_AXES,
)
from hhsr.kernels.leaf import MAX_SCALE
from hhsr.kernels.norm_bounds import norm_range
from hhsr.kernels.scale_range import scale_range
from hhsr.kernels.superquadric import superquadric_norm
from hhsr.kernels.third import third_over
from hhsr.kernels.unmanaged import inlined, unmanaged


@inlined
def face_of(x, y, z):
    """Return (face, a, b, m) of a point that is not the centre: face 2k for the positive major axis k, 2k + 1 else."""
    ux, uy, uz = abs(x), abs(y), abs(z)
    if ux >= uy and ux >= uz:
        return (0 if x >= 0.0 else 1), y / ux, z / ux, ux
    if uy >= uz:
        return (2 if y >= 0.0 else 3), z / uy, x / uy, uy
    return (4 if z >= 0.0 else 5), x / uz, y / uz, uz


@inlined
def direction_of(face, a, b):
    """Return the direction (x, y, z), of |·|∞ = 1, that belongs to (a, b) on a face."""
    m = 1.0 if face % 2 == 0 else -1.0
    if face < 2:
        return m, a, b
    if face < 4:
        return b, m, a
    return a, b, m


@unmanaged
def minor_parts(face, x, y, z):
    """Return the parts of a vector along a face's minor axes, a and b."""
    if face < 2:
        return y, z
    if face < 4:
        return z, x
    return x, y


@unmanaged
def chart_of(face, x, y, z):
    """Return (a, b, m) of a point on a given face: minor coordinates over the major one, and the major one."""
    if face < 2:
        m = x if face == 0 else -x
        return y / m, z / m, m
    if face < 4:
        m = y if face == 2 else -y
        return z / m, x / m, m
    m = z if face == 4 else -z
    return x / m, y / m, m


@unmanaged
def block_of(face, a, b):
    """Return the index of the block of directions that holds (a, b)."""
    half = 0.5 * BLOCKS_PER_SIDE
    i = min(max(int((a + 1.0) * half), 0), BLOCKS_PER_SIDE - 1)
    j = min(max(int((b + 1.0) * half), 0), BLOCKS_PER_SIDE - 1)
    return (face * BLOCKS_PER_SIDE + i) * BLOCKS_PER_SIDE + j


@inlined
def centres_of(ints, leaf, block):
    """Return (float slot, count) of the centres of a block of directions."""
    start = ints[leaf + BLOCKS] + block
    return ints[leaf + BLOCK_DATA] + ints[start], (ints[start + 1] - ints[start]) // BLOCK_ROWS


@inlined
def scale_in_block(blob, ints, leaf, block, ux, uy, uz):
    """Return s(u), summed over the centres of the block."""
    o, n = centres_of(ints, leaf, block)
    return field_at(blob, o, n, (ux, uy, uz))


@unmanaged
def is_ellipsoid(ints, leaf):
    """Return whether a leaf's base has no exponents."""
    return ints[leaf + AZIMUTH_COUNT] == 0 and ints[leaf + ELEVATION_COUNT] == 0


@unmanaged
def norm_at(blob, ints, leaf, x, y, z):
    """Return the superquadric's norm N of a leaf at (x, y, z)."""
    n, m = ints[leaf + AZIMUTH_COUNT], ints[leaf + ELEVATION_COUNT]
    h, s, e = ints[leaf + HALF_AXES], ints[leaf + AZIMUTH], ints[leaf + ELEVATION]
    if is_ellipsoid(ints, leaf):
        sx = x / blob[h] if x >= 0.0 else -x / blob[h + 1]
        sy = y / blob[h + 2] if y >= 0.0 else -y / blob[h + 3]
        sz = z / blob[h + 4] if z >= 0.0 else -z / blob[h + 5]
        return math.sqrt(sx * sx + sy * sy + sz * sz)
    return superquadric_norm(
        x, y, z, blob[h : h + 6], blob[s : s + 4 * n].reshape(n, 4), blob[e : e + 4 * m].reshape(m, 4)
    )


@unmanaged
def leaf_implicit(blob, ints, leaf, x, y, z):
    """Return G(p) = N(p) + s(p/|p|) − 1 in the leaf's frame: ≤ 0 inside. The exact formula behind every answer."""
    length = math.sqrt(x * x + y * y + z * z)
    if length == 0.0:
        return MAX_SCALE - 1.0
    face, a, b, _ = face_of(x, y, z)
    s = scale_in_block(blob, ints, leaf, block_of(face, a, b), x / length, y / length, z / length)
    return norm_at(blob, ints, leaf, x, y, z) + min(s, MAX_SCALE) - 1.0


@unmanaged
def inverse_radius(blob, ints, leaf, face, a, b):
    """Return W(a, b) by the exact formula."""
    x, y, z = direction_of(face, a, b)
    length = math.sqrt(x * x + y * y + z * z)
    s = scale_in_block(blob, ints, leaf, block_of(face, a, b), x / length, y / length, z / length)
    return norm_at(blob, ints, leaf, x, y, z) / (1.0 - min(s, MAX_SCALE))


@unmanaged
def axis_scale(blob, half_axes, axis, sign):
    """Return 1/A² of the half axis on one side."""
    size = blob[half_axes + axis] if sign > 0.0 else blob[half_axes + axis + 1]
    return 1.0 / (size * size)


@unmanaged
def cell_model(blob, ints, leaf, face, a, b, half_a, half_b, by_ranges):
    """Return (value, slope_a, slope_b, error, spread_a, spread_b, lo, hi, bend_lo, bend_hi, kink, third, aa, ab, bb).

    |W − value − slope·δ| ≤ error, |∂W − slope| ≤ spread, lo ≤ W ≤ hi, the eigenvalues of ∂²W lie in [bend_lo, bend_hi],
    and ∂²W differs from that at the centre by no more than kink + r·third at r from it (infinite where the field may be
    capped, or second derivatives are): all proven on the whole rectangle about (a, b).
    `value` is the middle of that strip, not W at the centre. (aa, ab, bb): ∂²W at the centre; then the slope is ∂W
    there, and value W + (aa·half_a² + bb·half_b²)/4. NaN where it is not. The rectangle must lie within one block of
    directions and straddle no coordinate plane. by_ranges: second derivatives also where the base is no ellipsoid, in
    three times the time.
    """
    bend_lo, bend_hi, kink, third = -math.inf, math.inf, math.inf, math.inf
    bend_aa = bend_ab = bend_bb = math.nan
    block = block_of(face, a, b)
    x, y, z = direction_of(face, a, b)
    (s, sa, sb, wide_a, wide_b, saa, sab, sbb, rest2, rest3, saaa, saab, sabb, sbbb, border3, rest4) = scale_range(
        blob, ints, leaf, block, face, x, y, z, a, b, half_a, half_b
    )
    sa_lo, sa_hi, sb_lo, sb_hi = sa - wide_a, sa + wide_a, sb - wide_b, sb + wide_b
    norm = norm_at(blob, ints, leaf, x, y, z)
    value = norm / (1.0 - min(s, MAX_SCALE))
    reach = max(-sa_lo, sa_hi) * half_a + max(-sb_lo, sb_hi) * half_b
    s_lo, s_hi = s - reach, s + reach
    h, p, q = ints[leaf + HALF_AXES], ints[leaf + AZIMUTH_COUNT], ints[leaf + ELEVATION_COUNT]
    smooth = p == 0 and q == 0 and s_hi < MAX_SCALE
    if s_hi > MAX_SCALE:  # the cap: slope 0 above it
        if s_lo > MAX_SCALE:
            sa_lo = sa_hi = sb_lo = sb_hi = 0.0
        sa_lo, sa_hi, sb_lo, sb_hi = min(sa_lo, 0.0), max(sa_hi, 0.0), min(sb_lo, 0.0), max(sb_hi, 0.0)
        s_lo, s_hi = min(s_lo, MAX_SCALE), MAX_SCALE
    d_lo, d_hi = 1.0 / (1.0 - s_lo), 1.0 / (1.0 - s_hi)
    sign_a, sign_b = (1.0 if a >= 0.0 else -1.0), (1.0 if b >= 0.0 else -1.0)
    a0, a1 = max(abs(a) - half_a, 0.0), abs(a) + half_a
    b0, b1 = max(abs(b) - half_b, 0.0), abs(b) + half_b
    m = 1.0 if face % 2 == 0 else -1.0
    axes = blob[h : h + 6]
    o = ints[leaf + AZIMUTH]
    azimuth = blob[o : o + 4 * p].reshape(p, 4)
    o = ints[leaf + ELEVATION]
    elevation = blob[o : o + 4 * q].reshape(q, 4)
    if face < 2:
        x0, x1, y0, y1, z0, z1, sx, sy, sz = 1.0, 1.0, a0, a1, b0, b1, m, sign_a, sign_b
    elif face < 4:
        x0, x1, y0, y1, z0, z1, sx, sy, sz = b0, b1, 1.0, 1.0, a0, a1, sign_b, m, sign_a
    else:
        x0, x1, y0, y1, z0, z1, sx, sy, sz = a0, a1, b0, b1, 1.0, 1.0, sign_a, sign_b, m
    n_lo, n_hi, gx0, gx1, gy0, gy1, gz0, gz1 = norm_range(x0, x1, y0, y1, z0, z1, sx, sy, sz, axes, azimuth, elevation)
    if face < 2:
        na_lo, na_hi, nb_lo, nb_hi = gy0, gy1, gz0, gz1
    elif face < 4:
        na_lo, na_hi, nb_lo, nb_hi = gz0, gz1, gx0, gx1
    else:
        na_lo, na_hi, nb_lo, nb_hi = gx0, gx1, gy0, gy1
    # N by its mean value form too, then W = N·D and ∂W = D·(∂N + W·∂s).
    reach = max(-na_lo, na_hi) * half_a + max(-nb_lo, nb_hi) * half_b
    n_lo, n_hi = max(n_lo, norm - reach), min(n_hi, norm + reach)
    w_lo, w_hi = n_lo * d_lo, n_hi * d_hi
    for _ in range(2):  # the second pass uses the range of W that the first one proved
        lo, hi = product(sa_lo, sa_hi, w_lo, w_hi)
        wa_lo, wa_hi = product(na_lo + lo, na_hi + hi, d_lo, d_hi)
        lo, hi = product(sb_lo, sb_hi, w_lo, w_hi)
        wb_lo, wb_hi = product(nb_lo + lo, nb_hi + hi, d_lo, d_hi)
        reach = max(-wa_lo, wa_hi) * half_a + max(-wb_lo, wb_hi) * half_b
        w_lo, w_hi = max(w_lo, value - reach), min(w_hi, value + reach)
    wa_lo, wa_hi = widened(wa_lo, wa_hi)
    wb_lo, wb_hi = widened(wb_lo, wb_hi)
    w_lo, w_hi = widened(w_lo, w_hi)
    slope_a, slope_b = 0.5 * (wa_lo + wa_hi), 0.5 * (wb_lo + wb_hi)
    spread_a, spread_b = 0.5 * (wa_hi - wa_lo), 0.5 * (wb_hi - wb_lo)
    error = (spread_a * half_a + spread_b * half_b) * (1.0 + 1e-11) + 1e-11 * abs(value)
    r = math.sqrt(half_a * half_a + half_b * half_b)
    if smooth:
        # An ellipsoid: N_ij = (A_i² δ_ij − N_i N_j)/N, and Taylor to third order, with D_i = D² s_i.
        if face < 2:
            scale_a, scale_b = axis_scale(blob, h, 2, sign_a), axis_scale(blob, h, 4, sign_b)
        elif face < 4:
            scale_a, scale_b = axis_scale(blob, h, 4, sign_a), axis_scale(blob, h, 0, sign_b)
        else:
            scale_a, scale_b = axis_scale(blob, h, 0, sign_a), axis_scale(blob, h, 2, sign_b)
        d = 1.0 / (1.0 - s)
        exact_a = d * (scale_a * a / norm + value * sa)
        exact_b = d * (scale_b * b / norm + value * sb)
        na, nb = scale_a * a / norm, scale_b * b / norm
        aa = d * ((scale_a - na * na) / norm + d * (2.0 * na * sa + norm * (saa + 2.0 * d * sa * sa)))
        bb = d * ((scale_b - nb * nb) / norm + d * (2.0 * nb * sb + norm * (sbb + 2.0 * d * sb * sb)))
        ab = d * (-na * nb / norm + d * (na * sb + nb * sa + norm * (sab + 2.0 * d * sa * sb)))
        # Beyond the Hessian: the third derivative, and the kinks where supports end.
        s1 = math.sqrt(max(-sa_lo, sa_hi) ** 2 + max(-sb_lo, sb_hi) ** 2)
        s2 = max(abs(saa), abs(sbb)) + abs(sab) + rest2 + r * rest3
        n1 = math.sqrt(max(-na_lo, na_hi) ** 2 + max(-nb_lo, nb_hi) ** 2)
        kink = n_hi * d_hi * d_hi * rest2
        third = third_over(
            norm, na, nb, scale_a, scale_b, d, sa, sb, saa, sab, sbb, saaa, saab, sabb, sbbb,
            n_lo, n_hi, n1, max(scale_a, scale_b) / n_lo, d_hi, s1, s2, rest2, rest3, border3, rest4, r,
        )  # fmt: skip
    elif by_ranges and p + q > 0 and s_hi < MAX_SCALE and (face < 4 or a0 + b0 > 0.0):
        rest = rest2 + r * rest3
        exact_a, exact_b, aa, ab, bb, kink = rectangle_bends(
            blob, ints, leaf, face, (a, b, half_a, half_b), (x0, x1), (y0, y1), (z0, z1), sx, sy, sz, norm,
            (s, sa, sb, saa, sab, sbb, rest), (sa_lo, sa_hi), (sb_lo, sb_hi), (d_lo, d_hi), (w_lo, w_hi),
            (wa_lo, wa_hi), (wb_lo, wb_hi),
        )  # fmt: skip
        third = 0.0 if kink < math.inf else math.inf
    if third < math.inf:
        rise = r * third
        middle, wide = 0.5 * (aa + bb), math.sqrt(0.25 * (aa - bb) ** 2 + ab * ab)
        bend_lo = middle - wide - (kink + rise) * (1.0 + 1e-9) - 1e-9 * abs(value)
        bend_hi = middle + wide + (kink + rise) * (1.0 + 1e-9) + 1e-9 * abs(value)
        cross = half_a * half_b * abs(ab) + r * r * (0.5 * kink + rise / 6.0)
        low = 0.5 * (min(aa, 0.0) * half_a * half_a + min(bb, 0.0) * half_b * half_b) - cross
        high = 0.5 * (max(aa, 0.0) * half_a * half_a + max(bb, 0.0) * half_b * half_b) + cross
        second = 0.5 * (high - low) * (1.0 + 1e-9) + 1e-11 * abs(value)
        if second < error:
            error = second
            slope_a, slope_b = exact_a, exact_b
            bend_aa, bend_ab, bend_bb = aa, ab, bb
            # The slopes are exact ones at the centre now; their spread by whichever bound is smaller.
            wide_a = half_a * abs(aa) + half_b * abs(ab) + r * (kink + 0.5 * rise)
            wide_b = half_a * abs(ab) + half_b * abs(bb) + r * (kink + 0.5 * rise)
            spread_a = min(wide_a * (1.0 + 1e-9), max(wa_hi - exact_a, exact_a - wa_lo)) + 1e-11 * abs(exact_a)
            spread_b = min(wide_b * (1.0 + 1e-9), max(wb_hi - exact_b, exact_b - wb_lo)) + 1e-11 * abs(exact_b)
            value += 0.5 * (low + high)
            reach = abs(slope_a) * half_a + abs(slope_b) * half_b + error
            w_lo, w_hi = max(w_lo, value - reach), min(w_hi, value + reach)
    return (
        value, slope_a, slope_b, error, spread_a, spread_b, w_lo, w_hi, bend_lo, bend_hi, kink, third,
        bend_aa, bend_ab, bend_bb,
    )  # fmt: skip
