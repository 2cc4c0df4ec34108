"""Exact W and its derivatives at one direction, for leaves whose base is an ellipsoid: what a proof starts from."""

import math

from hhsr.kernels.cell import axis_scale, block_of, direction_of
from hhsr.kernels.layout import AZIMUTH_COUNT, BLOCK_DATA, BLOCK_ROWS, BLOCKS, ELEVATION_COUNT, HALF_AXES
from hhsr.kernels.leaf import MAX_SCALE
from hhsr.kernels.sphere_rbf import gaussian_bend, gaussian_jet
from hhsr.kernels.unmanaged import unmanaged


@unmanaged
def has_jets(ints, leaf):
    """Return whether a leaf's base is an ellipsoid, whose derivatives are closed forms."""
    return ints[leaf + AZIMUTH_COUNT] == 0 and ints[leaf + ELEVATION_COUNT] == 0


@unmanaged
def inverse_radius_jet(blob, ints, leaf, face, a, b):
    """Return (W, ∂W/∂a, ∂W/∂b) at (a, b) by the exact formulas; W is 0 where the scale field is capped: no gradient."""
    x, y, z = direction_of(face, a, b)
    length = math.sqrt(x * x + y * y + z * z)
    ux, uy, uz = x / length, y / length, z / length
    start = ints[leaf + BLOCKS] + block_of(face, a, b)
    o = ints[leaf + BLOCK_DATA] + ints[start]
    n = (ints[start + 1] - ints[start]) // BLOCK_ROWS
    s, fx, fy, fz = gaussian_jet(
        blob[o : o + n], blob[o + n : o + 2 * n], blob[o + 2 * n : o + 3 * n], blob[o + 3 * n : o + 4 * n],
        blob[o + 4 * n : o + 5 * n], ux, uy, uz,
    )  # fmt: skip
    if s >= MAX_SCALE:
        return 0.0, 0.0, 0.0
    h = ints[leaf + HALF_AXES]
    cx, cy, cz = axis_scale(blob, h, 0, x), axis_scale(blob, h, 2, y), axis_scale(blob, h, 4, z)
    norm = math.sqrt(cx * x * x + cy * y * y + cz * z * z)
    along = (fx * ux + fy * uy + fz * uz) / length
    if face < 2:
        fa, fb, na, nb = fy, fz, cy * y, cz * z
    elif face < 4:
        fa, fb, na, nb = fz, fx, cz * z, cx * x
    else:
        fa, fb, na, nb = fx, fy, cx * x, cy * y
    sa, sb = (fa - along * a) / length, (fb - along * b) / length
    d = 1.0 / (1.0 - s)
    w = norm * d
    return w, d * (na / norm + w * sa), d * (nb / norm + w * sb)


@unmanaged
def inverse_radius_bend(blob, ints, leaf, face, a, b):
    """Return (W, W_a, W_b, W_aa, W_ab, W_bb) at (a, b) by the exact formulas; W is 0 where the field is capped."""
    length = math.sqrt(1.0 + a * a + b * b)
    q = 1.0 / length
    start = ints[leaf + BLOCKS] + block_of(face, a, b)
    o = ints[leaf + BLOCK_DATA] + ints[start]
    n = (ints[start + 1] - ints[start]) // BLOCK_ROWS
    k = face // 2
    om, oa, ob = o + n * k, o + n * ((k + 1) % 3), o + n * ((k + 2) % 3)
    s, s_a, s_b, s_aa, s_ab, s_bb = gaussian_bend(
        blob[om : om + n], blob[oa : oa + n], blob[ob : ob + n], blob[o + 3 * n : o + 4 * n],
        blob[o + 4 * n : o + 5 * n], q if face % 2 == 0 else -q, q * a, q * b, q,
    )  # fmt: skip
    if s >= MAX_SCALE:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    h = ints[leaf + HALF_AXES]
    cm = axis_scale(blob, h, 2 * k, 1.0 if face % 2 == 0 else -1.0)
    ca, cb = axis_scale(blob, h, 2 * ((k + 1) % 3), a), axis_scale(blob, h, 2 * ((k + 2) % 3), b)
    norm = math.sqrt(cm + ca * a * a + cb * b * b)
    n_a, n_b = ca * a / norm, cb * b / norm
    d = 1.0 / (1.0 - s)
    w = norm * d
    w_a, w_b = d * (n_a + w * s_a), d * (n_b + w * s_b)
    w_aa = d * ((ca - n_a * n_a) / norm + 2.0 * w_a * s_a + w * s_aa)
    w_ab = d * (-n_a * n_b / norm + w_a * s_b + w_b * s_a + w * s_ab)
    w_bb = d * ((cb - n_b * n_b) / norm + 2.0 * w_b * s_b + w * s_bb)
    return w, w_a, w_b, w_aa, w_ab, w_bb
