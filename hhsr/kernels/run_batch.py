"""The runs of many segments, settled in the order of the voxels they lie in: neighbours read the same tables."""

import numpy as np

from hhsr.kernels.cell_along import AGAIN, ASKED, AT, EXCESS, EXCESS_STRAY, KNOWN, ONCE, RUN, SURE, settle_by_cells
from hhsr.kernels.layout import LANES, MAP_START, VOXELS
from hhsr.kernels.runs import (
    ANSWER_COUNT,
    ANSWER_NEXT,
    ANSWER_PLACE,
    CODE,
    GUESS,
    HALVINGS,
    KEY_SHIFT,
    NEXT,
    OWN,
    RUN_BEND,
    ask_for_record,
    is_smooth,
    key_of,
)
from hhsr.kernels.settle_run import settle_other
from hhsr.kernels.smooth_runs import (
    CLEAR,
    CROSSED,
    HALVED_IN,
    LOST,
    OPEN,
    ask_formulas,
    ask_value,
    give,
    halve,
    part,
    take_over,
)
from hhsr.kernels.surfel import PLANE_SIZE
from hhsr.kernels.unmanaged import inlined, unmanaged
from hhsr.kernels.voxels import DETAILS, PLANES

ROOM = 64  # crossings of one run
# Instead of a count: a segment that is not finite; one that has no room here, of a solid without a grid, of one of
# gigabytes, or with JIT off.
NOT_FINITE, MANY = -1, -2
FAR_AHEAD = 16  # runs whose records are asked for before they are settled


@unmanaged
def _keys(ints):
    """Return how many keys of runs there are: one for each 2^KEY_SHIFT surfels."""
    record, surfels = ints[VOXELS], np.int64(0)
    if record != 0:
        end = 2 * (ints[record + DETAILS] + 2 * ints[MAP_START])  # details follow planes; in 16-bit numbers
        surfels = (end - ints[record + PLANES]) // PLANE_SIZE
    return (surfels >> KEY_SHIFT) + 1


@unmanaged
def most_keys(ints):
    """Return how many keys there are of smooth runs and of others together."""
    return 2 * _keys(ints)


@unmanaged
def order_runs(ints, runs, used, bins, order, answers):
    """Put the numbers of runs in the order of their keys: smooth ones, then the others. Returns how many are smooth.

    order: (used,) and more; bins: (most_keys,) scratch. answers: (used, ANSWER_SIZE), of each the next run is filled
    in, and its key for now.
    """
    keys, total = _keys(ints), 0
    bins[:] = 0
    for run in range(used):
        key = key_of(runs, run) + (0 if is_smooth(runs, run) else keys)
        answers[run, ANSWER_PLACE], answers[run, ANSWER_NEXT] = key, int(runs[run, NEXT])
        bins[key] += 1
    for key in range(bins.shape[0]):
        total, bins[key] = total + bins[key], total
    smooth = bins[keys]
    for run in range(used):
        key = answers[run, ANSWER_PLACE]
        order[bins[key]] = run
        bins[key] += 1
    return np.int64(smooth)


@unmanaged
def most_runs(runs, used):
    """Return how many runs there may be once those of one leaf are halved: the others, and four of each of these."""
    count = used
    for run in range(used):
        count += ((1 << HALVINGS) - 1) if int(runs[run, CODE]) & 7 == OWN else 0
    return np.int64(count)


@inlined
def _answer(answers, found, run, place, t, crossed):
    """Keep the answer of a run that crosses at t, or nowhere; return where the next one goes."""
    found[place] = t
    answers[run, ANSWER_PLACE], answers[run, ANSWER_COUNT] = place, 1 if crossed else 0
    return place + (1 if crossed else 0)


@inlined
def _put(runs, run, verdict, used, later, left, others, lost, answers):
    """Put a run that has no answer yet where it goes: halves, of which one is the record `used`, are later ones.

    Returns (used, left, lost). later, others: (n,), their ends left and lost.
    """
    if verdict == LOST:
        runs[run, RUN_BEND] = np.inf
        others[lost] = run
        return used, left, lost + 1
    halve(runs, run, used, verdict == HALVED_IN)
    answers[used, ANSWER_NEXT], answers[run, ANSWER_NEXT] = answers[run, ANSWER_NEXT], used
    later[left], later[left + 1] = run, used
    return used + 1, left + 2, lost


@unmanaged
def settle_smooth(blob, ints, tab, runs, used, order, smooth, later, given, tolerance, found, rows, answers):
    """Settle the smooth runs, the first of the order, in rounds: halves of one are runs of the next.

    found: (k,) with room for all their crossings. Those that cannot be settled so are put behind the order's others;
    returns where these end, and how many slots of found are used. later: (4, most + 1), given: (most + 1, LANES)
    scratch (`most_runs`): the runs of this round and of the next, those of which a value is asked, and a slope too.
    """
    place, lost, todo, others = np.int64(0), np.int64(used) - smooth, smooth, order[smooth:]
    now, then, exact, hard = later[0], later[1], later[2], later[3]
    for q in range(smooth):
        now[q] = order[q]
    while todo > 0:
        left = asked = hardest = np.int64(0)
        for k in range(0, todo, LANES):
            for q in range(k + FAR_AHEAD, min(k + FAR_AHEAD + LANES, todo)):
                ask_for_record(runs, now[q])
            for lane in range(LANES):
                rows[RUN, lane] = now[min(k + lane, todo - 1)]
            settle_by_cells(rows, runs, blob, ints, tab, tolerance)
            for lane in range(min(LANES, todo - k)):
                run, known = np.int64(now[k + lane]), rows[KNOWN, lane]
                take_over(runs, run, rows, lane)
                # Nothing predicts these, so that they are no branches.
                place = _answer(answers, found, run, place, rows[AT, lane], known == SURE)
                exact[asked] = run
                give(rows, lane, given, asked)
                asked += 1 if known == ONCE else 0
                then[left] = run
                left += 1 if known == AGAIN else 0
                if known == ASKED:
                    verdict = part(runs, run, rows[EXCESS, lane], rows[EXCESS_STRAY, lane])
                    if verdict == OPEN:
                        hard[hardest] = run
                        hardest += 1
                    else:
                        used, left, lost = _put(runs, run, verdict, used, then, left, others, lost, answers)
        for k in range(asked):
            run = np.int64(exact[k])
            if k + FAR_AHEAD < asked:
                ask_for_record(runs, exact[k + FAR_AHEAD])
            if ask_value(blob, runs, run, given, k, tolerance) == CROSSED:
                place = _answer(answers, found, run, place, runs[run, GUESS], True)
            else:
                hard[hardest] = run
                hardest += 1
        for k in range(hardest):
            run = np.int64(hard[k])
            verdict = ask_formulas(blob, ints, runs, run, tolerance)
            if verdict == CROSSED or verdict == CLEAR:
                place = _answer(answers, found, run, place, runs[run, GUESS], verdict == CROSSED)
            else:
                used, left, lost = _put(runs, run, verdict, used, then, left, others, lost, answers)
        todo, now, then = left, then, now
    return smooth + lost, place


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
        if k + FAR_AHEAD < used:
            ask_for_record(runs, order[k + FAR_AHEAD])
        if place + ROOM > found.shape[0]:
            begun[0], begun[1] = k, place
            return False
        count = settle_other(
            blob, ints, tab, runs, run, resolution, tolerance, -np.inf, found[place : place + ROOM], np.int64(0), work,
            slots, pending,
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
    no more than `gap` apart are dropped. MANY: or where the walk ended at the first, and that is dropped.
    """
    base, dropped = used, False
    while run >= 0 and count >= 0:
        if answers[run, ANSWER_COUNT] < 0:
            return np.int64(MANY), base
        place = answers[run, ANSWER_PLACE]
        for k in range(place, place + answers[run, ANSWER_COUNT]):
            if used > base and found[k] - ts[used - 1] <= gap:
                used, dropped = used - 1, True
            else:
                ts[used] = found[k]
                used += 1
        run = np.int64(answers[run, ANSWER_NEXT])
    if count < 0:
        return count, base
    if first:
        if dropped and used == base:
            return np.int64(MANY), base
        used = min(used, base + 1)
    return np.int64(used - base), used
