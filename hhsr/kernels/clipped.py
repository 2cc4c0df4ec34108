"""A segment clipped down the tree into one interval for each region, each followed by its owner (DESIGN §2).

The state at each instant is the owner's; where it changes, inside an owner or across a clip, there is a crossing.
"""

import numpy as np

from hhsr.kernels.layout import (
    CUT,
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
    RETAINED,
    ROTATED,
)
from hhsr.kernels.part import TRIANGLES, part_arrays, part_contains
from hhsr.kernels.segment import emit, leaf_crossings
from hhsr.kernels.slab_segment import slab_crossings
from hhsr.kernels.tree import into_leaf, turn_into_leaf
from hhsr.kernels.triangle_build import STACK
from hhsr.kernels.triangles import segment_crossings, sort_crossings
from hhsr.kernels.unmanaged import managed, unmanaged


@managed
def part_crossings(blob, ints, part, px, py, pz, dx, dy, dz, t0, t1, state, out, count):
    """Follow a retained part: the exact crossings of the whole segment, and of them those in [t0, t1]."""
    if ints[part + TRIANGLES] == 0:
        return emit(state, False, t0, out, count)
    boxes, links, corners = part_arrays(blob, ints, part)
    start, end, inverse = np.empty(3), np.empty(3), np.empty(3)
    start[0], start[1], start[2] = px, py, pz
    end[0], end[1], end[2] = px + dx, py + dy, pz + dz
    stack = np.empty(STACK, dtype=np.int64)
    t, index, way = np.empty(32), np.empty(32, dtype=np.int64), np.empty(32, dtype=np.int8)
    found = segment_crossings(boxes, links, corners, start, end, t, index, way, inverse, stack)
    if found > t.shape[0]:
        t, index, way = np.empty(found), np.empty(found, dtype=np.int64), np.empty(found, dtype=np.int8)
        found = segment_crossings(boxes, links, corners, start, end, t, index, way, inverse, stack)
    sort_crossings(t, index, way, found)
    inside = part_contains(blob, ints, part, px, py, pz)
    k = 0
    while k < found and t[k] <= t0:
        inside = not inside
        k += 1
    state, count = emit(state, inside, t0, out, count)
    while k < found and t[k] < t1:
        inside = not inside
        state, count = emit(state, inside, t[k], out, count)
        k += 1
    return state, count


@unmanaged
def owner_crossings(
    blob, ints, tab, owner, px, py, pz, dx, dy, dz, t0, t1, resolution, tolerance, state, out, count, work
):
    """Follow p + t·d (tree's frame) through the region of one owner; return (state, count)."""
    o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
    kind, record = ints[o + OWNER_KIND], ints[o + OWNER_RECORD]
    if kind == MODEL:
        qx, qy, qz = into_leaf(blob, ints, record, px, py, pz)
        if ints[record + ROTATED] != 0:
            dx, dy, dz = turn_into_leaf(blob, ints[record + FRAME], dx, dy, dz)
        return leaf_crossings(
            blob, ints, tab, record, qx, qy, qz, dx, dy, dz, t0, t1, resolution, tolerance, state, out, count, work
        )
    if kind == RETAINED:
        return part_crossings(blob, ints, record, px, py, pz, dx, dy, dz, t0, t1, state, out, count)
    return slab_crossings(
        blob, ints, record, px, py, pz, dx, dy, dz, t0, t1, resolution, tolerance, state, out, count, work
    )


@unmanaged
def follow_tree(
    blob, ints, tab, root, px, py, pz, dx, dy, dz, begin, end, gap, resolution, tolerance, first, state, out, count,
    work, slots, pending,
):  # fmt: skip
    """Follow p + t·d for t in [begin, end] by clipping down the tree; return (state, count, done)."""
    pending[0], slots[0, 0], slots[0, 1] = root, begin, end
    depth = 1
    while depth > 0:
        depth -= 1
        node, t0, t1 = pending[depth], slots[depth, 0], slots[depth, 1]
        i = ints[NODE_INTS] + NODE_INT_SIZE * node
        if node < 0 or ints[i] != CUT:
            owner = ints[i + 3] if node >= 0 else -1 - node
            state, count = owner_crossings(
                blob, ints, tab, owner, px, py, pz, dx, dy, dz, t0, t1, resolution, tolerance, state, out, count, work
            )
            count = merge_touches(out, count, gap)
            if first and count > 0 and out[0] < t1 - gap:
                return state, count, True
            continue
        f = ints[NODE_FLOATS] + NODE_FLOAT_SIZE * node
        h = blob[f] * px + blob[f + 1] * py + blob[f + 2] * pz - blob[f + 3]
        g = blob[f] * dx + blob[f + 1] * dy + blob[f + 2] * dz
        d = blob[f + 4]
        # Intervals left of the slab, in it, right of it; the last along the segment is pushed first.
        if g == 0.0:
            if abs(h) < d:
                pending[depth] = -1 - ints[i + 3]
            else:
                pending[depth] = ints[i + 2] if h >= 0.0 else ints[i + 1]
            slots[depth, 0], slots[depth, 1] = t0, t1
            depth += 1
            continue
        near, far = (-d - h) / g, (d - h) / g
        one, other = ints[i + 1], ints[i + 2]
        if g < 0.0:
            near, far, one, other = far, near, other, one
        if far < t1:
            pending[depth], slots[depth, 0], slots[depth, 1] = other, max(far, t0), t1
            depth += 1
        if d > 0.0:
            a, b = max(near, t0), min(far, t1)
            if a < b:
                pending[depth], slots[depth, 0], slots[depth, 1] = -1 - ints[i + 3], a, b
                depth += 1
        if near > t0:
            pending[depth], slots[depth, 0], slots[depth, 1] = one, t0, min(near, t1)
            depth += 1
    return state, count, False


@unmanaged
def merge_touches(out, count, gap):
    """Drop pairs of crossings closer than `gap`: rounding at the meeting of two proofs. Keeps the parity."""
    if count < 2 or count > out.shape[0]:
        return count
    kept = 0
    for i in range(count):
        if kept > 0 and out[i] - out[kept - 1] <= gap:
            kept -= 1
        else:
            out[kept] = out[i]
            kept += 1
    return kept
