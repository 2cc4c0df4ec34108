"""The runs of many segments, settled in the order of the tables that they need, those of one block at once."""

import math

import numpy as np

from hhsr.kernels.layout import BLOCKS_PER_SIDE, MAP_START, OWNER_COUNT, VOXELS
from hhsr.kernels.runs import (
    ANSWER_COUNT,
    ANSWER_NEXT,
    ANSWER_PLACE,
    CODE,
    HALVINGS,
    KEY_SHIFT,
    MONOTONE,
    NEXT,
    OWN,
    OWNER,
    RUN_BEND,
    ask_for_block,
    ask_for_cells,
    ask_for_record,
    key_of,
    make_ready,
    owner_of,
)
from hhsr.kernels.settle_run import settle_run
from hhsr.kernels.smooth_runs import improve_together
from hhsr.kernels.surfel import PLANE_SIZE
from hhsr.kernels.unmanaged import inlined, unmanaged
from hhsr.kernels.vectors import LANES
from hhsr.kernels.voxels import DETAILS, PLANES

ROOM = 64  # crossings of one run
# Instead of a count: a segment that is not finite; one that has no room here, of a solid without a grid, of one of
# gigabytes, or with JIT off.
NOT_FINITE, MANY = -1, -2
AHEAD = 2  # runs whose cells are asked for before they are settled
FAR_AHEAD = 16  # … whose records are
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
        end = 2 * (ints[record + DETAILS] + 2 * ints[MAP_START])  # details follow planes; in 16-bit numbers
        surfels = (end - ints[record + PLANES]) // PLANE_SIZE
    return _blocks(ints) + (surfels >> KEY_SHIFT) + 1


@inlined
def _is_smooth(runs, run):
    kind = int(runs[run, CODE]) & 7
    return (kind == MONOTONE or kind == OWN) and runs[run, RUN_BEND] < math.inf


@inlined
def _key(runs, run, blocks):
    key = key_of(runs, run)
    return BLOCKS_OF_A_LEAF * owner_of(runs, run) + key if _is_smooth(runs, run) else blocks + key


@unmanaged
def order_runs(blob, ints, runs, used, bins, order, answers):
    """Make runs ready and put their numbers in order: smooth ones by their blocks, then the others by their surfels.

    order: (used,) and more; bins: (most_keys,) scratch. Returns how many are smooth: of one leaf, with a known bend.
    answers: (used, ANSWER_SIZE), of each the next one is filled in, and its key for now.
    """
    blocks, total = _blocks(ints), 0
    bins[:] = 0
    for run in range(used):
        make_ready(blob, ints, runs, np.int64(run))
        key = _key(runs, run, blocks)
        answers[run, ANSWER_PLACE], answers[run, ANSWER_NEXT] = key, int(runs[run, NEXT])
        bins[key] += 1
    for key in range(bins.shape[0]):
        total, bins[key] = total + bins[key], total
    smooth = bins[blocks]
    for run in range(used):
        key = answers[run, ANSWER_PLACE]
        order[bins[key]] = run
        bins[key] += 1
    return np.int64(smooth)


@unmanaged
def settle_smooth(blob, ints, tab, runs, used, order, smooth, later, tolerance, found, rows, answers):
    """Settle the smooth runs, the first of the order, some at a time, in rounds: what one leaves open is the next's.

    found: (k,) with room for all their crossings. Those that cannot be settled so are put behind the order's others;
    returns where these end, and how many slots of found are used. later: (2, most) scratch (`most_runs`).
    """
    place, lost, todo, others = np.int64(0), np.int64(used) - smooth, smooth, order[smooth:]
    now, then = later[0], later[1]
    for q in range(smooth):
        now[q] = order[q]
    while todo > 0:
        k = left = np.int64(0)
        while k < todo:
            m = np.int64(1)
            while m < LANES and k + m < todo and runs[now[k + m], OWNER] == runs[now[k], OWNER]:
                m += 1
            for q in range(k + FAR_AHEAD, min(k + m + FAR_AHEAD, todo)):
                ask_for_record(runs, now[q])
            if k + m < todo:
                ask_for_block(blob, ints, runs, now[k + m])
            used, left, lost, place = improve_together(
                blob, ints, tab, runs, used, now, k, m, then, left, others, lost, tolerance, rows, found, place, answers
            )
            k += m
        todo, now, then = left, then, now
    return smooth + lost, place


@unmanaged
def most_runs(runs, used):
    """Return how many runs there may be once those of one leaf are halved: the others, and four of each of these."""
    count = used
    for run in range(used):
        count += ((1 << HALVINGS) - 1) if int(runs[run, CODE]) & 7 == OWN else 0
    return np.int64(count)


@unmanaged
def settle_others(
    blob, ints, tab, runs, order, used, begun, resolution, tolerance, found, work, slots, pending, answers
):
    """Settle runs in their order: each one's crossings go to `found`, unmerged; return False where that has no room.

    begun: (2,) how many runs are settled, slots of found used; as they were left to go on.
    """
    place = begun[1]
    for k in range(begun[0], used):
        run = np.int64(order[k])
        if k + AHEAD < used:
            ask_for_cells(ints, tab, runs, np.int64(order[k + AHEAD]))
        if k + FAR_AHEAD < used:
            ask_for_record(runs, order[k + FAR_AHEAD])
        if place + ROOM > found.shape[0]:
            begun[0], begun[1] = k, place
            return False
        count = settle_run(
            blob, ints, tab, runs, run, np.int64(0), resolution, tolerance, -np.inf, found[place : place + ROOM],
            np.int64(0), work, slots, pending,
        )  # fmt: skip
        if count > ROOM:
            answers[run, ANSWER_COUNT] = -1
            continue
        answers[run, ANSWER_PLACE], answers[run, ANSWER_COUNT] = place, count
        place += count
    begun[0], begun[1] = used, place
    return True


@unmanaged
def gather_crossings(answers, found, first, run, count, gap, ts, used):
    """Put the crossings of a segment, whose runs from `run` on are settled, into ts from `used` on; none: −1.

    Returns its count, from what the walk counted on, and how many slots of ts are used then. A leaving and an entering
    no more than `gap` apart are dropped.
    """
    base = used
    while run >= 0 and count >= 0:
        if answers[run, ANSWER_COUNT] < 0:
            return np.int64(MANY), base
        place = answers[run, ANSWER_PLACE]
        for k in range(place, place + answers[run, ANSWER_COUNT]):
            if used > base and found[k] - ts[used - 1] <= gap:
                used -= 1
            else:
                ts[used] = found[k]
                used += 1
        run = np.int64(answers[run, ANSWER_NEXT])
    if count < 0:
        return count, base
    used = min(used, base + 1) if first else used
    return np.int64(used - base), used
