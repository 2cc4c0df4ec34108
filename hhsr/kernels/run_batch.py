"""The runs of many segments, settled in the order of the tables that they need, those of one block at once."""

import math

import numpy as np

from hhsr.kernels.layout import BLOCKS_PER_SIDE, OWNER_COUNT, VOXELS
from hhsr.kernels.runs import (
    CODE,
    KEY_SHIFT,
    MONOTONE,
    NEXT,
    OWNER,
    RUN_BEGIN,
    RUN_BEND,
    RUN_END,
    RUN_GAP,
    ask_for_cells,
    improve_together,
    key_of,
    make_ready,
    owner_of,
    settle_run,
)
from hhsr.kernels.surfel import PLANE_SIZE
from hhsr.kernels.unmanaged import inlined, unmanaged
from hhsr.kernels.vectors import LANES
from hhsr.kernels.voxels import DETAILS, PLANES

ROOM = 64  # crossings of one run
# Instead of a count: a segment that is not finite; one that has no room here, of a solid without a grid, of one of
# gigabytes, or with JIT off.
NOT_FINITE, MANY = -1, -2
AHEAD = 2  # runs whose cells are asked for before they are settled
BLOCKS_OF_A_LEAF = 6 * BLOCKS_PER_SIDE * BLOCKS_PER_SIDE


@unmanaged
def _blocks(ints):
    """Return how many blocks of directions all owners have together: keys of runs that are ready."""
    return ints[OWNER_COUNT] * BLOCKS_OF_A_LEAF


@unmanaged
def most_keys(ints):
    """Return how many keys of runs there are: one for each block of directions, one for each 2^KEY_SHIFT surfels."""
    record, surfels = ints[VOXELS], np.int64(0)
    if record != 0:
        surfels = (ints[record + DETAILS] - ints[record + PLANES]) // PLANE_SIZE
    return _blocks(ints) + (surfels >> KEY_SHIFT) + 1


@inlined
def _is_smooth(runs, run):
    return int(runs[run, CODE]) & 7 == MONOTONE and runs[run, RUN_BEND] < math.inf


@inlined
def _key(runs, run, blocks):
    key = key_of(runs, run)
    return BLOCKS_OF_A_LEAF * owner_of(runs, run) + key if _is_smooth(runs, run) else blocks + key


@unmanaged
def order_runs(blob, ints, runs, used, bins, order):
    """Make runs ready and put their numbers in order: smooth ones by their blocks, then the others by their surfels.

    order: (used,); bins: (most_keys,) scratch. Returns how many are smooth: monotone, with a bend that is known.
    """
    blocks, total = _blocks(ints), 0
    bins[:] = 0
    for run in range(used):
        if int(runs[run, CODE]) & 7 == MONOTONE:
            make_ready(blob, ints, runs, np.int64(run))
        bins[_key(runs, run, blocks)] += 1
    for key in range(bins.shape[0]):
        total, bins[key] = total + bins[key], total
    smooth = bins[blocks]
    for run in range(used):
        key = _key(runs, run, blocks)
        order[bins[key]] = run
        bins[key] += 1
    return np.int64(smooth)


@unmanaged
def settle_smooth(blob, ints, runs, order, smooth, tolerance, found, rows):
    """Settle the smooth runs, some at a time, in rounds: what one leaves open is the next one's order.

    found: (k,) with room for all their crossings.
    """
    place, todo = np.int64(0), smooth
    while todo > 0:
        k = left = np.int64(0)
        while k < todo:
            m = np.int64(1)
            while m < LANES and k + m < todo and runs[order[k + m], OWNER] == runs[order[k], OWNER]:
                m += 1
            left, place = improve_together(blob, ints, runs, order, k, m, left, tolerance, rows, found, place)
            k += m
        todo = left


@unmanaged
def settle_others(blob, ints, tab, runs, order, used, begun, resolution, tolerance, found, work, slots, pending):
    """Settle runs in their order: each one's crossings go to `found`, unmerged; return False where that has no room.

    begun: (2,) how many runs are settled, slots of found used; as they were left to go on.
    """
    place = begun[1]
    for k in range(begun[0], used):
        run = np.int64(order[k])
        if k + AHEAD < used:
            ask_for_cells(blob, ints, tab, runs, np.int64(order[k + AHEAD]))
        if place + ROOM > found.shape[0]:
            begun[0], begun[1] = k, place
            return False
        count = settle_run(
            blob, ints, tab, runs, run, resolution, tolerance, -np.inf, found[place : place + ROOM], np.int64(0), work,
            slots, pending,
        )  # fmt: skip
        if count > ROOM:
            runs[run, CODE] = -1.0
            continue
        runs[run, RUN_BEGIN], runs[run, RUN_END] = place, count
        place += count
    begun[0], begun[1] = used, place
    return True


@unmanaged
def gather_crossings(runs, found, first, row, stop, counts, places, ts, used):
    """Put the crossings of segments row … stop, whose runs are settled, into ts from `used` on; return how many slots.

    counts, places: of each, from the place of its first run. A leaving and an entering that touch are dropped.
    """
    for i in range(row, stop):
        run = places[i]
        places[i] = used
        if counts[i] < 0 or run < 0:
            continue
        gap = runs[run, RUN_GAP]
        base = used
        while run >= 0:
            if runs[run, CODE] < 0.0:
                counts[i], used = MANY, base
                break
            place = int(runs[run, RUN_BEGIN])
            for k in range(place, place + int(runs[run, RUN_END])):
                if used > base and found[k] - ts[used - 1] <= gap:
                    used -= 1
                else:
                    ts[used] = found[k]
                    used += 1
            run = int(runs[run, NEXT])
        if counts[i] >= 0:
            used = min(used, base + 1) if first else used
            counts[i] = used - base
    return used
