"""Proven ranges of the second derivatives of a superquadric's norm N over a box of directions (DESIGN §4).

N is a p-norm of a p-norm whose exponents are splines of the azimuth and of the elevation: the chain rule on ranges.
Over a box without extent the ranges are the derivatives themselves. Infinite at the poles, and on coordinate planes
that the surface meets with an exponent ε > 1: so are the derivatives. Ranges are pairs (lo, hi).
"""

import math

from hhsr.kernels.interval import inverse, plus, scaled, signed, squared, times
from hhsr.kernels.norm_bounds import cubic_range
from hhsr.kernels.p_norm_bends import p_norm_bends
from hhsr.kernels.spline import HALF_RANGE
from hhsr.kernels.unmanaged import unmanaged

NONE = (0.0, 0.0)


@unmanaged
def exponent_bends(coefficients, share0, share1):
    """Return the ranges of k = 2/ε and of its first and second derivative over shares of the knots' range."""
    n = coefficients.shape[0]
    if n == 0:
        return (2.0, 2.0), NONE, NONE
    s_lo, s_hi, d_lo, d_hi, b_lo, b_hi = math.inf, -math.inf, math.inf, -math.inf, math.inf, -math.inf
    first = min(max(int(share0 * n - 1e-9), 0), n - 1)
    last = min(max(int(share1 * n + 1e-9), 0), n - 1)
    for segment in range(first, last + 1):
        x0, x1 = max(share0 * n - segment, 0.0), min(share1 * n - segment, 1.0)
        x0, x1 = min(x0, 1.0), max(x1, 0.0)
        c0, c1 = coefficients[segment, 0], coefficients[segment, 1]
        c2, c3 = coefficients[segment, 2], coefficients[segment, 3]
        lo, hi = cubic_range(c0, c1, c2, c3, x0, x1)
        s_lo, s_hi = min(s_lo, lo), max(s_hi, hi)
        lo, hi = cubic_range(c1, 2.0 * c2, 3.0 * c3, 0.0, x0, x1)
        d_lo, d_hi = min(d_lo, lo), max(d_hi, hi)
        lo, hi = 2.0 * c2 + 6.0 * c3 * x0, 2.0 * c2 + 6.0 * c3 * x1
        b_lo, b_hi = min(b_lo, lo, hi), max(b_hi, lo, hi)
    # ε = 1 + 0.9 g, g = tanh(s/2): ε' = 0.45 (1 − g²) s', ε'' = 0.45 (1 − g²) (s'' − g s'²).
    g = (math.tanh(0.5 * s_lo), math.tanh(0.5 * s_hi))
    flat = squared(g)
    flat = scaled((1.0 - flat[1], 1.0 - flat[0]), 0.5 * HALF_RANGE)
    slope = (d_lo * n, d_hi * n)
    bend = plus(scaled((b_lo, b_hi), 1.0 * n * n), scaled(times(g, squared(slope)), -1.0))
    over = inverse((1.0 + HALF_RANGE * g[0], 1.0 + HALF_RANGE * g[1]))
    e1, e2, over2 = times(flat, slope), times(flat, bend), squared(over)
    # k = 2/ε: k' = −2 ε'/ε², k'' = −2 ε''/ε² + 4 ε'²/ε³.
    first_part = scaled(times(e2, over2), -2.0)
    second_part = scaled(times(squared(e1), times(over, over2)), 4.0)
    return scaled(over, 2.0), scaled(times(e1, over2), -2.0), plus(first_part, second_part)


@unmanaged
def _azimuth_bends(k, x, y, ring2):
    """Return (k_x, k_y, k_xx, k_xy, k_yy) of k(θ/2π + ½), given k, k', k'' by the share."""
    turn = 1.0 / (2.0 * math.pi)
    over = inverse(ring2)
    tx, ty = scaled(times(y, over), -turn), scaled(times(x, over), turn)
    over2 = squared(over)
    txx = scaled(times(times(x, y), over2), 2.0 * turn)
    txy = scaled(times(plus(squared(y), scaled(squared(x), -1.0)), over2), turn)
    return (
        times(k[1], tx), times(k[1], ty), plus(times(k[2], squared(tx)), times(k[1], txx)),
        plus(times(k[2], times(tx, ty)), times(k[1], txy)),
        plus(times(k[2], squared(ty)), scaled(times(k[1], txx), -1.0)),
    )  # fmt: skip


@unmanaged
def _elevation_bends(k, x, y, z, ring, length2):
    """Return (k_x, k_y, k_z, k_xx, k_xy, k_yy, k_xz, k_yz, k_zz) of k(φ/π + ½), given k, k', k'' by the share."""
    turn = 1.0 / math.pi
    over_r, over_l = inverse(ring), inverse(length2)
    over_l2, over_r2 = squared(over_l), squared(over_r)
    rl = times(over_r, over_l)
    px, py = scaled(times(times(z, x), rl), -turn), scaled(times(times(z, y), rl), -turn)
    pz = scaled(times(ring, over_l), turn)
    # −z (1 − x² (1/ρ² + 2/l²))/(ρ l²), −y x (…)/(ρ l²), x (z² − ρ²)/(ρ l⁴), −2 z ρ/l⁴.
    steep = plus(over_r2, scaled(over_l, 2.0))
    zrl = scaled(times(z, rl), turn)
    one_x, one_y = times(squared(x), steep), times(squared(y), steep)
    pxx, pyy = times(zrl, (one_x[0] - 1.0, one_x[1] - 1.0)), times(zrl, (one_y[0] - 1.0, one_y[1] - 1.0))
    pxy = times(zrl, times(times(x, y), steep))
    aside = scaled(times(plus(squared(z), scaled(squared(ring), -1.0)), times(over_r, over_l2)), turn)
    pxz, pyz = times(x, aside), times(y, aside)
    pzz = scaled(times(times(z, ring), over_l2), -2.0 * turn)
    return (
        times(k[1], px), times(k[1], py), times(k[1], pz),
        plus(times(k[2], squared(px)), times(k[1], pxx)), plus(times(k[2], times(px, py)), times(k[1], pxy)),
        plus(times(k[2], squared(py)), times(k[1], pyy)), plus(times(k[2], times(px, pz)), times(k[1], pxz)),
        plus(times(k[2], times(py, pz)), times(k[1], pyz)), plus(times(k[2], squared(pz)), times(k[1], pzz)),
    )  # fmt: skip


@unmanaged
def _chained(second, mixed, bend, first, own_i, own_j, k_i, k_j, k_ij):
    """Return f_uu u_i u_j + f_uk (u_i k_j + u_j k_i) + f_kk k_i k_j + f_k k_ij."""
    cross = plus(times(own_i, k_j), times(own_j, k_i))
    total = plus(times(second, times(own_i, own_j)), times(mixed, cross))
    return plus(total, plus(times(bend, times(k_i, k_j)), times(first, k_ij)))


@unmanaged
def _with_z(m_i, k_i, k_z, k_iz, dz, n_mz, n_mk, n_zk, n_kk, n_k):
    """Return N_iz of an axis i that M depends on; Z alone depends on z."""
    total = plus(scaled(times(n_mz, m_i), dz), plus(times(n_mk, times(m_i, k_z)), scaled(times(n_zk, k_i), dz)))
    return plus(total, plus(times(n_kk, times(k_i, k_z)), times(n_k, k_iz)))


@unmanaged
def norm_bends(x, y, z, sx, sy, sz, half_axes, azimuth, elevation, face):
    """Return the ranges (N_a, N_b, N_aa, N_ab, N_bb) in a face's chart over |x|, |y|, |z| with signs sx, sy, sz = ±1.

    The box touches no pole.
    """
    ox = 1.0 / (half_axes[0] if sx > 0.0 else half_axes[1])
    oy = 1.0 / (half_axes[2] if sy > 0.0 else half_axes[3])
    oz = 1.0 / (half_axes[4] if sz > 0.0 else half_axes[5])
    t0, t1 = math.atan2(y[0], x[1]), math.atan2(y[1], x[0])
    if sx > 0.0:
        t0, t1 = (t0, t1) if sy > 0.0 else (-t1, -t0)
    else:
        t0, t1 = (math.pi - t1, math.pi - t0) if sy > 0.0 else (t0 - math.pi, t1 - math.pi)
    k2 = exponent_bends(azimuth, t0 / (2.0 * math.pi) + 0.5, t1 / (2.0 * math.pi) + 0.5)
    ring2 = plus(squared(x), squared(y))
    ring = (math.sqrt(ring2[0]), math.sqrt(ring2[1]))
    p0, p1 = signed(math.atan2(z[0], ring[1]), math.atan2(z[1], ring[0]), sz)
    k1 = exponent_bends(elevation, p0 / math.pi + 0.5, p1 / math.pi + 0.5)
    ux, uy, uz = signed(x[0], x[1], sx), signed(y[0], y[1], sy), signed(z[0], z[1], sz)
    ax, ay, axx, axy, ayy = _azimuth_bends(k2, ux, uy, ring2)
    ex, ey, ez, exx, exy, eyy, exz, eyz, ezz = _elevation_bends(k1, ux, uy, uz, ring, plus(ring2, squared(z)))
    m, m_u, m_v, m_k, m_uu, m_uv, m_vv, m_uk, m_vk, m_kk = p_norm_bends(scaled(x, ox), scaled(y, oy), k2[0])
    _, n_m, n_z, n_k, n_mm, n_mz, n_zz, n_mk, n_zk, n_kk = p_norm_bends(m, scaled(z, oz), k1[0])
    dx, dy, dz = ox * sx, oy * sy, oz * sz
    mx, my = plus(scaled(m_u, dx), times(m_k, ax)), plus(scaled(m_v, dy), times(m_k, ay))
    nx, ny = plus(times(n_m, mx), times(n_k, ex)), plus(times(n_m, my), times(n_k, ey))
    nz = plus(scaled(n_z, dz), times(n_k, ez))
    hx, hy, hz = (dx, dx), (dy, dy), (dz, dz)
    nxx = nyy = NONE
    if face >= 2:
        mxx = _chained(m_uu, m_uk, m_kk, m_k, hx, hx, ax, ax, axx)
        nxx = plus(_chained(n_mm, n_mk, n_kk, n_k, mx, mx, ex, ex, exx), times(n_m, mxx))
    if face < 2 or face >= 4:
        myy = _chained(m_vv, m_vk, m_kk, m_k, hy, hy, ay, ay, ayy)
        nyy = plus(_chained(n_mm, n_mk, n_kk, n_k, my, my, ey, ey, eyy), times(n_m, myy))
    if face < 4:
        nzz = _chained(n_zz, n_zk, n_kk, n_k, hz, hz, ez, ez, ezz)
        if face < 2:
            return ny, nz, nyy, _with_z(my, ey, ez, eyz, dz, n_mz, n_mk, n_zk, n_kk, n_k), nzz
        return nz, nx, nzz, _with_z(mx, ex, ez, exz, dz, n_mz, n_mk, n_zk, n_kk, n_k), nxx
    mxy = plus(scaled(m_uv, dx * dy), plus(scaled(times(m_uk, ay), dx), scaled(times(m_vk, ax), dy)))
    mxy = plus(mxy, plus(times(m_kk, times(ax, ay)), times(m_k, axy)))
    nxy = plus(_chained(n_mm, n_mk, n_kk, n_k, mx, my, ex, ey, exy), times(n_m, mxy))
    return nx, ny, nxx, nxy, nyy
