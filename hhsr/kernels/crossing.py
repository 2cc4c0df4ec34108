"""All crossings of a segment with the solid, and the first (DESIGN §2, §4): the walk of the voxels, else the tree.

Entering and leaving alternate by construction, and between two outside points their number is even.
"""

import math

import numpy as np
from numba import njit

from hhsr.kernels.clipped import follow_tree, merge_touches
from hhsr.kernels.layout import VOXELS, integers, tables
from hhsr.kernels.segment import PIECES, emit
from hhsr.kernels.tree import into_tree
from hhsr.kernels.unmanaged import unmanaged
from hhsr.kernels.voxels import solid_contains
from hhsr.kernels.walk import follow_voxels

SLOTS = 64  # pending tree nodes of one segment: three a level
MERGE = 1e-9  # mm: a leaving and an entering closer than this are one touch


@njit(cache=True, error_model="numpy")
def scratch():
    """Return (work, slots, pending): what one thread needs to follow segments."""
    return np.empty((PIECES + 1, 8)), np.empty((SLOTS, 2)), np.empty(SLOTS, dtype=np.int64)


@unmanaged
def follow_segment(
    blob, ints, tab, root, px, py, pz, ex, ey, ez, resolution, tolerance, first, out, work, slots, pending
):
    """Return (start state, count) of the segment p → e in the tree's frame and the solid of node `root`.

    t of each change of state goes to `out`. Where the voxels prove the state nothing else is asked.

    first: stop after the first crossing. A count above out.size says how much room is needed.
    """
    dx, dy, dz = ex - px, ey - py, ez - pz
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    if length == 0.0:
        return solid_contains(blob, ints, tab, root, px, py, pz), np.int64(0)
    gap = MERGE / length
    if root == 0 and ints[VOXELS] != 0:
        return follow_voxels(
            blob, ints, tab, px, py, pz, ex, ey, ez, length, gap, resolution, tolerance, first, out, work, slots,
            pending,
        )  # fmt: skip
    begin = solid_contains(blob, ints, tab, root, px, py, pz)
    state, count, done = follow_tree(
        blob, ints, tab, root, px, py, pz, dx, dy, dz, 0.0, 1.0, gap, resolution, tolerance, first, begin, out,
        np.int64(0), work, slots, pending,
    )  # fmt: skip
    if not done and count <= out.shape[0]:
        _, count = emit(state, solid_contains(blob, ints, tab, root, ex, ey, ez), 1.0, out, count)
        count = merge_touches(out, count, gap)
    return begin, count


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
            blob, ints, tab, np.int64(0), px, py, pz, ex, ey, ez, resolution, tolerance, np.bool_(False), ts[used:],
            work, slots, pending,
        )  # fmt: skip
        if count > ts.shape[0] - used:
            return i, used
        counts[i] = count
        used += count
    return starts.shape[0], used


@njit(cache=True, nogil=True, error_model="numpy")
def place_many(starts, ends, order, begins, found, offsets, t, points, entering):
    """Fill t (m,), points (m, 3) and entering (m,) of the crossings that were found (m,) of segments (n, 3) → (n, 3).

    order: (n,) the row of the answers that each segment is for; begins: (n,) whether it starts inside. offsets:
    (n + 1,) where each row's crossings begin.
    """
    used = 0
    for row in range(starts.shape[0]):
        inside = begins[row]
        for k in range(offsets[order[row]], offsets[order[row] + 1]):
            inside = not inside
            t[k], entering[k] = found[used], inside
            for c in range(3):
                points[k, c] = starts[row, c] + t[k] * (ends[row, c] - starts[row, c])
            used += 1


@njit(cache=True, error_model="numpy")
def cross_one(blob, ax, ay, az, bx, by, bz, resolution, tolerance, offsets, t, points, entering):
    """Follow one LPS segment; return how many crossings it has, −1 where not finite or more than t (k,) holds.

    Fills offsets (2,), t, points (k, 3), entering (k + 1,), the last of it true: all that `Crossings` holds.
    """
    ints, tab = integers(blob), tables(blob)
    if not math.isfinite(ax + ay + az + bx + by + bz):
        return -1
    work, slots, pending = scratch()
    px, py, pz = into_tree(blob, ints, ax, ay, az)
    ex, ey, ez = into_tree(blob, ints, bx, by, bz)
    inside, count = follow_segment(
        blob, ints, tab, np.int64(0), px, py, pz, ex, ey, ez, resolution, tolerance, np.bool_(False), t, work, slots,
        pending,
    )  # fmt: skip
    if count > t.shape[0]:
        return -1
    offsets[0], offsets[1] = 0, count
    entering[t.shape[0]] = True
    for k in range(count):
        inside = not inside
        entering[k] = inside
        points[k, 0], points[k, 1] = ax + t[k] * (bx - ax), ay + t[k] * (by - ay)
        points[k, 2] = az + t[k] * (bz - az)
    return count


@njit(cache=True, error_model="numpy")
def first_one(blob, ax, ay, az, bx, by, bz, resolution, tolerance):
    """Return t of the first crossing of one LPS segment: NaN none, −1 not finite."""
    ints, tab = integers(blob), tables(blob)
    if not math.isfinite(ax + ay + az + bx + by + bz):
        return -1.0
    work, slots, pending = scratch()
    t = np.empty(64)
    px, py, pz = into_tree(blob, ints, ax, ay, az)
    ex, ey, ez = into_tree(blob, ints, bx, by, bz)
    _, count = follow_segment(
        blob, ints, tab, np.int64(0), px, py, pz, ex, ey, ez, resolution, tolerance, np.bool_(True), t, work, slots,
        pending,
    )  # fmt: skip
    return t[0] if count > 0 else np.nan


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
            resolution, tolerance, np.bool_(True), t, work, slots, pending,
        )  # fmt: skip
        out[i] = (t[0] if count > 0 else 1.0) if inside else 0.0


@njit(cache=True, nogil=True, error_model="numpy")
def first_many(blob, starts, ends, order, resolution, tolerance, out):
    """Fill (n,) t of the first crossing of LPS segments (m, 3): NaN none, −1 not finite.

    order: (m,) the row of the answers that each is for. Returns how many are not finite.
    """
    ints, tab = integers(blob), tables(blob)
    work, slots, pending = scratch()
    t = np.empty(64)
    bad = 0
    for i in range(starts.shape[0]):
        if not _finite(starts, ends, i):
            out[order[i]] = -1.0
            bad += 1
            continue
        px, py, pz = into_tree(blob, ints, starts[i, 0], starts[i, 1], starts[i, 2])
        ex, ey, ez = into_tree(blob, ints, ends[i, 0], ends[i, 1], ends[i, 2])
        _, count = follow_segment(
            blob, ints, tab, np.int64(0), px, py, pz, ex, ey, ez, resolution, tolerance, np.bool_(True), t, work,
            slots, pending,
        )  # fmt: skip
        out[order[i]] = t[0] if count > 0 else np.nan
    return bad


@unmanaged
def _finite(starts, ends, i):
    for k in range(3):
        if not (math.isfinite(starts[i, k]) and math.isfinite(ends[i, k])):
            return False
    return True
