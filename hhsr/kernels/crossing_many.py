"""All crossings of many segments, or the first: some at a time, each in a lane, by the same walk as one alone.

Most of a walk waits for what it reads. So all lanes take their strides together (`hhsr.kernels.stride`), until some
have none; those go on alone to where they have again, and one that is at its end makes room for the next segment. Their
runs are settled later, some thousands together, in the order of the voxels they lie in: they read the same cells and
centres.
"""

import math

import numpy as np
from numba import config, njit

from hhsr.kernels.along import ALONG_ROWS
from hhsr.kernels.crossing import scratch
from hhsr.kernels.lane import (
    BEGIN,
    FIRST_RUN,
    FOUND,
    GAP,
    LEFT_AT,
    ROWS,
    RUNS_USED,
    SEGMENT,
    SPILLED,
    STATE,
    STOP,
    T,
    set_out,
)
from hhsr.kernels.layout import VOXELS, integers, tables
from hhsr.kernels.run_batch import (
    MANY,
    NOT_FINITE,
    ROOM,
    gather_crossings,
    most_keys,
    order_runs,
    settle_others,
    settle_smooth,
)
from hhsr.kernels.runs import RUN_SIZE
from hhsr.kernels.segment import PIECES
from hhsr.kernels.stride import stride
from hhsr.kernels.tree import into_tree
from hhsr.kernels.unmanaged import inlined, unmanaged
from hhsr.kernels.vectors import LANES, bits_set, lowest_bit
from hhsr.kernels.voxels import BASES, BRICK_PLANES, BRICKS, BYTES, DETAILS, PLANES, solid_contains
from hhsr.kernels.walk import SPARE, cross_voxel, go_on

WAITING = 3  # so many lanes are without a stride when the others wait for them
TOGETHER = 16_384  # segments whose runs are settled together
ROW, LIVE = 0, 1
ALL_LANES = 2**LANES - 1
# Of a blob: strides count its bytes in 32 bits; interpreted there are none.
MOST_SLOTS = 0 if config.DISABLE_JIT else 2**28  # type: ignore[attr-defined]


@inlined
def _next_segment(blob, ints, tab, lanes, lane, starts, ends, row, stop, counts, begins, places):
    """Give a lane the next segment, from a row on to `stop`, that meets the grid; return the row after it.

    Those before it are settled: counts, begins, and places: −1, no runs.
    """
    while row < stop:
        i = row
        row += 1
        counts[i], begins[i], places[i] = 0, False, -1
        ax, ay, az, bx, by, bz = starts[i, 0], starts[i, 1], starts[i, 2], ends[i, 0], ends[i, 1], ends[i, 2]
        finite = math.isfinite(ax) and math.isfinite(ay) and math.isfinite(az)
        if not (finite and math.isfinite(bx) and math.isfinite(by) and math.isfinite(bz)):
            counts[i] = NOT_FINITE
            continue
        px, py, pz = into_tree(blob, ints, ax, ay, az)
        ex, ey, ez = into_tree(blob, ints, bx, by, bz)
        dx, dy, dz = ex - px, ey - py, ez - pz
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length == 0.0:
            begins[i] = solid_contains(blob, ints, tab, np.int64(0), px, py, pz)
        elif ints[VOXELS] == 0 or blob.shape[0] > MOST_SLOTS:
            counts[i] = MANY
        elif set_out(blob, ints, lanes, lane, px, py, pz, ex, ey, ez, length):
            lanes[SEGMENT, lane] = i
            return row
    lanes[SEGMENT, lane], lanes[STOP, lane], lanes[T, lane] = -1.0, -1.0, 0.0
    return row


@inlined
def _strode_to_end(lanes, lane):
    """Return whether a stride took a lane to its end in a state that holds there: outside, where it leaves the grid."""
    t, stop = lanes[T, lane], lanes[STOP, lane]
    return t >= stop and t != lanes[LEFT_AT, lane] and (stop >= 1.0 or lanes[STATE, lane] == 0.0)


@unmanaged
def _side_by_side(blob, ints, tab, starts, ends, stop, first, counts, begins, places, runs, begun, work):
    """Walk segments up to row `stop` in the lanes until all are at their ends, or return False: runs have no room.

    begun: (2,) the row of the next segment, lanes under way; as they were left to go on. places: the first run of each.
    """
    c = ints[VOXELS]
    lanes, words = work[PIECES : PIECES + ROWS], blob.view(np.int32)
    nx, ny, nz, bricks, bases = ints[c], ints[c + 1], ints[c + 2], ints[c + BRICKS], ints[c + BASES]
    octets = ints[c + BYTES]
    brick_planes, planes, details = ints[c + BRICK_PLANES], ints[c + PLANES], ints[c + DETAILS]
    row, live = begun[ROW], begun[LIVE]
    if live == 0:
        for lane in range(LANES):
            row = _next_segment(blob, ints, tab, lanes, lane, starts, ends, row, stop, counts, begins, places)
            live += 1 if lanes[SEGMENT, lane] >= 0.0 else 0
    while live > 0:
        if lanes[RUNS_USED, 0] + SPARE > runs.shape[0]:
            begun[ROW], begun[LIVE] = row, live
            return False
        while True:
            taken = stride(lanes, words, tab, nx, ny, nz, bricks, bases, octets, brick_planes, planes, details)
            going = bits_set(taken)
            if going == 0 or going <= live - WAITING:
                break
        waiting = ALL_LANES & ~taken
        while waiting != 0:
            lane = lowest_bit(waiting)
            waiting &= waiting - 1
            i = np.int64(lanes[SEGMENT, lane])
            if i < 0:
                continue
            if cross_voxel(ints, tab, lanes, np.int64(lane), runs):
                if not (first and lanes[T, lane] > lanes[FOUND, lane] + lanes[GAP, lane]):
                    continue
            elif not _strode_to_end(lanes, lane) and not go_on(
                blob, ints, tab, lanes, np.int64(lane), first, np.bool_(False), runs
            ):
                continue
            begins[i], places[i] = lanes[BEGIN, lane] > 0.0, np.int64(lanes[FIRST_RUN, lane])
            counts[i] = MANY if lanes[SPILLED, lane] > 0.0 else 0
            row = _next_segment(blob, ints, tab, lanes, lane, starts, ends, row, stop, counts, begins, places)
            live -= 1 if lanes[SEGMENT, lane] < 0.0 else 0
    begun[ROW], begun[LIVE] = row, 0
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _longer(table):
    """Return a table with as much room again, and more, behind its rows."""
    out = np.empty((2 * table.shape[0] + LANES * ROOM, *table.shape[1:]))
    out[: table.shape[0]] = table
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def cross_many(blob, starts, ends, first, resolution, tolerance, counts, begins, places):
    """Return (m,) t of the crossings of LPS segments (n, 3) → (n, 3), each segment's in order.

    first: of the first crossing of each, at most. counts: (n,) crossings of each, NOT_FINITE, or MANY: to be followed
    alone. begins: (n,) whether it starts inside. places: (n,) where its crossings begin among all, if there are any.
    """
    ints, tab = integers(blob), tables(blob)
    work, slots, pending = scratch()
    n = starts.shape[0]
    runs = np.empty((2 * min(n, TOGETHER) + 8 * SPARE, RUN_SIZE))
    found, ts, begun = np.empty(2 * ROOM), np.empty(ROOM + n), np.zeros(2, dtype=np.int64)
    rows = np.empty((ALONG_ROWS, LANES))
    bins, used, row = np.empty(most_keys(ints), dtype=np.int32), 0, 0
    while row < n:
        stop = min(row + TOGETHER, n)
        begun[ROW], begun[LIVE] = row, 0
        work[PIECES + RUNS_USED, 0] = 0.0
        while not _side_by_side(blob, ints, tab, starts, ends, stop, first, counts, begins, places, runs, begun, work):
            runs = _longer(runs)
        kept = int(work[PIECES + RUNS_USED, 0])
        order = np.empty(kept, dtype=np.int32)
        smooth = order_runs(blob, ints, runs, kept, bins, order)
        while smooth > found.shape[0]:
            found = _longer(found)
        settle_smooth(blob, ints, runs, order, smooth, tolerance, found, rows)
        begun[:] = smooth
        while not settle_others(
            blob, ints, tab, runs, order, kept, begun, resolution, tolerance, found, work, slots, pending
        ):
            found = _longer(found)
        while used + begun[1] > ts.shape[0]:
            ts = _longer(ts)
        used = gather_crossings(runs, found, first, row, stop, counts, places, ts, used)
        row = stop
    return ts[:used]
