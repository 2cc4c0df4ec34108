"""All crossings of a segment with the solid: clip down the tree, follow each owner's own surface (DESIGN §2, §4).

The state at each instant is the owner's; where it changes, inside an owner or across a clip, there is a crossing. So
entering and leaving alternate by construction, and between two outside points their number is even.
"""

import math

import numpy as np
from numba import njit

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
    VOXELS,
    integers,
    tables,
)
from hhsr.kernels.part import TRIANGLES, part_arrays, part_contains
from hhsr.kernels.segment import PIECES, emit, leaf_crossings
from hhsr.kernels.slab_segment import slab_crossings
from hhsr.kernels.tree import into_leaf, into_tree, turn_into_leaf
from hhsr.kernels.triangle_build import STACK
from hhsr.kernels.triangles import segment_crossings, sort_crossings
from hhsr.kernels.voxels import leap, solid_contains

SLOTS = 64  # pending tree nodes of one segment: three a level
NUDGE = 1e-7  # mm past a voxel's border: less than voxels are proven beyond theirs
MERGE = 1e-9  # mm: a leaving and an entering closer than this are one touch


@njit(cache=True, error_model="numpy")
def scratch():
    """Return (work, slots, pending): what one thread needs to follow segments."""
    return np.empty((PIECES, 8)), np.empty((SLOTS, 2)), np.empty(SLOTS, dtype=np.int64)


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
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


@njit(cache=True, error_model="numpy")
def _follow_tree(
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
            count = _merge_touches(out, count, gap)
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


@njit(cache=True, error_model="numpy")
def follow_segment(
    blob, ints, tab, root, px, py, pz, ex, ey, ez, resolution, tolerance, first, out, work, slots, pending
):
    """Return (start state, count) of the segment p → e in the tree's frame and the solid of node `root`.

    t of each change of state goes to `out`. Where the voxels prove the state nothing else is asked.

    first: stop after the first crossing. A count above out.size says how much room is needed.
    """
    dx, dy, dz = ex - px, ey - py, ez - pz
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    begin = solid_contains(blob, ints, tab, root, px, py, pz)
    if length == 0.0:
        return begin, 0
    state, count = begin, 0
    gap = MERGE / length
    done = False
    if root != 0 or ints[VOXELS] == 0:
        state, count, done = _follow_tree(
            blob, ints, tab, root, px, py, pz, dx, dy, dz, 0.0, 1.0, gap, resolution, tolerance, first, state, out,
            count, work, slots, pending,
        )  # fmt: skip
    else:
        nudge = max(NUDGE / length, 1e-15)
        t, since = 0.0, -1.0
        while t < 1.0 and not done:
            proven, end = leap(blob, ints, px, py, pz, dx, dy, dz, t)
            if proven == 0:
                since = t if since < 0.0 else since
            elif since >= 0.0:
                state, count, done = _follow_tree(
                    blob, ints, tab, root, px, py, pz, dx, dy, dz, since, t, gap, resolution, tolerance, first, state,
                    out, count, work, slots, pending,
                )  # fmt: skip
                since = -1.0
            if proven != 0 and not done:
                state, count = emit(state, proven > 0, t, out, count)
                count = _merge_touches(out, count, gap)
                done = first and count > 0
            t = max(end, t) + nudge
        if since >= 0.0 and not done:
            state, count, done = _follow_tree(
                blob, ints, tab, root, px, py, pz, dx, dy, dz, since, 1.0, gap, resolution, tolerance, first, state,
                out, count, work, slots, pending,
            )  # fmt: skip
    if done:
        return begin, count
    if count <= out.shape[0]:
        _, count = emit(state, solid_contains(blob, ints, tab, root, ex, ey, ez), 1.0, out, count)
        count = _merge_touches(out, count, gap)
    return begin, count


@njit(cache=True, error_model="numpy")
def _merge_touches(out, count, gap):
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


@njit(cache=True, nogil=True, error_model="numpy")
def cross_many(blob, starts, ends, resolution, tolerance, counts, begins, ts):
    """Follow (n, 3) → (n, 3) LPS segments. counts: (n,) crossings of each, −1 not finite. begins: (n,) start inside.

    ts: room for all t, one segment after another. Returns (segments done, slots used): the room may not suffice.
    """
    ints, tab = integers(blob), tables(blob)
    work, slots, pending = scratch()
    used = 0
    for i in range(starts.shape[0]):
        if not _finite(starts, ends, i):
            counts[i], begins[i] = -1, False
            continue
        px, py, pz = into_tree(blob, ints, starts[i, 0], starts[i, 1], starts[i, 2])
        ex, ey, ez = into_tree(blob, ints, ends[i, 0], ends[i, 1], ends[i, 2])
        begins[i], count = follow_segment(
            blob, ints, tab, 0, px, py, pz, ex, ey, ez, resolution, tolerance, False, ts[used:], work, slots, pending
        )
        if count > ts.shape[0] - used:
            return i, used
        counts[i] = count
        used += count
    return starts.shape[0], used


@njit(cache=True, nogil=True, error_model="numpy")
def first_exits(blob, root, centre, rays, resolution, tolerance, out):
    """Fill (n,) share of the first exit of rays (n, 3) from a centre (3,), tree frame, out of the solid of node `root`.

    0 where the centre is outside; 1 where a ray never leaves.
    """
    ints, tab = integers(blob), tables(blob)
    work, slots, pending = scratch()
    t = np.empty(64)
    x, y, z = centre[0], centre[1], centre[2]
    for i in range(rays.shape[0]):
        inside, count = follow_segment(
            blob, ints, tab, root, x, y, z, x + rays[i, 0], y + rays[i, 1], z + rays[i, 2],
            resolution, tolerance, True, t, work, slots, pending,
        )  # fmt: skip
        out[i] = (t[0] if count > 0 else 1.0) if inside else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def first_many(blob, starts, ends, resolution, tolerance, out):
    """Fill (n,) t of the first crossing of LPS segments: NaN none, −1 not finite; return how many are not finite."""
    ints, tab = integers(blob), tables(blob)
    work, slots, pending = scratch()
    t = np.empty(64)
    bad = 0
    for i in range(starts.shape[0]):
        if not _finite(starts, ends, i):
            out[i] = -1.0
            bad += 1
            continue
        px, py, pz = into_tree(blob, ints, starts[i, 0], starts[i, 1], starts[i, 2])
        ex, ey, ez = into_tree(blob, ints, ends[i, 0], ends[i, 1], ends[i, 2])
        _, count = follow_segment(
            blob, ints, tab, 0, px, py, pz, ex, ey, ez, resolution, tolerance, True, t, work, slots, pending
        )
        out[i] = t[0] if count > 0 else np.nan
    return bad


@njit(cache=True, error_model="numpy")
def _finite(starts, ends, i):
    for k in range(3):
        if not (math.isfinite(starts[i, k]) and math.isfinite(ends[i, k])):
            return False
    return True
