"""Where a segment crosses the surface of one model leaf: recursive bisection with proofs (PAPER §2.2, DESIGN §4).

On one face of the cube of directions a segment is a straight line in (a, b, w = 1/m), and the surface the height field
W(a, b). A piece is settled only by proof: w beyond the range of W, beyond a cell's linear model by more than its error,
or monotone against it, and then one bracketed solve on the exact formula. Pieces shorter than the resolution that no
bound settles are settled by their ends.
"""

import math

import numpy as np

from hhsr.kernels.cell import cell_model, chart_of, inverse_radius
from hhsr.kernels.jet import inverse_radius_jet
from hhsr.kernels.layout import (
    BOX,
    CELLS,
    ERROR,
    PARTING,
    RANGE_TABLE,
    SLOPE_A,
    SLOPE_B,
    VALUE,
)
from hhsr.kernels.maps import bend_over, cell_at, level_start, spreads_of
from hhsr.kernels.solve import share_to_t, solve_in_cell
from hhsr.kernels.unmanaged import managed, unmanaged

PIECES = 64  # depth of the bisection
UNDECIDED = 2


@unmanaged
def emit(state, new, t, out, count):
    """Record a change of state at t; return (state, count). A count above out.size says how much room is needed."""
    if state != new:
        if count < out.shape[0]:
            out[count] = t
        return new, count + 1
    return state, count


@unmanaged
def clip_to_box(box_lo, box_hi, p, d, t0, t1):
    """Return the interval of t in [t0, t1] in which one coordinate p + t·d lies in [lo, hi]."""
    if d == 0.0:
        if p < box_lo or p > box_hi:
            return 1.0, 0.0
        return t0, t1
    a, b = (box_lo - p) / d, (box_hi - p) / d
    if a > b:
        a, b = b, a
    return max(t0, a), min(t1, b)


@unmanaged
def _range_of(tab, ints, leaf, face, side, i0, i1, j0, j1):
    """Return (lo, hi) of W over pyramid nodes i0 … i1, j0 … j1 of a level."""
    lo, hi = np.float32(1e30), np.float32(0.0)
    base = ints[leaf + RANGE_TABLE] + 2 * (level_start(ints[leaf + CELLS], side) + face * side * side)
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            o = base + 2 * (i * side + j)
            lo, hi = min(lo, tab[o]), max(hi, tab[o + 1])
    return lo, hi


@unmanaged
def _index(x, side):
    return min(max(int((x + 1.0) * 0.5 * side), 0), side - 1)


@unmanaged
def _border(a0, b0, a1, b1, side):
    """Return the share at which a piece meets the middle one of the cell borders in it; −1 within one cell."""
    i0, i1 = _index(a0, side), _index(a1, side)
    if i0 != i1:
        x = ((2.0 * ((i0 + i1 + 1) // 2) / side - 1.0) - a0) / (a1 - a0)
        if 1e-9 < x < 1.0 - 1e-9:
            return x
    j0, j1 = _index(b0, side), _index(b1, side)
    if j0 != j1:
        x = ((2.0 * ((j0 + j1 + 1) // 2) / side - 1.0) - b0) / (b1 - b0)
        if 1e-9 < x < 1.0 - 1e-9:
            return x
    return -1.0


@managed
def leaf_crossings(
    blob, ints, tab, leaf, px, py, pz, dx, dy, dz, t0, t1, resolution, tolerance, state, out, count, work
):
    """Follow p + t·d (leaf's frame) for t in [t0, t1]; return (state, count), having recorded each change of state.

    resolution: mm, below which an unproven piece is settled by its ends. tolerance: mm, of a crossing's place.
    work: (PIECES, 8) scratch.
    """
    box = ints[leaf + BOX]
    slack = 1e-9 * (1.0 + blob[box + 7])
    a, b = t0, t1
    a, b = clip_to_box(blob[box] - slack, blob[box + 3] + slack, px, dx, a, b)
    a, b = clip_to_box(blob[box + 1] - slack, blob[box + 4] + slack, py, dy, a, b)
    a, b = clip_to_box(blob[box + 2] - slack, blob[box + 5] + slack, pz, dz, a, b)
    if not a < b:
        return emit(state, False, t0, out, count)
    if a > t0:
        state, count = emit(state, False, t0, out, count)
    speed = math.sqrt(dx * dx + dy * dy + dz * dz)
    core = blob[box + 6] * (1.0 - 1e-9)
    # Where the segment changes face (x = ±y, …) or passes the cube about the centre that is wholly inside.
    stops = np.empty(14)
    stops[0] = a
    size = 1
    for k in range(6):
        if k == 0:
            p, d = px - py, dx - dy
        elif k == 1:
            p, d = px + py, dx + dy
        elif k == 2:
            p, d = py - pz, dy - dz
        elif k == 3:
            p, d = py + pz, dy + dz
        elif k == 4:
            p, d = pz - px, dz - dx
        else:
            p, d = pz + px, dz + dx
        if d != 0.0:
            t = -p / d
            if a < t < b:
                stops[size] = t
                size += 1
    c0, c1 = clip_to_box(-core, core, px, dx, a, b)
    c0, c1 = clip_to_box(-core, core, py, dy, c0, c1)
    c0, c1 = clip_to_box(-core, core, pz, dz, c0, c1)
    if c0 < c1:
        if c0 > a:
            stops[size] = c0
            size += 1
        if c1 < b:
            stops[size] = c1
            size += 1
    for i in range(2, size):
        t = stops[i]
        j = i - 1
        while j >= 1 and stops[j] > t:
            stops[j + 1] = stops[j]
            j -= 1
        stops[j + 1] = t
    stops[size] = b
    for i in range(size):
        ta, tb = stops[i], stops[i + 1]
        if not ta < tb:
            continue
        t = 0.5 * (ta + tb)
        if c0 < t < c1:
            state, count = emit(state, True, ta, out, count)
            continue
        x, y, z = px + t * dx, py + t * dy, pz + t * dz
        ux, uy, uz = abs(x), abs(y), abs(z)
        if ux >= uy and ux >= uz:
            face = 0 if x >= 0.0 else 1
        elif uy >= uz:
            face = 2 if y >= 0.0 else 3
        else:
            face = 4 if z >= 0.0 else 5
        state, count = face_crossings(
            blob, ints, tab, leaf, face, px, py, pz, dx, dy, dz, ta, tb, speed, resolution, tolerance, state, out,
            count, work,
        )  # fmt: skip
    if b < t1:
        state, count = emit(state, False, b, out, count)
    return state, count


@unmanaged
def face_crossings(
    blob, ints, tab, leaf, face, px, py, pz, dx, dy, dz, ta, tb, speed, resolution, tolerance, state, out, count, work
):
    """Follow p + t·d for t in [ta, tb], all of it over one face: `leaf_crossings`. speed: |d|, mm."""
    n = ints[leaf + CELLS]
    a0, b0, m0 = chart_of(face, px + ta * dx, py + ta * dy, pz + ta * dz)
    a1, b1, m1 = chart_of(face, px + tb * dx, py + tb * dy, pz + tb * dz)
    t0, t1, w0, w1 = ta, tb, 1.0 / m0, 1.0 / m1
    depth = 0
    while True:
        wide = max(abs(a1 - a0), abs(b1 - b0))
        verdict = UNDECIDED
        split = 0.5
        w_lo, w_hi = (w0, w1) if w0 < w1 else (w1, w0)
        side = n
        while side > 1 and wide * side > 2.0:
            side //= 2
        i0, i1 = _index(a0, side), _index(a1, side)
        if i0 > i1:
            i0, i1 = i1, i0
        j0, j1 = _index(b0, side), _index(b1, side)
        if j0 > j1:
            j0, j1 = j1, j0
        lo, hi = _range_of(tab, ints, leaf, face, side, i0, i1, j0, j1)
        if w_lo > hi:
            verdict = 1
        elif w_hi < lo:
            verdict = 0
        elif side == n:
            a, b = 0.5 * (a0 + a1), 0.5 * (b0 + b1)
            half_a, half_b = 0.5 * abs(a1 - a0) + 1e-12, 0.5 * abs(b1 - b0) + 1e-12
            value = ga = gb = 0.0
            bend_lo, bend_hi = bend_over(tab, ints, leaf, face, i0, i1, j0, j1)
            if bend_hi - bend_lo < math.inf:
                value, ga, gb = inverse_radius_jet(blob, ints, leaf, face, a, b)
            if value > 0.0:
                # The exact jet at the middle, and how far its bend lets W stray from it on the piece.
                far2 = half_a * half_a + half_b * half_b
                up, down = 0.5 * far2 * max(bend_hi, 0.0), 0.5 * far2 * min(bend_lo, 0.0)
                stray = max(bend_hi, -bend_lo) * math.sqrt(far2)
                verdict, state, count = _settle(
                    blob, ints, leaf, face, t0, a0, b0, w0, t1, a1, b1, w1,
                    a, b, value + 0.5 * (up + down), ga, gb, 0.5 * (up - down) + 1e-12 * value, stray, stray,
                    True, speed, resolution, tolerance, state, out, count,
                )  # fmt: skip
            else:
                # No jets: settle one cell at a time, parting the piece at their borders, the middle one first.
                split = _border(a0, b0, a1, b1, n)
                if split < 0.0:
                    word = ints[ints[leaf + PARTING] + (face * n + _index(a, n)) * n + _index(b, n)]
                    split = _border(a0, b0, a1, b1, n << (word & 7))
                if split < 0.0:
                    split = 0.5
                    o, ca, cb, half = cell_at(ints, leaf, face, a, b)
                    sa, sb = spreads_of(tab, o, half)
                    verdict, state, count = _settle(
                        blob, ints, leaf, face, t0, a0, b0, w0, t1, a1, b1, w1,
                        ca, cb, tab[o + VALUE], tab[o + SLOPE_A], tab[o + SLOPE_B], tab[o + ERROR], sa, sb,
                        False, speed, resolution, tolerance, state, out, count,
                    )  # fmt: skip
                    if verdict == UNDECIDED:
                        value, ga, gb, error, sa, sb = cell_model(
                            blob, ints, leaf, face, a, b, half_a, half_b, np.bool_(False)
                        )[:6]
                        verdict, state, count = _settle(
                            blob, ints, leaf, face, t0, a0, b0, w0, t1, a1, b1, w1,
                            a, b, value, ga, gb, error, sa, sb, True, speed, resolution, tolerance, state, out, count,
                        )  # fmt: skip
        if verdict == UNDECIDED and depth < PIECES:
            a, b, w = a0 + split * (a1 - a0), b0 + split * (b1 - b0), w0 + split * (w1 - w0)
            t = share_to_t(split, t0, t1, w0, w1)
            work[depth, 0], work[depth, 1], work[depth, 2], work[depth, 3] = t, a, b, w
            work[depth, 4], work[depth, 5], work[depth, 6], work[depth, 7] = t1, a1, b1, w1
            depth += 1
            t1, a1, b1, w1 = t, a, b, w
            continue
        if verdict < UNDECIDED:
            state, count = emit(state, verdict == 1, t0, out, count)
        if depth == 0:
            return state, count
        depth -= 1
        t0, a0, b0, w0 = work[depth, 0], work[depth, 1], work[depth, 2], work[depth, 3]
        t1, a1, b1, w1 = work[depth, 4], work[depth, 5], work[depth, 6], work[depth, 7]


@unmanaged
def _settle(
    blob, ints, leaf, face, t0, a0, b0, w0, t1, a1, b1, w1,
    ca, cb, value, ga, gb, error, sa, sb, last, speed, resolution, tolerance, state, out, count,
):  # fmt: skip
    """Settle a piece against a linear model of W that holds along it; return (verdict, state, count).

    verdict: 1 wholly inside, 0 wholly outside, 3 settled with what was recorded, 2 undecided.
    """
    f0 = w0 - (value + ga * (a0 - ca) + gb * (b0 - cb))
    f1 = w1 - (value + ga * (a1 - ca) + gb * (b1 - cb))
    if min(f0, f1) > error:
        return 1, state, count
    if max(f0, f1) < -error:
        return 0, state, count
    rise = f1 - f0
    slope = abs(rise) - (sa * abs(a1 - a0) + sb * abs(b1 - b0))
    # Length of the piece, as if share and t ran evenly times the worst ratio of the two.
    ratio = max(w0, w1) / min(w0, w1)
    length = speed * (t1 - t0) * ratio
    if slope > 1e-9 * (abs(w0) + abs(w1)):
        # Monotone. The model's error bars leave only [x0, x1]; an end inside the piece has a proven sign.
        up = rise > 0.0
        x0 = max((-error - f0) / rise if up else (error - f0) / rise, 0.0)
        x1 = min((error - f0) / rise if up else (-error - f0) / rise, 1.0)
        if x0 > 0.0:
            g0 = -error if up else error
        else:
            x0 = 0.0
            g0 = w0 - inverse_radius(blob, ints, leaf, face, a0, b0)
        if x1 < 1.0:
            g1 = error if up else -error
        else:
            x1 = 1.0
            g1 = w1 - inverse_radius(blob, ints, leaf, face, a1, b1)
        state, count = emit(state, g0 >= 0.0, t0, out, count)
        if (g0 >= 0.0) != (g1 >= 0.0):
            x = solve_in_cell(
                blob, ints, leaf, face, a0, b0, w0, a1, b1, w1, x0, x1, g0, g1, slope, 2.0 * abs(rise) - slope,
                tolerance / max(length, 1e-12),
            )  # fmt: skip
            state, count = emit(state, g1 >= 0.0, share_to_t(x, t0, t1, w0, w1), out, count)
        return 3, state, count
    if last and length <= resolution:
        g0 = w0 - inverse_radius(blob, ints, leaf, face, a0, b0)
        g1 = w1 - inverse_radius(blob, ints, leaf, face, a1, b1)
        state, count = emit(state, g0 >= 0.0, t0, out, count)
        if (g0 >= 0.0) != (g1 >= 0.0):
            x = solve_in_cell(
                blob, ints, leaf, face, a0, b0, w0, a1, b1, w1, 0.0, 1.0, g0, g1, 0.0, math.inf,
                tolerance / max(length, 1e-12),
            )  # fmt: skip
            state, count = emit(state, g1 >= 0.0, share_to_t(x, t0, t1, w0, w1), out, count)
        return 3, state, count
    return UNDECIDED, state, count
