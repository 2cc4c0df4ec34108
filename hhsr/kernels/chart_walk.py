"""A stretch of a segment followed through one leaf's chart, cell by cell: what voxels' planes leave open most often.

A cell is a few times smaller than a voxel, and its model as much nearer to W: nearly every piece in one is proven
inside, outside or monotone by the table alone. Only the crossing itself asks the formulas.
"""

import math

from hhsr.kernels.cell import chart_of, face_of, inverse_radius
from hhsr.kernels.clipped import merge_touches
from hhsr.kernels.layout import ERROR, SLOPE_A, SLOPE_B, VALUE
from hhsr.kernels.maps import cell_at, spreads_of
from hhsr.kernels.segment import face_crossings, leaf_crossings
from hhsr.kernels.solve import share_to_t, solve_in_cell
from hhsr.kernels.stretch import change
from hhsr.kernels.unmanaged import inlined, unmanaged

NUDGE = 1e-11  # of (a, b): past a cell's border, less than models are proven beyond theirs


@inlined
def _reach(way, inverse, start, centre, half):
    """Return the share x at which start + x·way leaves [centre − half, centre + half]; inverse: 1/way."""
    return (centre + math.copysign(half, way) - start) * inverse if way != 0.0 else 2.0


@unmanaged
def follow_cells(
    blob, ints, tab, leaf, px, py, pz, dx, dy, dz, length, begin, end, resolution, tolerance, gap, state, out, count,
    work,
):  # fmt: skip
    """Follow p + t·d (leaf's frame) for t in [begin, end]; return (state, count).

    length: |d|, mm. resolution, tolerance: mm; gap: of t. A stretch over more than one face of the chart, and pieces
    that their cell's model does not settle, are parted by `hhsr.kernels.segment`. work: scratch.
    """
    t = 0.5 * (begin + end)
    face, _, _, _ = face_of(px + t * dx, py + t * dy, pz + t * dz)
    a0, b0, m0 = chart_of(face, px + begin * dx, py + begin * dy, pz + begin * dz)
    a1, b1, m1 = chart_of(face, px + end * dx, py + end * dy, pz + end * dz)
    if not (m0 > 0.0 and m1 > 0.0 and max(max(abs(a0), abs(b0)), max(abs(a1), abs(b1))) <= 1.0):
        state, count = leaf_crossings(
            blob, ints, tab, leaf, px, py, pz, dx, dy, dz, begin, end, resolution, tolerance, state, out, count, work
        )
        return state, merge_touches(out, count, gap)
    w0, w1 = 1.0 / m0, 1.0 / m1
    wa, wb, ww = a1 - a0, b1 - b0, w1 - w0
    # The cell ahead is asked for: on a border the one behind would be left at once, and again and again.
    ahead_a, ahead_b = math.copysign(NUDGE, wa), math.copysign(NUDGE, wb)
    least = NUDGE / max(abs(wa), abs(wb), NUDGE)
    once_a, once_b = (1.0 / wa if wa != 0.0 else 0.0), (1.0 / wb if wb != 0.0 else 0.0)
    # What a tolerance is as a share of the stretch: mm for a share are at most these.
    share = tolerance * min(w0, w1) / (length * (end - begin) * max(w0, w1))
    x = 0.0
    while x < 1.0:
        o, ca, cb, half = cell_at(ints, leaf, face, a0 + x * wa + ahead_a, b0 + x * wb + ahead_b)
        stop = min(_reach(wa, once_a, a0, ca, half), _reach(wb, once_b, b0, cb, half))
        stop = min(max(stop, x + least), 1.0)
        sa, sb, error = float(tab[o + SLOPE_A]), float(tab[o + SLOPE_B]), float(tab[o + ERROR])
        f = w0 - (float(tab[o + VALUE]) + sa * (a0 - ca) + sb * (b0 - cb))
        slope = ww - sa * wa - sb * wb
        f0, f1 = f + x * slope, f + stop * slope
        if min(f0, f1) > error or max(f0, f1) < -error:
            if state != (f0 > 0.0):
                state, count = change(state, f0 > 0.0, share_to_t(x, begin, end, w0, w1), gap, out, count)
            x = stop
            continue
        stray_a, stray_b = spreads_of(tab, o, half)
        stray = stray_a * abs(wa) + stray_b * abs(wb)
        if abs(slope) > stray + 1e-9 * (w0 + w1):
            state, count = _monotone(
                blob, ints, leaf, face, a0, b0, w0, a1, b1, w1, x, stop, f0, f1, slope, stray, error,
                begin, end, share, gap, state, out, count,
            )  # fmt: skip
        else:
            t0, t1 = share_to_t(x, begin, end, w0, w1), share_to_t(stop, begin, end, w0, w1)
            state, count = face_crossings(
                blob, ints, tab, leaf, face, px, py, pz, dx, dy, dz, t0, t1, length, resolution, tolerance, state, out,
                count, work,
            )  # fmt: skip
            count = merge_touches(out, count, gap)
        x = stop
    return state, count


@unmanaged
def _monotone(
    blob, ints, leaf, face, a0, b0, w0, a1, b1, w1, x0, x1, f0, f1, slope, stray, error,
    begin, end, tolerance, gap, state, out, count,
):  # fmt: skip
    """Settle the shares [x0, x1] of a stretch, along which w − W is monotone; return (state, count).

    f0, f1: of its model, right to the error; slope: of its model by the share, right to the stray. tolerance: a share.
    """
    up = slope > 0.0
    # The model's error leaves the crossing only [lo, hi]; an end beyond has a proven sign.
    lo, hi = x0, x1
    if abs(f0) > error:
        lo = x0 + ((-error if up else error) - f0) / slope if (f0 < 0.0) == up else x0
        g0 = -error if f0 < 0.0 else error
    else:
        g0 = w0 + x0 * (w1 - w0) - inverse_radius(blob, ints, leaf, face, a0 + x0 * (a1 - a0), b0 + x0 * (b1 - b0))
    if abs(f1) > error:
        hi = x0 + ((error if up else -error) - f0) / slope if (f1 > 0.0) == up else x1
        g1 = -error if f1 < 0.0 else error
    else:
        g1 = w0 + x1 * (w1 - w0) - inverse_radius(blob, ints, leaf, face, a0 + x1 * (a1 - a0), b0 + x1 * (b1 - b0))
    state, count = change(state, g0 >= 0.0, share_to_t(x0, begin, end, w0, w1), gap, out, count)
    if (g0 >= 0.0) != (g1 >= 0.0):
        x = solve_in_cell(
            blob, ints, leaf, face, a0, b0, w0, a1, b1, w1, lo, hi, g0, g1,
            abs(slope) - stray, abs(slope) + stray, tolerance,
        )  # fmt: skip
        state, count = change(state, g1 >= 0.0, share_to_t(x, begin, end, w0, w1), gap, out, count)
    return state, count
