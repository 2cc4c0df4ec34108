"""A plane for each voxel that the surface passes: how far the leaf's own function can stray from it, proven.

In the chart F(p) = m·W(a, b) is 1 on a leaf's surface, and m times a linear model of W is linear in space. So over a
box F is a plane to within what the cells' models prove, and most questions about the box are answered by that plane.
"""

import math

import numpy as np

from hhsr.kernels.box_state import IN, MIXED, OUT, SLACK, directions_of, leaf_box_state
from hhsr.kernels.cell import is_ellipsoid
from hhsr.kernels.layout import (
    BEND_SIZE,
    BEND_TABLE,
    CELL_SIZE,
    CELL_TABLE,
    CELLS,
    CUT,
    ERROR,
    FRAME,
    MODEL,
    NODE_FLOAT_SIZE,
    NODE_FLOATS,
    NODE_INT_SIZE,
    NODE_INTS,
    OWNER_INT_SIZE,
    OWNER_INTS,
    OWNER_KIND,
    OWNER_RECORD,
    PARTING,
    SLOPE_A,
    SLOPE_B,
    VALUE,
)
from hhsr.kernels.maps import index_of, plane_of, spreads_of
from hhsr.kernels.tree import into_leaf, turn_out_of_leaf
from hhsr.kernels.unmanaged import unmanaged

# A surfel: over its voxel, in voxel units u from its centre, F − 1 = thick·(normal·u + offset ± 1), so that the plane
# decides where |normal·u + offset| > 1; the gradient of F strays no more than `turn` from the plane's; |second
# derivative of F along a unit vector| ≤ bend (infinite: unknown). The first four numbers are the plane, the others its
# details, which lie apart: most need no more.
# A voxel that one cutting plane passes has owner = −1 − the cut's node, and at EXTRA where the surfels of its two sides
# lie, left and right; its own plane decides for both, or is NaN.
PLANE_SIZE, DETAIL_SIZE = 4, 4
SURFEL_SIZE = PLANE_SIZE + DETAIL_SIZE
NORMAL, OFFSET, DETAIL = 0, 3, 4
THICK, TURN, BEND, SURFEL_OWNER = 0, 1, 2, 3  # from DETAIL on
EXTRA = 0
# What is kept of a plane: four 16-bit numbers, its own times FINE, rounded; no plane: zeros.
FINE, LARGEST = 256.0, 32_742.0
SURE = 2.0  # offset where a side is proven whole
MOST_CELLS = 2000  # a box that sweeps more is too near its leaf's centre
WILD = 1e3  # a model that strays more (1/mm) proves nothing worth keeping
SHALLOW = 0.5  # least ratio of the depths of a box below its face


@unmanaged
def _scan(ints, tab, leaf, face, a_lo, a_hi, b_lo, b_hi, gx, gy, gz, gather, acc):
    """Go over the cells of a rectangle of directions of a face; return how many there are.

    gather: widen acc[0:6], the range of the cells' planes. Else, against the plane g: acc[0:2], the range of W less
    it; acc[2], acc[3], how far its slopes stray; acc[4], the greatest |bend|.
    """
    n = ints[leaf + CELLS]
    if face < 2:
        along, ga, gb = gx, gy, gz
    elif face < 4:
        along, ga, gb = gy, gz, gx
    else:
        along, ga, gb = gz, gx, gy
    if face % 2 == 1:
        along = -along
    count = 0
    for i in range(index_of(a_lo, n), index_of(a_hi, n) + 1):
        for j in range(index_of(b_lo, n), index_of(b_hi, n) + 1):
            word = ints[ints[leaf + PARTING] + (face * n + i) * n + j]
            s = 1 << (word & 7)
            side = n * s
            half = 1.0 / side
            if not gather:
                o = ints[leaf + BEND_TABLE] + BEND_SIZE * ((face * n + i) * n + j)
                acc[4] = max(acc[4], max(-tab[o], tab[o + 1]))
            p0, p1 = max(index_of(a_lo, side), i * s), min(index_of(a_hi, side), i * s + s - 1)
            q0, q1 = max(index_of(b_lo, side), j * s), min(index_of(b_hi, side), j * s + s - 1)
            for p in range(p0, p1 + 1):
                for r in range(q0, q1 + 1):
                    count += 1
                    o = ints[leaf + CELL_TABLE] + CELL_SIZE * ((word >> 4) + (p - i * s) * s + r - j * s)
                    a, b = (2 * p + 1) * half - 1.0, (2 * r + 1) * half - 1.0
                    value, slope_a = np.float64(tab[o + VALUE]), np.float64(tab[o + SLOPE_A])
                    slope_b = np.float64(tab[o + SLOPE_B])
                    if gather:
                        x, y, z = plane_of(face, a, b, value, slope_a, slope_b)
                        acc[0], acc[1], acc[2] = min(acc[0], x), min(acc[1], y), min(acc[2], z)
                        acc[3], acc[4], acc[5] = max(acc[3], x), max(acc[4], y), max(acc[5], z)
                        continue
                    # W − g·dir over the part of the cell in the rectangle: linear there, to the model's error.
                    low_a, high_a = max(a - half, a_lo), min(a + half, a_hi)
                    low_b, high_b = max(b - half, b_lo), min(b + half, b_hi)
                    ca, cb = 0.5 * (low_a + high_a), 0.5 * (low_b + high_b)
                    da, db = slope_a - ga, slope_b - gb
                    gap = value + slope_a * (ca - a) + slope_b * (cb - b) - (along + ga * ca + gb * cb)
                    reach = 0.5 * (abs(da) * abs(high_a - low_a) + abs(db) * abs(high_b - low_b)) + tab[o + ERROR]
                    reach += 1e-11 * abs(value)
                    acc[0], acc[1] = min(acc[0], gap - reach), max(acc[1], gap + reach)
                    stray_a, stray_b = spreads_of(tab, o, half)
                    acc[2] = max(acc[2], abs(da) + stray_a)
                    acc[3] = max(acc[3], abs(db) + stray_b)
    return count


@unmanaged
def prove_plane(ints, tab, leaf, q, e, acc, out):
    """Fill out (8,) with the surfel of the box q ± e of a model leaf, in its frame and mm; return whether there is one.

    With p = m·(1, a, b) and δ the stray of W and its slopes, the gradient strays by (δ − a·δ_a − b·δ_b, δ_a, δ_b), and
    the second derivative along v is that of W along v − (a, b)·v_m, over m. acc: (6,) scratch.
    """
    count = 0
    acc[:3], acc[3:] = np.inf, -np.inf
    for face in range(6):
        m_lo, m_hi, a_lo, a_hi, b_lo, b_hi = directions_of(face, q, e)
        if m_hi > 0.0:
            if m_lo < SHALLOW * m_hi or (a_hi - a_lo) * (b_hi - b_lo) > 0.25:
                return False
            count += _scan(ints, tab, leaf, face, a_lo, a_hi, b_lo, b_hi, 0.0, 0.0, 0.0, True, acc)
            if count > MOST_CELLS:
                return False
    if count == 0:
        return False
    gx, gy, gz = 0.5 * (acc[0] + acc[3]), 0.5 * (acc[1] + acc[4]), 0.5 * (acc[2] + acc[5])
    low, high, turn, bend = np.inf, -np.inf, 0.0, 0.0
    for face in range(6):
        m_lo, m_hi, a_lo, a_hi, b_lo, b_hi = directions_of(face, q, e)
        if m_hi > 0.0:
            acc[0], acc[1], acc[2], acc[3], acc[4] = np.inf, -np.inf, 0.0, 0.0, 0.0
            if _scan(ints, tab, leaf, face, a_lo, a_hi, b_lo, b_hi, gx, gy, gz, False, acc) == 0:
                continue
            if not (acc[1] - acc[0] < WILD and acc[2] < WILD and acc[3] < WILD):
                return False
            low = min(low, m_lo * acc[0], m_hi * acc[0])
            high = max(high, m_lo * acc[1], m_hi * acc[1])
            far_a, far_b = max(abs(a_lo), abs(a_hi)), max(abs(b_lo), abs(b_hi))
            deep = max(-acc[0], acc[1]) + far_a * acc[2] + far_b * acc[3]
            turn = max(turn, math.sqrt(acc[2] * acc[2] + acc[3] * acc[3] + deep * deep))
            bend = max(bend, (1.0 + far_a * far_a + far_b * far_b) * acc[4] / m_lo)
    out[NORMAL], out[NORMAL + 1], out[NORMAL + 2] = gx, gy, gz
    out[OFFSET] = gx * q[0] + gy * q[1] + gz * q[2] + 0.5 * (low + high) - 1.0
    thick = 0.5 * (high - low) * (1.0 + 1e-9) + 2e-9
    out[DETAIL + THICK], out[DETAIL + TURN] = thick, turn * (1.0 + 1e-9)
    # Runs of a known bend are settled by the formulas of an ellipsoid (`hhsr.kernels.cell_along`).
    out[DETAIL + BEND] = bend if is_ellipsoid(ints, leaf) else np.inf
    return True


@unmanaged
def owner_of_box(blob, ints, node, x, y, z, half):
    """Return the owner, below a node, of the whole cube about (x, y, z), tree frame; −1 − n where cut n passes it."""
    while True:
        i = ints[NODE_INTS] + NODE_INT_SIZE * node
        if ints[i] != CUT:
            return ints[i + 3]
        f = ints[NODE_FLOATS] + NODE_FLOAT_SIZE * node
        h = blob[f] * x + blob[f + 1] * y + blob[f + 2] * z - blob[f + 3]
        reach = (abs(blob[f]) + abs(blob[f + 1]) + abs(blob[f + 2])) * half
        if h - reach > blob[f + 4]:
            node = ints[i + 2]
        elif h + reach < -blob[f + 4]:
            node = ints[i + 1]
        else:
            return -1 - node


@unmanaged
def _highest(gx, gy, gz, nx, ny, nz, c, half):
    """Return an upper bound of g·u over the cube |u|∞ ≤ half where n·u ≤ c: the dual's least value, so the very one.

    For any share s ≥ 0, g·u ≤ (g − s·n)·u + s·c there; the best s is 0 or takes one of the axes out.
    """
    best = (abs(gx) + abs(gy) + abs(gz)) * half
    for k in range(3):
        g, n = (gx, nx) if k == 0 else ((gy, ny) if k == 1 else (gz, nz))
        if g * n > 0.0:
            s = g / n
            best = min(best, (abs(gx - s * nx) + abs(gy - s * ny) + abs(gz - s * nz)) * half + s * c)
    return best


@unmanaged
def _prove_side(blob, ints, tab, owner, x, y, z, half, side, nx, ny, nz, c, q, e, acc, plane, out):
    """Return IN, OUT or MIXED of a voxel in one owner's region, filling out (SURFEL_SIZE,) float32; −1: no surfel.

    n·u ≤ c: the part of the voxel that counts, in units of `side` from its centre; n is 0 where it is all.
    """
    o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
    if ints[o + OWNER_KIND] != MODEL:
        return -1
    leaf = ints[o + OWNER_RECORD]
    q[0], q[1], q[2] = into_leaf(blob, ints, leaf, x, y, z)
    g = ints[leaf + FRAME]
    for k in range(3):
        e[k] = half * (abs(blob[g + 3 + k]) + abs(blob[g + 6 + k]) + abs(blob[g + 9 + k]))
    state = MIXED
    if prove_plane(ints, tab, leaf, q, e, acc, plane):
        gx, gy, gz = turn_out_of_leaf(blob, g, plane[NORMAL], plane[NORMAL + 1], plane[NORMAL + 2])
        gx, gy, gz, level = gx * side, gy * side, gz * side, plane[OFFSET]
        steep = abs(gx) + abs(gy) + abs(gz)
        reach = steep * (half / side)
        rise = _highest(gx, gy, gz, nx, ny, nz, c, half / side)
        fall = _highest(-gx, -gy, -gz, nx, ny, nz, c, half / side)
        # The numbers are float32, and a segment's place along it is rounded: far less than a millionth of a voxel.
        thick = (plane[DETAIL + THICK] + 1e-6 * reach + 1e-6 * steep + 1e-6 * abs(level)) * (1.0 + 1e-6)
        if level - fall > thick:
            state = OUT
        elif level + rise < -thick:
            state = IN
        elif reach < thick:  # the plane decides nothing: a few cells' own planes may
            state = leaf_box_state(blob, ints, tab, leaf, q, e)
            if state == MIXED and plane[DETAIL + BEND] == np.inf and thick > steep:
                return -1
        out[NORMAL], out[NORMAL + 1], out[NORMAL + 2] = gx / thick, gy / thick, gz / thick
        out[OFFSET], out[DETAIL + THICK] = level / thick, thick
        out[DETAIL + TURN] = plane[DETAIL + TURN] * side * (1.0 + 1e-6) + 1e-6 * steep
        out[DETAIL + BEND] = plane[DETAIL + BEND] * side * side * (1.0 + 1e-6)
    else:
        state = leaf_box_state(blob, ints, tab, leaf, q, e)
        if state == MIXED:
            return -1
    if state != MIXED:
        out[:] = 0.0
        out[OFFSET], out[DETAIL + THICK] = (-SURE if state == IN else SURE), 1.0
    out[DETAIL + SURFEL_OWNER] = owner
    return state


@unmanaged
def _farthest(gx, gy, gz, level, nx, ny, nz, c, half):
    """Return an upper bound of |g·u + level| over the cube |u|∞ ≤ half where n·u ≤ c."""
    return max(level + _highest(gx, gy, gz, nx, ny, nz, c, half), _highest(-gx, -gy, -gz, nx, ny, nz, c, half) - level)


@unmanaged
def _join(left, right, nx, ny, nz, c, half, margin, out):
    """Put a plane into out that decides for both sides of the cut n·u = c, by those of its sides; NaN: there is none.

    In lengths: where a side's plane puts the surface within 1/|normal|, the middle of both does within that and how far
    it strays from the side's own. Where one side is proven whole the other's plane must not say the contrary there.
    margin: so far past the cut a side counts.
    """
    out[NORMAL : OFFSET + 1] = np.nan
    ax, ay, az, a = np.float64(left[0]), np.float64(left[1]), np.float64(left[2]), np.float64(left[OFFSET])
    bx, by, bz, b = np.float64(right[0]), np.float64(right[1]), np.float64(right[2]), np.float64(right[OFFSET])
    one, other = math.sqrt(ax * ax + ay * ay + az * az), math.sqrt(bx * bx + by * by + bz * bz)
    if one > 0.0 and other > 0.0:
        ax, ay, az, a = ax / one, ay / one, az / one, a / one
        bx, by, bz, b = bx / other, by / other, bz / other, b / other
        gx, gy, gz, level = 0.5 * (ax + bx), 0.5 * (ay + by), 0.5 * (az + bz), 0.5 * (a + b)
        thick = max(
            1.0 / one + _farthest(gx - ax, gy - ay, gz - az, level - a, nx, ny, nz, c + margin, half),
            1.0 / other + _farthest(gx - bx, gy - by, gz - bz, level - b, -nx, -ny, -nz, margin - c, half),
        )
        steep = abs(gx) + abs(gy) + abs(gz)
        thick = (thick + 1e-6 * (steep + abs(level))) * (1.0 + 1e-6)
        if thick < steep * half:
            out[NORMAL], out[NORMAL + 1], out[NORMAL + 2] = gx / thick, gy / thick, gz / thick
            out[OFFSET] = level / thick
    elif other > 0.0:
        whole = 1.0 if a > 0.0 else -1.0
        if _highest(-whole * bx, -whole * by, -whole * bz, nx, ny, nz, c + margin, half) - whole * b < 1.0 - 1e-6 * (
            1.0 + other
        ):
            for k in range(DETAIL):
                out[k] = right[k]
    elif one > 0.0:
        whole = 1.0 if b > 0.0 else -1.0
        if _highest(-whole * ax, -whole * ay, -whole * az, -nx, -ny, -nz, margin - c, half) - whole * a < 1.0 - 1e-6 * (
            1.0 + one
        ):
            for k in range(DETAIL):
                out[k] = left[k]


@unmanaged
def prove_voxel(blob, ints, tab, x, y, z, half, side, q, e, acc, plane, out, left, right):
    """Return IN, OUT or MIXED of the cube about (x, y, z), half a side in mm, by its surfel; −1 where it has none.

    Fills out (SURFEL_SIZE,) float32, in units of `side`, and left and right where a cut passes: owner < 0 then, and
    EXTRA is to be filled.
    q, e, acc, plane: scratch.
    """
    half += SLACK + 1e-9 * (abs(x) + abs(y) + abs(z))
    owner = owner_of_box(blob, ints, 0, x, y, z, half)
    if owner >= 0:
        return _prove_side(
            blob, ints, tab, owner, x, y, z, half, side, 0.0, 0.0, 0.0, 0.0, q, e, acc, plane, out
        )  # fmt: skip
    node = -1 - owner
    f = ints[NODE_FLOATS] + NODE_FLOAT_SIZE * node
    if blob[f + 4] > 0.0:
        return -1
    nx, ny, nz = blob[f], blob[f + 1], blob[f + 2]
    c = (blob[f + 3] - (nx * x + ny * y + nz * z)) / side
    i = ints[NODE_INTS] + NODE_INT_SIZE * node
    one, other = (
        owner_of_box(blob, ints, ints[i + 1], x, y, z, half),
        owner_of_box(blob, ints, ints[i + 2], x, y, z, half),
    )
    if one < 0 or other < 0:
        return -1
    margin = 1e-6 * (1.0 + abs(c))  # a millionth of a voxel past the cut: where a segment meets it is rounded
    state = _prove_side(blob, ints, tab, one, x, y, z, half, side, nx, ny, nz, c + margin, q, e, acc, plane, left)
    if state < 0:
        return -1
    second = _prove_side(
        blob, ints, tab, other, x, y, z, half, side, -nx, -ny, -nz, margin - c, q, e, acc, plane, right
    )
    if second < 0:
        return -1
    if state == second and state != MIXED:
        return state
    out[:] = np.nan
    _join(left, right, nx, ny, nz, c, half / side, margin, out)
    out[DETAIL + SURFEL_OWNER] = owner
    return MIXED
