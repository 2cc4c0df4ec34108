"""All crossings of many segments, or the first: some at a time, each in a lane, by the same walk as one alone.

Most of a walk waits for what it reads. So all lanes take their strides together (`hhsr.kernels.stride`), until some
have none; those go on alone to where they have again, and one that is at its end makes room for the next segment. Their
runs are settled later, some thousands together, in the order of the voxels they lie in: they read the same cells and
centres.
"""

import math

import numpy as np
from numba import config

from hhsr.kernels.cell_along import CELL_ROWS
from hhsr.kernels.crossing import scratch
from hhsr.kernels.lane import (
    ABREAST,
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
    most_runs,
    order_runs,
    settle_others,
    settle_smooth,
)
from hhsr.kernels.runs import ANSWER_PLACE, ANSWER_SIZE, RUN_SIZE
from hhsr.kernels.stride import stride
from hhsr.kernels.tree import into_tree
from hhsr.kernels.unmanaged import entry, inlined, unmanaged
from hhsr.kernels.vectors import LANES, ask_ahead, bits_set, lowest_bit
from hhsr.kernels.voxels import BRICKS, DETAILS, PLANES, VOXELS_AT, solid_contains
from hhsr.kernels.walk import SPARE, cross_voxel, go_on

WAITING = 6  # so many lanes are without a stride when the others wait for them
TOGETHER = 3_072  # segments whose runs are settled together: so few that the second cache holds their records
AHEAD = 8  # segments that are asked for before they are begun
ROW, LIVE, FIRST_ROW, STOP_ROW = 0, 1, 2, 3
ALL_LANES = 2**ABREAST - 1
# Of a blob: strides count its bytes in 32 bits; interpreted there are none.
MOST_SLOTS = 0 if config.DISABLE_JIT else 2**28  # type: ignore[attr-defined]


@inlined
def _next_segment(blob, ints, tab, lanes, lane, starts, ends, order, row, begun, counts, begins, places):
    """Give a lane the next segment, from a row of the order on, that meets the grid; return the row after it.

    Those before it are settled: counts, begins, and places: −1, no runs. begun: of these rows the first.
    """
    stop = begun[STOP_ROW]
    while row < stop:
        i, k = order[row], row - begun[FIRST_ROW]
        if row + AHEAD < order.shape[0]:
            ahead = 3 * order[row + AHEAD]
            ask_ahead(starts, ahead)
            ask_ahead(starts, ahead + 2)
            ask_ahead(ends, ahead)
            ask_ahead(ends, ahead + 2)
        row += 1
        counts[k], begins[k], places[k] = 0, False, -1
        ax, ay, az, bx, by, bz = starts[i, 0], starts[i, 1], starts[i, 2], ends[i, 0], ends[i, 1], ends[i, 2]
        finite = math.isfinite(ax) and math.isfinite(ay) and math.isfinite(az)
        if not (finite and math.isfinite(bx) and math.isfinite(by) and math.isfinite(bz)):
            counts[k] = NOT_FINITE
            continue
        px, py, pz = into_tree(blob, ints, ax, ay, az)
        ex, ey, ez = into_tree(blob, ints, bx, by, bz)
        dx, dy, dz = ex - px, ey - py, ez - pz
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length == 0.0:
            begins[k] = solid_contains(blob, ints, tab, np.int64(0), px, py, pz)
        elif ints[VOXELS] == 0 or blob.shape[0] > MOST_SLOTS:
            counts[k] = MANY
        elif set_out(blob, ints, lanes, lane, px, py, pz, ex, ey, ez, length):
            lanes[SEGMENT, lane] = k
            return row
    lanes[SEGMENT, lane], lanes[STOP, lane], lanes[T, lane] = -1.0, -1.0, 0.0
    return row


@inlined
def _strode_to_end(lanes, lane):
    """Return whether a stride took a lane to its end in a state that holds there: outside, where it leaves the grid."""
    t, stop = lanes[T, lane], lanes[STOP, lane]
    return t >= stop and t != lanes[LEFT_AT, lane] and (stop >= 1.0 or lanes[STATE, lane] == 0.0)


@unmanaged
def _side_by_side(blob, ints, tab, starts, ends, order, first, counts, begins, places, gaps, runs, begun, lanes):
    """Walk some rows of the order in the lanes until all are at their ends, or return False: runs have no room.

    begun: (4,) the row of the next segment, lanes under way, as they were left to go on; the first row and the last.
    counts, begins, places, gaps: of these rows; places: the first run of each, gaps: the walk's GAP.
    """
    c = ints[VOXELS]
    words = blob.view(np.int32)
    nx, ny, nz, bricks, voxels = ints[c], ints[c + 1], ints[c + 2], ints[c + BRICKS], ints[c + VOXELS_AT]
    planes, details = ints[c + PLANES] >> 1, ints[c + DETAILS]
    row, live = begun[ROW], begun[LIVE]
    if live == 0:
        for lane in range(ABREAST):
            row = _next_segment(blob, ints, tab, lanes, lane, starts, ends, order, row, begun, counts, begins, places)
            live += 1 if lanes[SEGMENT, lane] >= 0.0 else 0
    while live > 0:
        if lanes[RUNS_USED, 0] + SPARE > runs.shape[0]:
            begun[ROW], begun[LIVE] = row, live
            return False
        while True:
            taken = stride(lanes, words, tab, nx, ny, nz, bricks, voxels, planes, details)
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
            if cross_voxel(blob, ints, tab, lanes, np.int64(lane), runs):
                if not (first and lanes[T, lane] > lanes[FOUND, lane] + lanes[GAP, lane]):
                    continue
            elif not _strode_to_end(lanes, lane) and not go_on(
                blob, ints, tab, lanes, np.int64(lane), first, np.bool_(False), runs
            ):
                continue
            begins[i], places[i] = lanes[BEGIN, lane] > 0.0, np.int64(lanes[FIRST_RUN, lane])
            counts[i], gaps[i] = (MANY if lanes[SPILLED, lane] > 0.0 else 0), lanes[GAP, lane]
            row = _next_segment(blob, ints, tab, lanes, lane, starts, ends, order, row, begun, counts, begins, places)
            live -= 1 if lanes[SEGMENT, lane] < 0.0 else 0
    begun[ROW], begun[LIVE] = row, 0
    return True


@inlined
def _ask_for_answer(k, size, row, order, firsts, answers, found, counts, begins, places):
    """Ask for what is read and written for the k-th of some rows, so far ahead that it is near by then."""
    if k + AHEAD < size and firsts[k + AHEAD] >= 0:
        ask_ahead(answers, ANSWER_SIZE * firsts[k + AHEAD])
    if k < size:
        i = order[row + k]
        ask_ahead(counts, i)
        ask_ahead(begins, i)
        ask_ahead(places, i)
        if firsts[k] >= 0:
            ask_ahead(found, np.int64(answers[firsts[k], ANSWER_PLACE]))


@entry
def _longer(table):
    """Return a table with as much room again, and more, behind its rows."""
    out = np.empty((2 * table.shape[0] + LANES * ROOM, *table.shape[1:]))
    out[: table.shape[0]] = table
    return out


@entry
def cross_many(blob, starts, ends, order, first, resolution, tolerance, counts, begins, places, base):
    """Follow the rows `order` of LPS segments (n, 3) → (n, 3), in that order.

    Returns (m,) t of their crossings, each segment's in order, or of the first at most, and how many are to be followed
    alone. Fills those rows of counts (n,): crossings of each, NOT_FINITE, or MANY: to be followed alone; of begins
    (n,): whether it starts inside; of places (n,): base + where its crossings begin among all, if there are any.
    """
    ints, tab = integers(blob), tables(blob)
    work, slots, pending = scratch()
    n = order.shape[0]
    some = min(n, TOGETHER)
    some_counts, some_places = np.empty(some, dtype=np.int64), np.empty(some, dtype=np.int64)
    some_begins, gaps = np.empty(some, dtype=np.bool_), np.zeros(some)
    runs = np.empty((4 * some + 8 * SPARE, RUN_SIZE))
    found, ts, begun = np.empty(2 * ROOM), np.empty(ROOM + n), np.zeros(4, dtype=np.int64)
    rows, lanes = np.empty((CELL_ROWS, LANES)), np.zeros((ROWS, ABREAST))
    bins, used, row, alone = np.empty(most_keys(ints), dtype=np.int32), 0, 0, 0
    while row < n:
        stop = min(row + TOGETHER, n)
        begun[ROW], begun[LIVE], begun[FIRST_ROW], begun[STOP_ROW] = row, 0, row, stop
        lanes[RUNS_USED, 0] = 0.0
        while not _side_by_side(
            blob, ints, tab, starts, ends, order, first, some_counts, some_begins, some_places, gaps, runs, begun, lanes
        ):
            runs = _longer(runs)
        kept = int(lanes[RUNS_USED, 0])
        most = most_runs(runs, kept)
        while runs.shape[0] < most:
            runs = _longer(runs)
        turns, answers = np.empty(2 * most, dtype=np.int32), np.empty((most, ANSWER_SIZE), dtype=np.int32)
        smooth = order_runs(ints, runs, kept, bins, turns, answers)
        while found.shape[0] <= most:
            found = _longer(found)
        later, given = np.empty((4, most + 1), dtype=np.int32), np.empty((most + 1, LANES))
        begun[0] = smooth
        kept, begun[1] = settle_smooth(
            blob, ints, tab, runs, kept, turns, smooth, later, given, tolerance, found, rows, answers
        )
        while not settle_others(
            blob, ints, tab, runs, turns, kept, begun, resolution, tolerance, found, work, slots, pending, answers
        ):
            found = _longer(found)
        while used + begun[1] > ts.shape[0]:
            ts = _longer(ts)
        for k in range(stop - row):
            _ask_for_answer(k + AHEAD, stop - row, row, order, some_places, answers, found, counts, begins, places)
            i, used_before = order[row + k], used
            counts[i], used = gather_crossings(answers, found, first, some_places[k], some_counts[k], gaps[k], ts, used)
            begins[i], places[i] = some_begins[k], base + used_before
            alone += 1 if counts[i] == MANY else 0
        row = stop
    return ts[:used], alone
