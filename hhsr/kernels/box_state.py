"""Whether a whole box lies inside or outside the solid: by proof, or not known."""

import numpy as np

from hhsr.kernels.layout import (
    BOX,
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
    RANGE_TABLE,
    RETAINED,
    SLOPE_A,
    SLOPE_B,
    VALUE,
)
from hhsr.kernels.maps import index_of, level_start, plane_of
from hhsr.kernels.part import TRIANGLES, part_arrays
from hhsr.kernels.tree import into_leaf, owner_contains
from hhsr.kernels.unmanaged import managed, unmanaged

OUT, IN, MIXED = 0, 1, 2
SPAN = 3  # cells a side that are looked at one by one
SLACK = 1e-6  # mm that a box is grown by on all sides


@unmanaged
def _over_cells(ints, tab, leaf, face, q, e, m_hi, a_lo, a_hi, b_lo, b_hi):
    """Return the state of a box over a rectangle of directions of a face, each cell by its linear model."""
    n = ints[leaf + CELLS]
    state = -1
    for i in range(index_of(a_lo, n), index_of(a_hi, n) + 1):
        for j in range(index_of(b_lo, n), index_of(b_hi, n) + 1):
            word = ints[ints[leaf + PARTING] + (face * n + i) * n + j]
            s = 1 << (word & 7)
            side = n * s
            p0, p1 = max(index_of(a_lo, side), i * s), min(index_of(a_hi, side), i * s + s - 1)
            q0, q1 = max(index_of(b_lo, side), j * s), min(index_of(b_hi, side), j * s + s - 1)
            for p in range(p0, p1 + 1):
                for r in range(q0, q1 + 1):
                    o = ints[leaf + CELL_TABLE] + CELL_SIZE * ((word >> 4) + (p - i * s) * s + r - j * s)
                    a, b = (2 * p + 1) / side - 1.0, (2 * r + 1) / side - 1.0
                    gx, gy, gz = plane_of(face, a, b, tab[o + VALUE], tab[o + SLOPE_A], tab[o + SLOPE_B])
                    # The point is inside where m·W ≤ 1; m·(model of W) is g·p, linear over the box.
                    middle = gx * q[0] + gy * q[1] + gz * q[2]
                    wide = abs(gx) * e[0] + abs(gy) * e[1] + abs(gz) * e[2] + m_hi * tab[o + ERROR] + 1e-9
                    if middle + wide < 1.0:
                        new = IN
                    elif middle - wide > 1.0:
                        new = OUT
                    else:
                        return MIXED
                    if state >= 0 and new != state:
                        return MIXED
                    state = new
    return state


@unmanaged
def directions_of(face, q, e):
    """Return (m_lo, m_hi, a_lo, a_hi, b_lo, b_hi) of the box q ± e (leaf's frame) on a face; m_hi is 0 where it is not.

    m: along the face's axis. a, b: its directions.
    """
    k = face // 2
    ka, kb = (k + 1) % 3, (k + 2) % 3
    m = q[k] if face % 2 == 0 else -q[k]
    m_hi = m + e[k]
    least_a, least_b = max(abs(q[ka]) - e[ka], 0.0), max(abs(q[kb]) - e[kb], 0.0)
    if m_hi <= 0.0 or least_a > m_hi or least_b > m_hi:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    m_lo = max(m - e[k], least_a, least_b, 1e-9)
    lo, hi = q[ka] - e[ka], q[ka] + e[ka]
    a_lo = max(lo / (m_hi if lo >= 0.0 else m_lo), -1.0)
    a_hi = min(hi / (m_lo if hi >= 0.0 else m_hi), 1.0)
    lo, hi = q[kb] - e[kb], q[kb] + e[kb]
    b_lo = max(lo / (m_hi if lo >= 0.0 else m_lo), -1.0)
    b_hi = min(hi / (m_lo if hi >= 0.0 else m_hi), 1.0)
    if a_lo > 1.0 or b_lo > 1.0 or a_hi < -1.0 or b_hi < -1.0:
        return 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
    return m_lo, m_hi, a_lo, a_hi, b_lo, b_hi


@unmanaged
def leaf_box_state(blob, ints, tab, leaf, q, e):
    """Return the state of the box q ± e (leaf's frame) of a model leaf."""
    box = ints[leaf + BOX]
    core = blob[box + 6] * (1.0 - 1e-9)
    if max(abs(q[0]) + e[0], abs(q[1]) + e[1], abs(q[2]) + e[2]) < core:
        return IN
    for k in range(3):
        if q[k] - e[k] > blob[box + 3 + k] or q[k] + e[k] < blob[box + k]:
            return OUT
    n = ints[leaf + CELLS]
    state = -1
    for face in range(6):
        m_lo, m_hi, a_lo, a_hi, b_lo, b_hi = directions_of(face, q, e)
        if m_hi <= 0.0:
            continue
        side = n
        while side > 1 and max(a_hi - a_lo, b_hi - b_lo) * side > 2.0 * SPAN:
            side //= 2
        base = ints[leaf + RANGE_TABLE] + 2 * (level_start(n, side) + face * side * side)
        w_lo, w_hi = np.float32(1e30), np.float32(0.0)
        for i in range(index_of(a_lo, side), index_of(a_hi, side) + 1):
            for j in range(index_of(b_lo, side), index_of(b_hi, side) + 1):
                w_lo, w_hi = min(w_lo, tab[base + 2 * (i * side + j)]), max(w_hi, tab[base + 2 * (i * side + j) + 1])
        if m_hi * w_hi < 1.0 - 1e-9:
            new = IN
        elif m_lo * w_lo > 1.0 + 1e-9:
            new = OUT
        elif side < n:
            return MIXED
        else:
            new = _over_cells(ints, tab, leaf, face, q, e, m_hi, a_lo, a_hi, b_lo, b_hi)
        if new == MIXED or (state >= 0 and new != state):
            return MIXED
        state = new
    return state if state >= 0 else MIXED


@managed
def _part_box_state(blob, ints, part, q, e, stack):
    """Return the state of a box of a retained part: mixed where it meets the box of any triangle's node."""
    if ints[part + TRIANGLES] == 0:
        return OUT
    boxes, links, _ = part_arrays(blob, ints, part)
    stack[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        node = stack[depth]
        apart = False
        for k in range(3):
            apart = apart or boxes[node, k] > q[k] + e[k] or boxes[node, 3 + k] < q[k] - e[k]
        if apart:
            continue
        if links[node, 1] > 0:
            return MIXED
        stack[depth], stack[depth + 1] = links[node, 0], links[node, 0] + 1
        depth += 2
    return -1


@unmanaged
def box_state(blob, ints, tab, x, y, z, half, nodes, stack, q, e):
    """Return IN, OUT or MIXED of the cube about (x, y, z), tree frame; nodes, stack, q, e: scratch."""
    half += SLACK + 1e-9 * (abs(x) + abs(y) + abs(z))
    state = -1
    nodes[0] = 0
    depth = 1
    while depth > 0:
        depth -= 1
        i = ints[NODE_INTS] + NODE_INT_SIZE * nodes[depth]
        owner = ints[i + 3]
        if nodes[depth] >= 0 and ints[i] == CUT:
            f = ints[NODE_FLOATS] + NODE_FLOAT_SIZE * nodes[depth]
            h = blob[f] * x + blob[f + 1] * y + blob[f + 2] * z - blob[f + 3]
            reach = (abs(blob[f]) + abs(blob[f + 1]) + abs(blob[f + 2])) * half
            d = blob[f + 4]
            if h - reach < d and h + reach > -d and d > 0.0:
                return MIXED  # a slab: its strips are bounded by their own search
            if h + reach >= d:
                nodes[depth] = ints[i + 2]
                depth += 1
            if h - reach < -d:
                nodes[depth] = ints[i + 1]
                depth += 1
            continue
        o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
        kind, record = ints[o + OWNER_KIND], ints[o + OWNER_RECORD]
        e[0], e[1], e[2] = half, half, half
        if kind == MODEL:
            q[0], q[1], q[2] = into_leaf(blob, ints, record, x, y, z)
            g = ints[record + FRAME]
            for k in range(3):
                e[k] = half * (abs(blob[g + 3 + k]) + abs(blob[g + 6 + k]) + abs(blob[g + 9 + k]))
            new = leaf_box_state(blob, ints, tab, record, q, e)
        elif kind == RETAINED:
            q[0], q[1], q[2] = x, y, z
            new = _part_box_state(blob, ints, record, q, e, stack)
            if new < 0:
                new = IN if owner_contains(blob, ints, tab, owner, x, y, z) else OUT
        else:
            new = MIXED
        if new == MIXED or (state >= 0 and new != state):
            return MIXED
        state = new
    return state if state >= 0 else MIXED
