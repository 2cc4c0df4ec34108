"""The scale field over a rectangle of directions: derivatives at the centre, and proven bounds of what they leave."""

import math

from hhsr.kernels.layout import BLOCK_DATA, BLOCK_ROWS, BLOCKS
from hhsr.kernels.third import cubic_norm
from hhsr.kernels.unmanaged import unmanaged

BORDER = math.exp(-4.0)


@unmanaged
def scale_range(blob, ints, leaf, block, face, x, y, z, a, b, half_a, half_b):
    """Return (s, s_a, s_b, wide_a, wide_b, s_aa, s_ab, s_bb, rest2, rest3, s_aaa, s_aab, s_abb, s_bbb, border3, rest4)
    of the scale field over a rectangle about (a, b) of a face; (x, y, z): the direction of its centre.

    Values at its centre; over it the gradient stays within ± wide_a, ± wide_b. Along any line the second derivative is
    that of the Hessian to rest2 + r·rest3 at r from the centre, and, but for what rest2 holds, its change along the
    line that of (s_aaa, …) to border3 + r·rest4.

    Value, gradient, Hessian and third derivative at the centre; what is left of the second derivative is at most r²/2
    times the fourth along any line of the chart. Centres whose support ends in the rectangle have no fourth: there r
    times the third counts, and of supports that the rectangle only touches the second; at the border of a support the
    second derivative jumps by no more than 2 e⁻⁴ times its scale. Bounds add up centre by centre, but the exact third
    derivatives cancel (a fifth of their bounds' sum and less). A chart line is a great circle run at speeds α′ ≤ 1/L,
    |α″| ≤ 0.65/L², |α‴| ≤ 2/L³, |α⁗| ≤ 4.7/L⁴ (L the least |dir|). The derivatives of λ fall with h, so that all bounds
    are closed forms at the nearest point.
    """
    length = math.sqrt(x * x + y * y + z * z)
    ux, uy, uz = x / length, y / length, z / length
    near_a, near_b = max(abs(a) - half_a, 0.0), max(abs(b) - half_b, 0.0)
    speed = 1.0 / math.sqrt(1.0 + near_a * near_a + near_b * near_b)
    r = math.sqrt(half_a * half_a + half_b * half_b)
    delta = r * speed * 1.000001 + 1e-12
    cos_delta, sin_delta = math.cos(delta), math.sin(delta)
    q1 = 1.0 / length
    q3 = q1 * q1 * q1
    q5 = q3 * q1 * q1
    # Derivatives of 1/|dir|.
    laa, lab, lbb = 3.0 * a * a * q5 - q3, 3.0 * a * b * q5, 3.0 * b * b * q5 - q3
    five = 5.0 * q1 * q1
    laaa, laab = 3.0 * a * q5 * (3.0 - a * a * five), 3.0 * b * q5 * (1.0 - a * a * five)
    labb, lbbb = 3.0 * a * q5 * (1.0 - b * b * five), 3.0 * b * q5 * (3.0 - b * b * five)
    value = ga = gb = haa = hab = hbb = 0.0
    taaa = taab = tabb = tbbb = 0.0
    rest2 = rest3 = border3 = rest4 = 0.0
    start = ints[leaf + BLOCKS] + block
    first = ints[leaf + BLOCK_DATA] + ints[start]
    n = (ints[start + 1] - ints[start]) // BLOCK_ROWS
    for o in range(first, first + n):
        cx, cy, cz, inverse, w = blob[o], blob[o + n], blob[o + 2 * n], blob[o + 3 * n], blob[o + 4 * n]
        if inverse == 0.0:
            break
        tau = ux * cx + uy * cy + uz * cz
        sine = math.sqrt(max(1.0 - tau * tau, 0.0)) + 2e-8  # what rounding can hide near τ = 1
        top = 1.0 if tau >= cos_delta else tau * cos_delta + sine * sin_delta
        h_lo = max((1.0 - top) * inverse, 0.0)
        if h_lo >= 1.0:
            continue
        bottom = tau * cos_delta - sine * sin_delta if tau > -cos_delta else -1.0
        h = (1.0 - tau) * inverse
        beyond = (1.0 - bottom) * inverse - 1.0  # how far past the border of the support the rectangle reaches
        inside = h < 1.0 and beyond <= 1.0
        far = min(sine + delta, 1.0)
        k = 1.0 - h_lo
        e = math.exp(-4.0 * h_lo)
        d1 = inverse * e * k * (4.0 * k + 2.0)
        d2 = inverse * inverse * e * (16.0 * k * k + 16.0 * k + 2.0)
        # Along a great circle τ″ = −τ: with λ as a function of τ, its second derivative is λ″ τ′² − λ′ τ and its third
        # τ′ (λ‴ τ′² − 3 λ″ τ − λ′), all λ's positive, 0 ≤ τ′² ≤ sin²: terms of opposite sign do not add up.
        if inside:
            if beyond > 0.0:
                d1 += 0.0022 * inverse  # the greatest |dλ/dh| of the continuation past the border
            d3 = inverse * inverse * inverse * e * (64.0 * k * k + 96.0 * k + 24.0)
            low = 0.0
            if beyond <= 0.0 and bottom > 0.0:
                k = -beyond
                e = math.exp(-4.0 * (1.0 - k))
                low = bottom * 3.0 * inverse * inverse * e * (16.0 * k * k + 16.0 * k + 2.0)
            elif beyond > 0.0:
                low = -6.0 * inverse * inverse * BORDER - 0.0022 * inverse
            third = far * max(d3 * far * far - low, 3.0 * d2 + d1)
            second = max(d2 * far * far, d1) + (2.0 * BORDER * inverse * inverse * far * far if beyond > 0.0 else 0.0)
            all3 = abs(w) * (third + 3.0 * second + 2.0 * d1 * far)
            rest3 += all3
            if beyond <= 0.0:
                d4 = inverse * inverse * inverse * inverse * e * (256.0 * k * k + 512.0 * k + 192.0)
                fourth = max(d4 * far * far * far * far + 3.0 * d2, (6.0 * d3 + 4.0 * d2) * far * far) + d1
                rest4 += abs(w) * (fourth + 4.0 * third + 9.5 * second + 5.0 * d1 * far)
            else:  # past the border λ is 0, not its own continuation, whose derivatives are small there
                border3 += all3
                rest2 += abs(w) * inverse * 2.0 * BORDER * (inverse * far * far + 2.0 * beyond)
        else:
            rest2 += abs(w) * (max(d2 * far * far, d1) + d1 * far)
        if h < 1.0:
            if face < 2:
                ca, cb = cy, cz
            elif face < 4:
                ca, cb = cz, cx
            else:
                ca, cb = cx, cy
            k = 1.0 - h
            e = math.exp(-4.0 * h)
            value += w * (e * k * k)
            ta = (ca - tau * a * q1) * q1
            tb = (cb - tau * b * q1) * q1
            first = w * inverse * e * k * (4.0 * k + 2.0)  # −w·Λ'·inverse = ∂(wλ)/∂τ
            ga += first * ta
            gb += first * tb
            if inside:
                second = w * inverse * inverse * e * (16.0 * k * k + 16.0 * k + 2.0)
                dot = tau * length
                sa, sb = dot * laa - 2.0 * ca * a * q3, dot * lbb - 2.0 * cb * b * q3
                sab = dot * lab - (ca * b + cb * a) * q3
                haa += second * ta * ta + first * sa
                hbb += second * tb * tb + first * sb
                hab += second * ta * tb + first * sab
                if beyond <= 0.0:
                    cube = w * inverse * inverse * inverse * e * (64.0 * k * k + 96.0 * k + 24.0)
                    taaa += (cube * ta * ta + 3.0 * second * sa) * ta + first * (dot * laaa + 3.0 * ca * laa)
                    tbbb += (cube * tb * tb + 3.0 * second * sb) * tb + first * (dot * lbbb + 3.0 * cb * lbb)
                    taab += (cube * ta * ta + second * sa) * tb + 2.0 * second * sab * ta
                    taab += first * (dot * laab + 2.0 * ca * lab + cb * laa)
                    tabb += (cube * tb * tb + second * sb) * ta + 2.0 * second * sab * tb
                    tabb += first * (dot * labb + 2.0 * cb * lab + ca * lbb)
    rest2 *= speed * speed
    border3 *= speed * speed * speed
    rest4 *= speed * speed * speed * speed
    rest3 = min(rest3 * speed * speed * speed, cubic_norm(taaa, taab, tabb, tbbb) + border3 + 0.5 * r * rest4)
    rest = 0.5 * r * r * rest3 + r * rest2
    wide_a = abs(haa) * half_a + abs(hab) * half_b + rest
    wide_b = abs(hab) * half_a + abs(hbb) * half_b + rest
    return (
        value, ga, gb, wide_a, wide_b, haa, hab, hbb, rest2, rest3, taaa, taab, tabb, tbbb, border3, rest4,
    )  # fmt: skip
