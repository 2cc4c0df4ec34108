"""All crossings of a segment with the solid, and the first (DESIGN §2, §4): the walk of the voxels, else the tree.

Entering and leaving alternate by construction, and between two outside points their number is even.
"""

import math

import numpy as np
from numba import njit

from hhsr.kernels.cell_along import CELL_ROWS
from hhsr.kernels.clipped import follow_tree, merge_touches
from hhsr.kernels.lane import BEGIN, FIRST_RUN, FOUND, GAP, LAST_RUN, MERGE, ROWS, RUNS_USED, SPILLED, set_out
from hhsr.kernels.layout import VOXELS, integers, tables
from hhsr.kernels.runs import HALVINGS, RUN_SIZE
from hhsr.kernels.segment import PIECES, emit
from hhsr.kernels.settle_run import settle_run
from hhsr.kernels.tree import into_tree
from hhsr.kernels.unmanaged import entry, unmanaged
from hhsr.kernels.vectors import LANES
from hhsr.kernels.voxels import solid_contains
from hhsr.kernels.walk import go_on

SLOTS = 64  # pending tree nodes of one segment: three a level
RUNS = 64  # of one segment, before they are settled
LANE_ROWS = PIECES + ROWS
TOUCH = -2


@njit(cache=True, error_model="numpy")
def scratch():
    """Return (work, slots, pending): what one thread needs to follow segments.

    Rows of work: PIECES for bisections, ROWS for lanes, CELL_ROWS, the rest for the runs of a segment alone.
    """
    work = np.empty((LANE_ROWS + CELL_ROWS + (RUNS + HALVINGS) * RUN_SIZE // LANES, LANES))
    work[PIECES:LANE_ROWS] = 0.0
    return work, np.empty((SLOTS, 2)), np.empty(SLOTS, dtype=np.int64)


@unmanaged
def _walk(
    blob, ints, tab, px, py, pz, ex, ey, ez, length, resolution, tolerance, first, out, work, slots, pending
):  # fmt: skip
    """Return (start state, count) of a segment of some length by the walk of the voxels.

    count −1: too many runs; TOUCH: the first that it found was a touch, which is none, and there it ended.
    """
    lanes, rows = work[PIECES:LANE_ROWS], work[LANE_ROWS : LANE_ROWS + CELL_ROWS]
    runs = work[LANE_ROWS + CELL_ROWS :].reshape(RUNS + HALVINGS, RUN_SIZE)
    if not set_out(blob, ints, lanes, 0, px, py, pz, ex, ey, ez, length):
        return False, np.int64(0)
    lanes[RUNS_USED, 0] = 0.0
    gap, count, done = lanes[GAP, 0], np.int64(0), False
    while not done:
        done = go_on(blob, ints, tab, lanes, np.int64(0), first, np.bool_(True), runs[:RUNS])
        if lanes[SPILLED, 0] > 0.0:
            return False, np.int64(-1)
        for run in range(int(lanes[RUNS_USED, 0])):
            count = settle_run(
                blob, ints, tab, runs, np.int64(run), np.int64(RUNS), resolution, tolerance, gap, out, count, work,
                slots, pending, rows,
            )  # fmt: skip
        lanes[RUNS_USED, 0], lanes[FIRST_RUN, 0], lanes[LAST_RUN, 0] = 0.0, -1.0, -1.0
    if first:
        count = min(count, np.int64(1)) if count > 0 or lanes[FOUND, 0] == np.inf else np.int64(TOUCH)
    return lanes[BEGIN, 0] > 0.0, count


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
        begin, count = _walk(
            blob, ints, tab, px, py, pz, ex, ey, ez, length, resolution, tolerance, first, out, work, slots, pending
        )
        if count == TOUCH:
            begin, count = _walk(
                blob, ints, tab, px, py, pz, ex, ey, ez, length, resolution, tolerance, np.bool_(False), out, work,
                slots, pending,
            )  # fmt: skip
        if count >= 0:
            return begin, min(count, np.int64(1)) if first else count
    begin = solid_contains(blob, ints, tab, root, px, py, pz)
    state, count, done = follow_tree(
        blob, ints, tab, root, px, py, pz, dx, dy, dz, 0.0, 1.0, gap, resolution, tolerance, first, begin, out,
        np.int64(0), work, slots, pending,
    )  # fmt: skip
    if not done and count <= out.shape[0]:
        _, count = emit(state, solid_contains(blob, ints, tab, root, ex, ey, ez), 1.0, out, count)
        count = merge_touches(out, count, gap)
    return begin, count


@njit(cache=True, error_model="numpy")
def cross_one(blob, ax, ay, az, bx, by, bz, resolution, tolerance, t, points):
    """Follow one LPS segment and fill t (k,) and points (k, 3) with its crossings, in order.

    Return twice their number, one more where it starts inside; −1 where not finite or more than t holds.
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
    for k in range(count):
        points[k, 0], points[k, 1] = ax + t[k] * (bx - ax), ay + t[k] * (by - ay)
        points[k, 2] = az + t[k] * (bz - az)
    return 2 * count + (1 if inside else 0)


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


@entry
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
