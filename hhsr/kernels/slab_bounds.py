"""Proven ranges and linear models of a lobe's radius r(α, t) over pieces of angle and height (DESIGN §2, §4)."""

import math

import numpy as np

from hhsr.kernels.contour_bounds import contour_bend, contour_jet, contour_range
from hhsr.kernels.interval import SLACK
from hhsr.kernels.slab import ENCLOSURE, LOBE_SPHERES, LOBE_TABLES, SLAB_FRAME, TABLE
from hhsr.kernels.unmanaged import entry, unmanaged

STEP = 2.0 * math.pi / TABLE
ARCS = 4  # of a segment of the tables, each with its own bound of the bend


@unmanaged
def lobe_model(blob, ints, lobe, segment, angle, t, half, half_t):
    """Return (r, r_α, r_t, error, lo, hi): r within ± error of its linear model over angle ± half, t ± half_t.

    The piece lies in one segment of the tables and t ± half_t in [0, 1]. r may be negative here: no solid then.
    """
    most = blob[ints[lobe + LOBE_SPHERES] + ENCLOSURE * segment + 6]
    if most < math.inf:
        middle, slope = contour_jet(blob, ints, lobe, angle)
        stray = 0.5 * most * half * half
    else:
        middle, _, _, d_lo, d_hi = contour_range(blob, ints, lobe, angle, half)
        slope, stray = 0.5 * (d_lo + d_hi), 0.5 * (d_hi - d_lo) * half
    o = ints[lobe + LOBE_TABLES] + 2 + segment
    x = (angle + math.pi) / STEP - segment
    left_slope, right_slope = (blob[o + 1] - blob[o]) / STEP, (blob[o + TABLE + 2] - blob[o + TABLE + 1]) / STEP
    left, right = blob[o] + x * left_slope * STEP, blob[o + TABLE + 1] + x * right_slope * STEP
    # r = L (1−t)(1−2t) + 4 t (1−t) C + R t (2t−1), with L and R linear in the angle, and C within `stray` of it: r is a
    # quadratic in t, whose three numbers are linear in the angle. What is not in the model is its bend, its twist and
    # the contour's stray. (By each term's own range the error would be some hundred times this: they cancel.)
    u = 1.0 - t
    wl, wc, wr = u * (1.0 - 2.0 * t), 4.0 * t * u, t * (2.0 * t - 1.0)
    value, slope_a = wl * left + wc * middle + wr * right, wl * left_slope + wc * slope + wr * right_slope
    vl, vc, vr = 4.0 * t - 3.0, 4.0 - 8.0 * t, 4.0 * t - 1.0
    slope_t, twist = vl * left + vc * middle + vr * right, vl * left_slope + vc * slope + vr * right_slope
    bend, turn = 4.0 * (left - 2.0 * middle + right), 4.0 * (left_slope - 2.0 * slope + right_slope)
    away = max(abs(t - 0.5) - half_t, 0.0)
    error = (
        0.5 * abs(bend) * half_t * half_t
        + (abs(twist) + 0.5 * abs(turn) * half_t) * half_t * half
        + (1.0 - 4.0 * away * away) * stray
        + SLACK * (abs(left) + abs(right) + middle + (abs(left_slope) + abs(right_slope) + abs(slope)) * half)
    )
    reach = abs(slope_a) * half + abs(slope_t) * half_t + error
    return value, slope_a, slope_t, error, value - reach, value + reach


@unmanaged
def lobe_range(blob, ints, lobe, angle0, angle1, t0, t1):
    """Return the range of r over [angle0, angle1] (within [−π, π], spanning few segments) and [t0, t1]."""
    lo, hi = 1e300, -1e300
    first = min(max(int((angle0 + math.pi) / STEP - 1e-9), 0), TABLE - 1)
    last = min(max(int((angle1 + math.pi) / STEP + 1e-9), 0), TABLE - 1)
    for segment in range(first, last + 1):
        a0 = max(angle0, segment * STEP - math.pi)
        a1 = min(angle1, (segment + 1) * STEP - math.pi)
        half = max(0.5 * (a1 - a0), 0.0) + 1e-12
        _, _, _, _, low, high = lobe_model(
            blob, ints, lobe, segment, 0.5 * (a0 + a1), 0.5 * (t0 + t1), half, 0.5 * (t1 - t0)
        )
        lo, hi = min(lo, low), max(hi, high)
    return lo, hi


@entry
def fill_lobe_spheres(blob, ints, slab, lobe, spheres):
    """Fill (TABLE, ENCLOSURE), which the blob holds at the lobe's: sphere of each segment's strip (tree frame) 4, least
    and greatest r, bound of |C''|.
    """
    f = ints[slab + SLAB_FRAME]
    d = blob[f + 10]
    o = ints[lobe + LOBE_TABLES]
    for segment in range(TABLE):  # first, for what follows reads it
        spheres[segment, 6] = 0.0
        for arc in range(ARCS):
            angle = (segment + (arc + 0.5) / ARCS) * STEP - math.pi
            most = contour_bend(blob, ints, lobe, angle, 0.5 * STEP / ARCS * (1.0 + 1e-9))
            spheres[segment, 6] = max(spheres[segment, 6], most)
    for segment in range(TABLE):
        lo, hi = 1e300, -1e300
        angle = (segment + 0.5) * STEP - math.pi
        for k in range(8):
            _, _, _, _, low, high = lobe_model(
                blob, ints, lobe, segment, angle, (k + 0.5) / 8.0, 0.5 * STEP * (1.0 + 1e-12), 1.0 / 16.0
            )
            lo, hi = min(lo, low), max(hi, high)
        lo, hi = max(lo, 0.0), max(hi, 0.0)
        r = 0.5 * (lo + hi)
        u, v = blob[o] + r * math.cos(angle), blob[o + 1] + r * math.sin(angle)
        for k in range(3):
            spheres[segment, k] = u * blob[f + k] + v * blob[f + 3 + k] + blob[f + 9] * blob[f + 6 + k]
        spheres[segment, 3] = math.sqrt(
            (0.5 * (hi - lo) + hi * STEP * STEP / 8.0) ** 2 + (0.5 * hi * STEP) ** 2 + d * d
        )
        spheres[segment, 4], spheres[segment, 5] = lo, hi


@unmanaged
def lobe_limits(blob, ints, lobe):
    """Return the least and the greatest r of a lobe."""
    o = ints[lobe + LOBE_SPHERES]
    lo, hi = np.inf, 0.0
    for segment in range(TABLE):
        lo, hi = min(lo, blob[o + ENCLOSURE * segment + 4]), max(hi, blob[o + ENCLOSURE * segment + 5])
    return lo, hi
