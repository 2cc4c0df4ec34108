"""Exact W and its derivatives at one direction: what a proof starts from."""

import math

from hhsr.kernels.cell import axis_scale, block_of, centres_of, is_ellipsoid
from hhsr.kernels.cell_bends import norm_jet
from hhsr.kernels.field_sums import field_bend, field_slopes
from hhsr.kernels.layout import HALF_AXES
from hhsr.kernels.leaf import MAX_SCALE
from hhsr.kernels.unmanaged import inlined


@inlined
def _norm_jet(blob, ints, leaf, face, a, b):
    """Return (N, N_a, N_b, N_aa, N_ab, N_bb); infinite or NaN where there is no second derivative."""
    if not is_ellipsoid(ints, leaf):
        return norm_jet(blob, ints, leaf, face, a, b)
    h, k = ints[leaf + HALF_AXES], face // 2
    cm = axis_scale(blob, h, 2 * k, 1.0 if face % 2 == 0 else -1.0)
    ca, cb = axis_scale(blob, h, 2 * ((k + 1) % 3), a), axis_scale(blob, h, 2 * ((k + 2) % 3), b)
    norm = math.sqrt(cm + ca * a * a + cb * b * b)
    n_a, n_b = ca * a / norm, cb * b / norm
    return norm, n_a, n_b, (ca - n_a * n_a) / norm, -n_a * n_b / norm, (cb - n_b * n_b) / norm


@inlined
def inverse_radius_jet(blob, ints, leaf, face, a, b):
    """Return (W, ∂W/∂a, ∂W/∂b) at (a, b) by the exact formulas; W is 0 where the scale field is capped, or a
    second derivative infinite.
    """
    q = 1.0 / math.sqrt(1.0 + a * a + b * b)
    o, n = centres_of(ints, leaf, block_of(face, a, b))
    s, s_a, s_b = field_slopes(blob, o, n, face // 2, q if face % 2 == 0 else -q, q * a, q * b, q)
    if s >= MAX_SCALE:
        return 0.0, 0.0, 0.0
    norm, n_a, n_b, n_aa, n_ab, n_bb = _norm_jet(blob, ints, leaf, face, a, b)
    if not abs(n_aa) + abs(n_ab) + abs(n_bb) < math.inf:
        return 0.0, 0.0, 0.0
    d = 1.0 / (1.0 - s)
    w = norm * d
    return w, d * (n_a + w * s_a), d * (n_b + w * s_b)


@inlined
def inverse_radius_bend(blob, ints, leaf, face, a, b):
    """Return (W, W_a, W_b, W_aa, W_ab, W_bb) at (a, b) by the exact formulas; W is 0 where that of its jet is."""
    q = 1.0 / math.sqrt(1.0 + a * a + b * b)
    o, n = centres_of(ints, leaf, block_of(face, a, b))
    s, s_a, s_b, s_aa, s_ab, s_bb = field_bend(
        blob, o, n, face // 2, q if face % 2 == 0 else -q, q * a, q * b, q
    )  # fmt: skip
    if s >= MAX_SCALE:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    norm, n_a, n_b, n_aa, n_ab, n_bb = _norm_jet(blob, ints, leaf, face, a, b)
    if not abs(n_aa) + abs(n_ab) + abs(n_bb) < math.inf:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    d = 1.0 / (1.0 - s)
    w = norm * d
    w_a, w_b = d * (n_a + w * s_a), d * (n_b + w * s_b)
    w_aa = d * (n_aa + 2.0 * w_a * s_a + w * s_aa)
    w_ab = d * (n_ab + w_a * s_b + w_b * s_a + w * s_ab)
    w_bb = d * (n_bb + 2.0 * w_b * s_b + w * s_bb)
    return w, w_a, w_b, w_aa, w_ab, w_bb
