"""Compact Gaussians on the sphere and on the circle: the scale field s (PAPER Eq. 3, DESIGN §1)."""

import math

from numba import njit


@njit(cache=True)
def wendland_gaussian(h):
    """Return λ = e^(−4h) (1 − h)² for h = d / (1 − cos σ) < 1, else 0."""
    if h >= 1.0:
        return 0.0
    rest = 1.0 - h
    return math.exp(-4.0 * h) * rest * rest


@njit(cache=True)
def scale_on_sphere(ux, uy, uz, centres, inverse_extents, weights):
    """Return s(u) of a unit direction. centres: (k, 3); inverse_extents: (k,) 1/(1 − cos σ); weights: (k,)."""
    total = 0.0
    for j in range(weights.shape[0]):
        h = (1.0 - (ux * centres[j, 0] + uy * centres[j, 1] + uz * centres[j, 2])) * inverse_extents[j]
        if h < 1.0:
            total += weights[j] * wendland_gaussian(h)
    return total


@njit(cache=True)
def scale_on_circle(cosine, sine, centres, inverse_extent, weights):
    """Return s(α) on the circle. centres: (k, 2) cos α_j, sin α_j; one support for all."""
    total = 0.0
    for j in range(weights.shape[0]):
        h = (1.0 - (cosine * centres[j, 0] + sine * centres[j, 1])) * inverse_extent
        if h < 1.0:
            total += weights[j] * wendland_gaussian(h)
    return total


# e^(−t/2) on [−1, 1]: Chebyshev interpolation of degree 11 (error 2.4e-16) in powers of t, from 40 digits. No call of
# the C library stands in the loop then, and the compiler runs it four centres at a time.
POWERS = (
    0.9999999999999998,
    -0.49999999999999994,
    0.12500000000001799,
    -0.02083333333333508,
    0.002604166666456743,
    -0.0002604166666526762,
    2.170138978433107e-05,
    -1.550099254304914e-06,
    9.687947422138764e-08,
    -5.382209016747527e-09,
    2.70647493210243e-10,
    -1.229633898293371e-11,
)
_P0, _P1, _P2, _P3, _P4, _P5, _P6, _P7, _P8, _P9, _P10, _P11 = POWERS
_MIDDLE = math.exp(-2.0)


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def gaussian_sum(cx, cy, cz, inverse_extents, weights, ux, uy, uz):
    """Return Σ w λ(h) of a unit direction over rows (n,) of centres: `scale_on_sphere` at a fifth of its time.

    Right to 1e-13·Σ|w| (both are: what rounding leaves of 1 − u·c). A row of zeros adds nothing. Reassociation is
    allowed here so that the sum runs in lanes; NaN and infinity keep their meaning.
    """
    total = 0.0
    for j in range(weights.shape[0]):
        h = min((1.0 - (ux * cx[j] + uy * cy[j] + uz * cz[j])) * inverse_extents[j], 1.0)
        t = 2.0 * h - 1.0
        t2 = t * t
        t4 = t2 * t2
        low = ((_P0 + _P1 * t) + (_P2 + _P3 * t) * t2) + ((_P4 + _P5 * t) + (_P6 + _P7 * t) * t2) * t4
        root = low + ((_P8 + _P9 * t) + (_P10 + _P11 * t) * t2) * (t4 * t4)
        quarter = root * root
        rest = 1.0 - h
        total += weights[j] * (quarter * quarter * _MIDDLE * (rest * rest))
    return total


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def gaussian_jet(cx, cy, cz, inverse_extents, weights, ux, uy, uz):
    """Return (s, ∂s/∂x, ∂s/∂y, ∂s/∂z) of a unit direction over rows of centres, the sum continued off the sphere.

    With τ = u·c, ∂(wλ)/∂τ = w e^(−4h) (1 − h)(6 − 4h)/(1 − cos σ).
    """
    total = fx = fy = fz = 0.0
    for j in range(weights.shape[0]):
        h = min((1.0 - (ux * cx[j] + uy * cy[j] + uz * cz[j])) * inverse_extents[j], 1.0)
        t = 2.0 * h - 1.0
        t2 = t * t
        t4 = t2 * t2
        low = ((_P0 + _P1 * t) + (_P2 + _P3 * t) * t2) + ((_P4 + _P5 * t) + (_P6 + _P7 * t) * t2) * t4
        root = low + ((_P8 + _P9 * t) + (_P10 + _P11 * t) * t2) * (t4 * t4)
        quarter = root * root
        rest = 1.0 - h
        e = weights[j] * (quarter * quarter * _MIDDLE) * rest
        total += e * rest
        e *= inverse_extents[j] * (4.0 * rest + 2.0)
        fx += e * cx[j]
        fy += e * cy[j]
        fz += e * cz[j]
    return total, fx, fy, fz


@njit(cache=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def gaussian_bend(cm, ca, cb, inverse_extents, weights, um, ua, ub, q):
    """Return (s, s_a, s_b, s_aa, s_ab, s_bb) in a face's chart, of the unit direction u = q·(m, a, b).

    cm, ca, cb: (n,) the centres' coordinates along the face's major axis and along a and b. With τ = u·c:
    τ_a = q (c_a − τ u_a), τ_aa = −q (2 τ_a u_a + τ q (1 − u_a²)), τ_ab = −q (τ_b u_a + τ_a u_b − τ q u_a u_b).
    """
    total = first_a = first_b = aa = ab = bb = along = 0.0
    for j in range(weights.shape[0]):
        tau = um * cm[j] + ua * ca[j] + ub * cb[j]
        h = min((1.0 - tau) * inverse_extents[j], 1.0)
        t = 2.0 * h - 1.0
        t2 = t * t
        t4 = t2 * t2
        low = ((_P0 + _P1 * t) + (_P2 + _P3 * t) * t2) + ((_P4 + _P5 * t) + (_P6 + _P7 * t) * t2) * t4
        root = low + ((_P8 + _P9 * t) + (_P10 + _P11 * t) * t2) * (t4 * t4)
        quarter = root * root
        rest = 1.0 - h
        e = weights[j] * (quarter * quarter * _MIDDLE)
        total += e * rest * rest
        e *= inverse_extents[j]
        e1 = e * rest * (4.0 * rest + 2.0)
        # Beyond the border (h = 1) λ is 0, with all its derivatives.
        e2 = (e if h < 1.0 else 0.0) * inverse_extents[j] * ((16.0 * rest + 16.0) * rest + 2.0)
        ta, tb = q * (ca[j] - tau * ua), q * (cb[j] - tau * ub)
        first_a += e1 * ta
        first_b += e1 * tb
        along += e1 * tau
        aa += e2 * ta * ta
        ab += e2 * ta * tb
        bb += e2 * tb * tb
    aa -= q * (2.0 * first_a * ua + along * q * (1.0 - ua * ua))
    bb -= q * (2.0 * first_b * ub + along * q * (1.0 - ub * ub))
    ab -= q * (first_b * ua + first_a * ub - along * q * ua * ub)
    return total, first_a, first_b, aa, ab, bb
