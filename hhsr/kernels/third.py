"""The third derivative of W = N·D, D = 1/(1 − s), over a rectangle of directions: what a cell's quadratic leaves.

Bounds of its terms add up where the terms themselves cancel: the exact one at the centre, and a bound of the fourth for
the way from there, is a third and less of a bound of the third alone.
"""

import math

from hhsr.kernels.unmanaged import unmanaged


@unmanaged
def cubic_norm(aaa, aab, abb, bbb):
    """Return a bound of a cubic form over unit vectors: along (cos θ, sin θ) it is one wave of θ and one of 3θ."""
    return 0.75 * math.hypot(aaa + abb, bbb + aab) + 0.25 * math.hypot(aaa - 3.0 * abb, 3.0 * aab - bbb)


@unmanaged
def third_over(
    n, na, nb, scale_a, scale_b, d0, sa, sb, saa, sab, sbb, saaa, saab, sabb, sbbb,
    n_lo, n_hi, n1, n2, d, s1, s2, rest2, rest3, border3, rest4, r,
):  # fmt: skip
    """Return a bound, for every ρ ≤ r, of |∂²W(x) − ∂²W(c)|/ρ at ρ from the centre c, but for what rest2 holds.

    At the centre: N, its slopes and its half axes' 1/A² along a and b, D, the derivatives of s. Over the rectangle:
    n_lo ≤ N ≤ n_hi; bounds n1, n2 of N′, N″, d of D, s1, s2, rest3 of s′, s″, s‴ along any line; rest2, border3, rest4
    as `hhsr.kernels.scale_range` gives them.

    N² is quadratic, so that N·N‴ = −3 N′N″ and N·N⁗ = −4 N′N‴ − 3 N″². Twice the bound holds between any two points.
    """
    d1, d2 = d * d * s1, d * d * (s2 + 2.0 * d * s1 * s1)
    d3 = d * d * (rest3 + 6.0 * d * s1 * (s2 + d * s1 * s1))
    n3 = 3.0 * n1 * n2 / n_lo
    most = n3 * d + 3.0 * n2 * d1 + 3.0 * n1 * d2 + n_hi * d3
    # The exact one at the centre.
    naa, nab, nbb = (scale_a - na * na) / n, -na * nb / n, (scale_b - nb * nb) / n
    dd = d0 * d0
    da, db = dd * sa, dd * sb
    daa, dab = dd * (saa + 2.0 * d0 * sa * sa), dd * (sab + 2.0 * d0 * sa * sb)
    dbb = dd * (sbb + 2.0 * d0 * sb * sb)
    daaa = dd * (saaa + 6.0 * d0 * sa * (saa + d0 * sa * sa))
    dbbb = dd * (sbbb + 6.0 * d0 * sb * (sbb + d0 * sb * sb))
    daab = dd * (saab + 2.0 * d0 * (2.0 * sa * sab + sb * saa) + 6.0 * dd * sa * sa * sb)
    dabb = dd * (sabb + 2.0 * d0 * (2.0 * sb * sab + sa * sbb) + 6.0 * dd * sa * sb * sb)
    aaa = -3.0 * na * naa / n * d0 + 3.0 * (naa * da + na * daa) + n * daaa
    bbb = -3.0 * nb * nbb / n * d0 + 3.0 * (nbb * db + nb * dbb) + n * dbbb
    aab = -(2.0 * na * nab + nb * naa) / n * d0 + naa * db + 2.0 * nab * da + nb * daa + 2.0 * na * dab + n * daab
    abb = -(2.0 * nb * nab + na * nbb) / n * d0 + nbb * da + 2.0 * nab * db + na * dbb + 2.0 * nb * dab + n * dabb
    # What it changes by: jumps of s″ and s‴ where supports end, and r/2 of a bound of the fourth.
    jump = (3.0 * n1 + 6.0 * n_hi * d * s1) * d * d * rest2 + n_hi * d * d * border3
    s3 = min(2.0 * rest3, cubic_norm(saaa, saab, sabb, sbbb) + border3 + r * rest4)  # rest3 is a mean from the centre
    d3 = d * d * (s3 + 6.0 * d * s1 * (s2 + d * s1 * s1))
    n4 = (4.0 * n1 * n3 + 3.0 * n2 * n2) / n_lo
    d4 = d * d * (rest4 + d * (8.0 * s1 * s3 + 6.0 * s2 * s2 + 36.0 * d * s1 * s1 * s2 + 24.0 * d * d * s1**4))
    fourth = n4 * d + 4.0 * n3 * d1 + 6.0 * n2 * d2 + 4.0 * n1 * d3 + n_hi * d4
    return min(most, (cubic_norm(aaa, aab, abb, bbb) + jump + 0.5 * r * fourth) * (1.0 + 1e-9))
