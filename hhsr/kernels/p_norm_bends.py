"""Proven ranges of a p-norm's second derivatives, in its exponent too (DESIGN §4).

M = (x^k + y^k)^(1/k) of x, y ≥ 0 has second derivatives in x, y and k that are products of powers of x/M, y/M ≤ 1, of
the weight w = y^k/(x^k + y^k), its entropy and its logit k·ln(y/x): each is monotone, or has a known extreme. So
nothing blows up on coordinate planes but what does: ∂²M/∂y² at y = 0 where k < 2. Ranges are pairs (lo, hi).
"""

import math

from hhsr.kernels.interval import inverse, plus, scaled, squared, times
from hhsr.kernels.superquadric import p_norm
from hhsr.kernels.unmanaged import unmanaged

LN2 = math.log(2.0)
PEAK_T, PEAK = 2.3993572805154, 0.4392288439  # where t²·w(1 − w) of a logit ±t is greatest, and how great
DIP_T, DIP = -1.2784645427611, -0.2784645428  # where w·t is least, and how small
FARTHEST = 700.0  # a logit beyond which a weight is 0 or 1


@unmanaged
def _of_logit(t):
    """Return (w, 1 − w, −w ln w − (1 − w) ln(1 − w), t²·w(1 − w)) of the weight w of a logit t."""
    if abs(t) > FARTHEST:
        return (1.0, 0.0, 0.0, 0.0) if t > 0.0 else (0.0, 1.0, 0.0, 0.0)
    e = math.exp(-abs(t))
    large, small = 1.0 / (1.0 + e), e / (1.0 + e)
    entropy, spread = math.log1p(e) + abs(t) * small, t * t * large * small
    return (large, small, entropy, spread) if t > 0.0 else (small, large, entropy, spread)


@unmanaged
def _log_share(d, k):
    """Return ln(x/M) = −ln(1 + (y/x)^k)/k, d = ln(y/x)."""
    t = k * d
    return -d - math.log1p(math.exp(-t)) / k if t > 0.0 else -math.log1p(math.exp(t)) / k


@unmanaged
def _log_shares(d0, d1, k):
    """Return the range of ln(x/M) over d0 … d1 and k: it falls in d and grows in k."""
    share = _log_share(d1, k[0])
    return share, (share if d0 == d1 and k[0] == k[1] else _log_share(d0, k[1]))


@unmanaged
def _powers(share, power):
    """Return the range of e^(s·p), s ≤ 0: falling in p, and in s by the sign of p."""
    lo = share[0] if power[1] >= 0.0 else share[1]
    hi = share[1] if power[0] >= 0.0 else share[0]
    least = _power(lo, power[1])
    return least, (least if lo == hi and power[0] == power[1] else _power(hi, power[0]))


@unmanaged
def _power(share, p):
    if p == 0.0:
        return 1.0
    exponent = share * p
    return math.exp(exponent) if exponent < FARTHEST else math.inf


@unmanaged
def _shrunk(t, w, d, k, a):
    """Return the range of A·w·d: A = (x/M)^(k−1) in `a`, w the weight of the logit t = k·d, both as ranges."""
    if d[0] == math.inf or d[1] == -math.inf:  # x or y is 0
        return 0.0, 0.0
    low = w[0] * t[0] if t[0] > -math.inf else 0.0
    high = w[1] * t[1] if t[1] < math.inf else math.inf
    if t[1] < DIP_T:
        low, high = high, low
    elif t[0] <= DIP_T:
        low, high = DIP, max(low, high)
    least = low / k[0] * a[1] if low < 0.0 else low / k[1] * a[0]
    if high <= 0.0:
        return least, high / k[1] * a[0]
    # A ≤ e^−(k−1)d: d times that is greatest at d = 1/(k − 1).
    fall = k[0] - 1.0
    top = min(max(d[0], 1.0 / fall), d[1])
    most = top * math.exp(-fall * top)
    return least, (min(most, high / k[0] * a[1]) if high < math.inf else most)


@unmanaged
def p_norm_bends(x, y, k):
    """Return the ranges (M, M_x, M_y, M_k, M_xx, M_xy, M_yy, M_xk, M_yk, M_kk) over x, y ≥ 0, not both 0, and k > 1."""
    d0 = (math.log(y[0] / x[1]) if x[1] > 0.0 else math.inf) if y[0] > 0.0 else -math.inf
    d1 = (math.log(y[1] / x[0]) if y[1] > 0.0 else -math.inf) if x[0] > 0.0 else math.inf
    t = (d0 * (k[0] if d0 > 0.0 else k[1]), d1 * (k[1] if d1 > 0.0 else k[0]))
    w0, v1, h0, s0 = _of_logit(t[0])
    w1, v0, h1, s1 = _of_logit(t[1]) if t[1] > t[0] else (w0, v1, h0, s0)
    w, v = (w0, w1), (v0, v1)
    share_x, share_y = _log_shares(d0, d1, k), _log_shares(-d1, -d0, k)
    least = p_norm(x[0], y[0], 2.0 / k[1])
    point = x[0] == x[1] and y[0] == y[1] and k[0] == k[1]
    m = (least, least if point else p_norm(x[1], y[1], 2.0 / k[0]))
    less, second = (k[0] - 1.0, k[1] - 1.0), (k[0] - 2.0, k[1] - 2.0)
    a, b = _powers(share_x, less), _powers(share_y, less)
    steep = times(less, inverse(m))
    m_xx = times(steep, times(_powers(share_x, second), w))
    m_yy = times(steep, times(_powers(share_y, second), v))
    m_xy = scaled(times(steep, times(a, b)), -1.0)
    over_k = inverse(k)
    even = t[0] <= 0.0 <= t[1]  # where the entropy is greatest, and the spread 0
    peak = t[0] <= PEAK_T <= t[1] or t[0] <= -PEAK_T <= t[1]
    entropy = (min(h0, h1), LN2 if even else max(h0, h1))
    spread = (0.0 if even else min(s0, s1), PEAK if peak else max(s0, s1))
    h = times(entropy, squared(over_k))
    m_xk = scaled(plus(times(a, h), _shrunk(t, w, (d0, d1), k, a)), -1.0)
    m_yk = scaled(plus(times(b, h), _shrunk((-t[1], -t[0]), v, (-d1, -d0), k, b)), -1.0)
    cube = times(over_k, squared(over_k))
    m_kk = times(m, plus(times(plus(scaled(entropy, 2.0), spread), cube), squared(h)))
    return m, a, b, scaled(times(m, h), -1.0), m_xx, m_xy, m_yy, m_xk, m_yk, m_kk
