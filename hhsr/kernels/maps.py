"""The certified cube map of a leaf: linear models of its cells, and a pyramid of ranges over the base cells.

A face has n² base cells, each parted into 2^k × 2^k cells where the surface needs it. Tables are float32, rounded
outward.
The pyramid holds the levels n, n/2, …, 2, 1 one after another, finest first, each as (face, i, j).
"""

import math

import numpy as np
from numba import njit

from hhsr.kernels.cell import cell_model, direction_of
from hhsr.kernels.layout import (
    BEND_AA,
    BEND_AB,
    BEND_BB,
    BEND_SIZE,
    BEND_TABLE,
    BLOCK_ROWS,
    BLOCKS_PER_SIDE,
    CELL_SIZE,
    CELL_TABLE,
    CELLS,
    ERROR,
    KINK,
    LANES,
    PARTING,
    SLOPE_A,
    SLOPE_B,
    THIRD,
    VALUE,
    integers,
)
from hhsr.kernels.unmanaged import entry, inlined, unmanaged

UP = 1.0 + 3e-7  # more than one float32 rounding
MOST_CELLS = 500  # that one square of directions may meet
STEEP = 1e3  # mm: thickness given to a cell that faces its centre too obliquely to have a tangent plane


@unmanaged
def level_start(cells, side):
    """Return the index of the first pyramid node of the level with `side` base cells a face side."""
    start = 0
    k = cells
    while k > side:
        start += 6 * k * k
        k //= 2
    return start


@unmanaged
def pyramid_size(cells):
    """Return how many nodes the pyramid over `cells`² base cells a face has."""
    return level_start(cells, 1) + 6


@unmanaged
def index_of(x, side):
    """Return the cell, of `side` over [−1, 1], that holds x."""
    return min(max(int((x + 1.0) * 0.5 * side), 0), side - 1)


@inlined
def cell_at(ints, leaf, face, a, b):
    """Return (slot, a, b, half) of the cell that holds (a, b): its float32 slot, its centre and half its side."""
    n = ints[leaf + CELLS]
    u, v = (a + 1.0) * 0.5 * n, (b + 1.0) * 0.5 * n
    i, j = min(max(int(u), 0), n - 1), min(max(int(v), 0), n - 1)
    word = ints[ints[leaf + PARTING] + (face * n + i) * n + j]
    s = 1 << (word & 7)
    p, q = min(max(int((u - i) * s), 0), s - 1), min(max(int((v - j) * s), 0), s - 1)
    half = 1.0 / (n * s)
    slot = ints[leaf + CELL_TABLE] + CELL_SIZE * ((word >> 4) + p * s + q)
    return slot, (2 * (i * s + p) + 1) * half - 1.0, (2 * (j * s + q) + 1) * half - 1.0, half


@inlined
def jet_of(tab, o, half):
    """Return (W, W_a, W_b, W_aa, W_ab, W_bb) at the middle of the cell at a float32 slot, to 2e-7·W; NaN: unknown."""
    aa, ab, bb = np.float64(tab[o + BEND_AA]), np.float64(tab[o + BEND_AB]), np.float64(tab[o + BEND_BB])
    w = np.float64(tab[o + VALUE]) - 0.25 * half * half * (aa + bb)
    return w, np.float64(tab[o + SLOPE_A]), np.float64(tab[o + SLOPE_B]), aa, ab, bb


@inlined
def jet_near(tab, ints, leaf, face, a, b):
    """Return (W, W_a, W_b, W_aa, W_ab, W_bb, error) at (a, b) by the table, the error a bound of W's; NaN: unknown."""
    o, ca, cb, half = cell_at(ints, leaf, face, a, b)
    w, wa, wb, aa, ab, bb = jet_of(tab, o, half)
    if not w > 0.0:
        return w, wa, wb, aa, ab, bb, math.inf
    da, db = a - ca, b - cb
    ra, rb = aa * da + ab * db, ab * da + bb * db
    away2 = da * da + db * db
    error = away2 * (0.5 * np.float64(tab[o + KINK]) + np.float64(tab[o + THIRD]) * math.sqrt(away2) / 6.0)
    w += (wa + 0.5 * ra) * da + (wb + 0.5 * rb) * db
    return w, wa + ra, wb + rb, aa, ab, bb, error + 1e-6 * w


@unmanaged
def bend_over(tab, ints, leaf, face, i0, i1, j0, j1):
    """Return the range of the eigenvalues of ∂²W over base cells i0 … i1, j0 … j1 of a face."""
    n = ints[leaf + CELLS]
    bend_lo, bend_hi = np.inf, -np.inf
    for i in range(i0, i1 + 1):
        for j in range(j0, j1 + 1):
            q = ints[leaf + BEND_TABLE] + BEND_SIZE * ((face * n + i) * n + j)
            bend_lo, bend_hi = min(bend_lo, np.float64(tab[q])), max(bend_hi, np.float64(tab[q + 1]))
    return bend_lo, bend_hi


@unmanaged
def rests_over(tab, ints, leaf, face, a0, a1, b0, b1):
    """Return (kink, third): ∂²W at two points of a rectangle of a face differs by no more than kink + third times their
    distance; infinite where it meets too many cells.
    """
    n = ints[leaf + CELLS]
    kink = third = 0.0
    finest, count = 1, 0
    for i in range(index_of(a0, n), index_of(a1, n) + 1):
        for j in range(index_of(b0, n), index_of(b1, n) + 1):
            word = ints[ints[leaf + PARTING] + (face * n + i) * n + j]
            s = 1 << (word & 7)
            finest = max(finest, s)
            p0, p1 = max(index_of(a0, n * s) - i * s, 0), min(index_of(a1, n * s) - i * s, s - 1)
            q0, q1 = max(index_of(b0, n * s) - j * s, 0), min(index_of(b1, n * s) - j * s, s - 1)
            count += (p1 - p0 + 1) * (q1 - q0 + 1)
            if count > MOST_CELLS:
                return np.inf, np.inf
            for p in range(p0, p1 + 1):
                o = ints[leaf + CELL_TABLE] + CELL_SIZE * ((word >> 4) + p * s)
                for c in range(o + CELL_SIZE * q0, o + CELL_SIZE * q1 + 1, CELL_SIZE):
                    kink, third = max(kink, np.float64(tab[c + KINK])), max(third, np.float64(tab[c + THIRD]))
    side = n * finest
    lines = index_of(a1, side) - index_of(a0, side) + index_of(b1, side) - index_of(b0, side)
    # A cell's are from its own middle: between two other points twice as much. A line passes so many of them.
    return 2.0 * (lines + 1) * kink, 2.0 * third


@unmanaged
def quad_radius_ok(value, slope_a, slope_b, error, half_a, half_b):
    """Return whether the tangent plane of a cell faces the centre safely, so that its corners are points in space."""
    return value - abs(slope_a) * half_a - abs(slope_b) * half_b - error > 0.25 * value


@unmanaged
def plane_of(face, a, b, value, slope_a, slope_b):
    """Return g of the plane g·p = 1 that is a cell's linear model of W in space, leaf frame."""
    c = value - slope_a * a - slope_b * b
    if face % 2 == 1:
        c = -c
    if face < 2:
        return c, slope_a, slope_b
    if face < 4:
        return slope_b, c, slope_a
    return slope_a, slope_b, c


@unmanaged
def cell_corners(face, a, b, half, value, slope_a, slope_b, corners):
    """Fill corners (ROOM, 3)[:4] of a cell's flat quad, leaf frame."""
    for corner in range(4):
        da = half if corner == 1 or corner == 2 else -half
        db = half if corner >= 2 else -half
        x, y, z = direction_of(face, a + da, b + db)
        m = 1.0 / (value + slope_a * da + slope_b * db)
        corners[corner, 0], corners[corner, 1], corners[corner, 2] = x * m, y * m, z * m


@unmanaged
def quad_radius(face, a, b, half, value, slope_a, slope_b):
    """Return a bound of how far (mm) any point of a cell's flat quad lies from dir(a, b)/value.

    With δ = (da, db, 0) and T the model at its end: dir/T − dir₀/value = (δ value − dir₀ (T − value))/(value·T).
    """
    turn = abs(slope_a) + abs(slope_b)
    length = math.sqrt(1.0 + a * a + b * b)
    return half * (1.4142136 * value + length * turn) / (value * (value - turn * half)) * (1.0 + 1e-9)


@unmanaged
def model_thickness(face, a, b, half_a, half_b, value, slope_a, slope_b, error):
    """Return how far (mm) a cell's surface can lie from its plane: m·|W − model|/|g|, m = 1/W ≤ 1/(lowest − error)."""
    gx, gy, gz = plane_of(face, a, b, value, slope_a, slope_b)
    low = value - abs(slope_a) * half_a - abs(slope_b) * half_b
    return error / ((low - error) * math.sqrt(gx * gx + gy * gy + gz * gz)) * (1.0 + 1e-9)


@unmanaged
def ray_thickness(face, a, b, half_a, half_b, value, slope_a, slope_b, error):
    """Return how far (mm) surface and plane of a cell can lie apart along a ray: |dir|·e / (T·(T − e))."""
    reach_a, reach_b = abs(a) + half_a, abs(b) + half_b
    low = value - abs(slope_a) * half_a - abs(slope_b) * half_b
    return math.sqrt(1.0 + reach_a * reach_a + reach_b * reach_b) * error / (low * (low - error)) * (1.0 + 1e-9)


@unmanaged
def cell_sphere(face, a, b, half_a, half_b, value, slope_a, slope_b, error, lo, hi):
    """Return (x, y, z, radius) of a sphere about dir(a, b)/value, leaf frame, that encloses the surface of a cell."""
    flat = quad_radius_ok(value, slope_a, slope_b, error, half_a, half_b)
    grow = ray_thickness(face, a, b, half_a, half_b, value, slope_a, slope_b, error) if flat else 0.0
    cx, cy, cz = direction_of(face, a, b)
    cx, cy, cz = cx / value, cy / value, cz / value
    radius = 0.0
    for corner in range(4):
        da = half_a if corner & 1 else -half_a
        db = half_b if corner & 2 else -half_b
        x, y, z = direction_of(face, a + da, b + db)
        for end in range(1 if flat else 2):
            w = value + slope_a * da + slope_b * db if flat else (lo if end == 0 else hi)
            d = (x / w - cx) ** 2 + (y / w - cy) ** 2 + (z / w - cz) ** 2
            radius = max(radius, math.sqrt(d))
    return cx, cy, cz, (radius + grow) * (1.0 + 1e-9)


@unmanaged
def outside_region(blob, planes, count, x, y, z, radius):
    """Return whether a ball lies wholly outside the region of `count` planes n·p ≤ c from float slot `planes` on."""
    for k in range(count):
        o = planes + 4 * k
        if blob[o] * x + blob[o + 1] * y + blob[o + 2] * z - blob[o + 3] > radius:
            return True
    return False


@unmanaged
def _write(out, value, ga, gb, error, half, da, db, kink, third, aa, ab, bb):
    out[VALUE], out[SLOPE_A], out[SLOPE_B] = value, ga, gb
    out[ERROR] = (error + 1e-7 * (value + (abs(ga) + abs(gb)) * half)) * UP
    if math.isnan(aa):
        out[BEND_AA], out[BEND_AB], out[BEND_BB] = aa, (da + 1e-7 * abs(ga)) * UP, (db + 1e-7 * abs(gb)) * UP
    else:
        out[BEND_AA], out[BEND_AB], out[BEND_BB] = aa, ab, bb
        kink += 1e-7 * (abs(aa) + abs(ab) + abs(bb))  # what float32 leaves of them
    out[KINK], out[THIRD] = kink * UP, third * UP


@unmanaged
def spreads_of(tab, o, half):
    """Return (spread_a, spread_b) of the cell at a float32 slot, of a half side: how far ∂W strays from its slopes."""
    aa, ab, bb = np.float64(tab[o + BEND_AA]), np.float64(tab[o + BEND_AB]), np.float64(tab[o + BEND_BB])
    if math.isnan(aa):
        return ab, bb
    r = half * math.sqrt(2.0)
    rest = r * (np.float64(tab[o + KINK]) + 0.5 * r * np.float64(tab[o + THIRD]))
    return (
        (half * (abs(aa) + abs(ab)) + rest) * UP + 2e-7 * abs(tab[o + SLOPE_A]),
        (half * (abs(ab) + abs(bb)) + rest) * UP + 2e-7 * abs(tab[o + SLOPE_B]),
    )


@njit(cache=True, error_model="numpy")
def _put_bend(bends, face, i, j, bend_lo, bend_hi):
    """Write a base cell's bend, rounded outward."""
    bends[face, i, j, 0], bends[face, i, j, 1] = bend_lo - 3e-7 * abs(bend_lo), bend_hi + 3e-7 * abs(bend_hi)


@entry
def prove_base(blob, leaf, n, face, planes, count, models, spans, thickness, bends):
    """Prove the base cells of one face of a leaf.

    models: (6, n, n, CELL_SIZE) float32. spans: (6, n, n, 2) range of W. thickness: (6, n, n) mm, how far surface and
    plane can lie apart in the thickest of a cell's four quarters; 0 where the surface lies outside the leaf's region,
    so that nothing asks for it. bends: (6, n, n, 2) float32, the bend of each base cell.
    """
    ints = integers(blob)
    half = 1.0 / n
    for i in range(n):
        for j in range(n):
            a, b = (2 * i + 1) * half - 1.0, (2 * j + 1) * half - 1.0
            value, ga, gb, error, da, db, lo, hi, b0, b1, kink, third, aa, ab, bb = cell_model(
                blob, ints, leaf, face, a, b, half, half, np.bool_(False)
            )
            _put_bend(bends, face, i, j, b0, b1)
            _write(models[face, i, j], value, ga, gb, error, half, da, db, kink, third, aa, ab, bb)
            spans[face, i, j, 0], spans[face, i, j, 1] = lo, hi
            x, y, z, radius = cell_sphere(face, a, b, half, half, value, ga, gb, error, lo, hi)
            if outside_region(blob, planes, count, x, y, z, radius):
                thickness[face, i, j] = 0.0
                continue
            worst = 0.0
            for q in range(4):
                ca, cb = a + (0.5 * half if q & 1 else -0.5 * half), b + (0.5 * half if q & 2 else -0.5 * half)
                value, ga, gb, error, _, _, lo, hi = cell_model(
                    blob, ints, leaf, face, ca, cb, 0.5 * half, 0.5 * half, np.bool_(False)
                )[:8]
                x, y, z, radius = cell_sphere(face, ca, cb, 0.5 * half, 0.5 * half, value, ga, gb, error, lo, hi)
                if outside_region(blob, planes, count, x, y, z, radius):
                    continue
                if quad_radius_ok(value, ga, gb, error, 0.5 * half, 0.5 * half):
                    thick = model_thickness(face, ca, cb, 0.5 * half, 0.5 * half, value, ga, gb, error)
                    worst = max(worst, min(thick, STEEP))
                else:
                    worst = STEEP
            thickness[face, i, j] = worst


@entry
def prove_cells(blob, leaf, n, face, parting, models, spans, cells, bends):
    """Prove the cells of every parted base cell of one face, and narrow its span by theirs.

    parting: (6, n, n) words (`hhsr.kernels.layout`). models: of the base cells, used as they are where k = 0. cells:
    (…, CELL_SIZE) float32. bends: (6, n, n, 2) float32, the bend of each base cell, narrowed by theirs.
    """
    ints = integers(blob)
    for i in range(n):
        for j in range(n):
            first, k = parting[face, i, j] >> 4, parting[face, i, j] & 7
            if k == 0:
                for q in range(CELL_SIZE):
                    cells[first, q] = models[face, i, j, q]
                continue
            s = 1 << k
            half = 1.0 / (n * s)
            low, high = 1e300, 0.0
            bend_lo, bend_hi = np.inf, -np.inf
            for p in range(s):
                for q in range(s):
                    a, b = (2 * (i * s + p) + 1) * half - 1.0, (2 * (j * s + q) + 1) * half - 1.0
                    value, ga, gb, error, da, db, lo, hi, b0, b1, kink, third, aa, ab, bb = cell_model(
                        blob, ints, leaf, face, a, b, half, half, np.bool_(True)
                    )
                    _write(cells[first + p * s + q], value, ga, gb, error, half, da, db, kink, third, aa, ab, bb)
                    low, high = min(low, lo), max(high, hi)
                    bend_lo, bend_hi = min(bend_lo, b0), max(bend_hi, b1)
            _put_bend(bends, face, i, j, bend_lo, bend_hi)
            spans[face, i, j, 0], spans[face, i, j, 1] = (
                max(spans[face, i, j, 0], low),
                min(spans[face, i, j, 1], high),
            )


@entry
def fill_ranges(n, spans, ranges, box):
    """Fill the pyramid of ranges (nodes, 2) float32 from the spans of the base cells, and the leaf's box.

    box: (8,) lowest 3, highest 3, least and greatest |p|∞ of its surface, leaf frame.
    """
    half = 1.0 / n
    box[:3], box[3:6], box[6], box[7] = 0.0, 0.0, 1e300, 0.0
    for face in range(6):
        for i in range(n):
            for j in range(n):
                lo, hi = spans[face, i, j, 0], spans[face, i, j, 1]
                node = (face * n + i) * n + j
                ranges[node, 0], ranges[node, 1] = lo * (1.0 - 3e-7), hi * UP
                box[6], box[7] = min(box[6], 1.0 / hi), max(box[7], 1.0 / lo)
                a, b = (2 * i + 1) * half - 1.0, (2 * j + 1) * half - 1.0
                for corner in range(4):
                    x, y, z = direction_of(
                        face, a + (half if corner & 1 else -half), b + (half if corner & 2 else -half)
                    )
                    box[0], box[3] = min(box[0], x / lo), max(box[3], x / lo)
                    box[1], box[4] = min(box[1], y / lo), max(box[4], y / lo)
                    box[2], box[5] = min(box[2], z / lo), max(box[5], z / lo)
        side = n // 2
        while side >= 1:
            below, start = level_start(n, 2 * side) + 4 * face * side * side, level_start(n, side) + face * side * side
            for i in range(side):
                for j in range(side):
                    lo, hi = np.float32(1e30), np.float32(0.0)
                    for q in range(4):
                        child = below + (2 * i + (q >> 1)) * 2 * side + 2 * j + (q & 1)
                        lo, hi = min(lo, ranges[child, 0]), max(hi, ranges[child, 1])
                    ranges[start + i * side + j, 0], ranges[start + i * side + j, 1] = lo, hi
            side //= 2


def blocks_of(centres, inverse_extents, weights):
    """Return (offsets (385,), rows (…,)): for each block of directions the centres that are not 0 everywhere in it.

    Layout of a block: `hhsr.kernels.layout.BLOCKS`.
    """
    step = 2.0 / BLOCKS_PER_SIDE
    edges = -1.0 + step * np.arange(BLOCKS_PER_SIDE + 1)
    grid = np.array([[[direction_of(f, a, b) for b in edges] for a in edges] for f in range(6)])
    grid /= np.linalg.norm(grid, axis=-1, keepdims=True)
    middle = grid[:, :-1, :-1] + grid[:, 1:, :-1] + grid[:, :-1, 1:] + grid[:, 1:, 1:]
    middle /= np.linalg.norm(middle, axis=-1, keepdims=True)
    nearest = np.min(
        [(grid[:, i : i + BLOCKS_PER_SIDE, j : j + BLOCKS_PER_SIDE] * middle).sum(-1) for i in (0, 1) for j in (0, 1)],
        axis=0,
    )
    reach = np.arccos(np.clip(nearest, -1.0, 1.0)).ravel() + 1e-6
    angle = np.arccos(np.clip(middle.reshape(-1, 3) @ centres.T, -1.0, 1.0))
    support = np.arccos(np.clip(1.0 - 1.0 / inverse_extents, -1.0, 1.0)) + 1e-6
    near = angle <= reach[:, None] + support
    table = np.column_stack([centres, inverse_extents, weights]).T
    blocks = []
    for held in near:
        rows = np.zeros((BLOCK_ROWS, -(-int(held.sum()) // LANES) * LANES))
        rows[:, : held.sum()] = table[:, held]
        blocks.append(rows.ravel())
    offsets = np.concatenate([[0], np.cumsum([rows.size for rows in blocks])])
    return offsets.astype(np.int64), np.concatenate(blocks)
