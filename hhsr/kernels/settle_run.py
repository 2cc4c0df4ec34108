"""How a single run is settled."""

import math

import numpy as np

from hhsr.kernels.cell_along import AGAIN, ASKED, EXCESS, EXCESS_STRAY, GIVEN, KNOWN, ONCE, RUN, SURE, settle_by_cells
from hhsr.kernels.chart_walk import follow_cells
from hhsr.kernels.clipped import follow_tree, merge_touches
from hhsr.kernels.lane import MERGE
from hhsr.kernels.layout import LANES
from hhsr.kernels.runs import (
    AFTER,
    BEFORE,
    CLIPPED,
    CODE,
    GUESS,
    LEAST,
    MOST,
    OWN,
    POINT,
    RISES,
    RUN_BEGIN,
    RUN_END,
    RUN_FROM,
    RUN_GAP,
    RUN_SIZE,
    RUN_TO,
    is_smooth,
    leaf_of,
)
from hhsr.kernels.smooth_runs import (
    CLEAR,
    CROSSED,
    HALVED_IN,
    HALVED_OUT,
    LOST,
    OPEN,
    ask_formulas,
    ask_value,
    give,
    halve,
    part,
    take_over,
)
from hhsr.kernels.stretch import change, root_by_values
from hhsr.kernels.unmanaged import inlined, unmanaged


@inlined
def _follow(blob, ints, tab, runs, run, resolution, tolerance, gap, out, count, work):
    """Add the crossings of one leaf's run that is ready, by the leaf's cells; return how many there are then."""
    code, end = int(runs[run, CODE]), runs[run, RUN_END]
    dx, dy, dz = runs[run, RUN_TO], runs[run, RUN_TO + 1], runs[run, RUN_TO + 2]
    state, count = follow_cells(
        blob, ints, tab, leaf_of(runs, run), runs[run, RUN_FROM], runs[run, RUN_FROM + 1],
        runs[run, RUN_FROM + 2], dx, dy, dz, math.sqrt(dx * dx + dy * dy + dz * dz), runs[run, RUN_BEGIN], end,
        resolution, tolerance, gap, code & BEFORE != 0, out, count, work,
    )  # fmt: skip
    return change(state, code & AFTER != 0, end, gap, out, count)[1]


@unmanaged
def settle_other(blob, ints, tab, runs, run, resolution, tolerance, gap, out, count, work, slots, pending):
    """Add the crossings of a run that is not smooth to out (k,), `count` being there; return how many there are then.

    gap: of t, below which a leaving and an entering are one touch.
    """
    code = int(runs[run, CODE])
    kind, state, new = code & 7, code & BEFORE != 0, code & AFTER != 0
    begin, end = runs[run, RUN_BEGIN], runs[run, RUN_END]
    if kind == POINT:
        return change(state, new, begin, gap, out, count)[1]
    if kind == OWN:
        return _follow(blob, ints, tab, runs, run, resolution, tolerance, gap, out, count, work)
    px, py, pz = runs[run, RUN_FROM], runs[run, RUN_FROM + 1], runs[run, RUN_FROM + 2]
    dx, dy, dz = runs[run, RUN_TO], runs[run, RUN_TO + 1], runs[run, RUN_TO + 2]
    if kind == CLIPPED:
        state, count, _ = follow_tree(
            blob, ints, tab, np.int64(0), px, py, pz, dx - px, dy - py, dz - pz, begin, end, gap, resolution, tolerance,
            np.bool_(False), state, out, count, work, slots, pending,
        )  # fmt: skip
        state, count = change(state, new, end, gap, out, count)
        return merge_touches(out, count, gap)
    t = root_by_values(
        blob, ints, leaf_of(runs, run), px, py, pz, dx, dy, dz, begin, end, runs[run, GUESS], code & RISES != 0,
        runs[run, LEAST], runs[run, MOST], tolerance * (runs[run, RUN_GAP] / MERGE),
    )  # fmt: skip
    return change(state, new, t, gap, out, count)[1]


@inlined
def ask_cells(blob, ints, tab, runs, first, used, tolerance, rows):
    """Ask the cells of the runs from `first` on, LANES at most of `used`: rows (CELL_ROWS, LANES), a lane each."""
    for lane in range(LANES):
        rows[RUN, lane] = min(first + lane, used - 1)
    settle_by_cells(rows, runs, blob, ints, tab, tolerance)


@inlined
def _told(blob, ints, runs, run, rows, lane, tolerance):
    """Return what is known of a smooth run after its cell was asked; OPEN: another cell is to be."""
    known = rows[KNOWN, lane]
    take_over(runs, run, rows, lane)
    if known == AGAIN:
        return OPEN
    verdict = CROSSED if known == SURE else CLEAR
    if known == ASKED:
        verdict = part(runs, run, rows[EXCESS, lane], rows[EXCESS_STRAY, lane])
    elif known == ONCE:
        give(rows, lane, rows, np.int64(GIVEN))
        verdict = ask_value(blob, runs, run, rows, np.int64(GIVEN), tolerance)
    return ask_formulas(blob, ints, runs, run, tolerance) if verdict == OPEN else verdict


@unmanaged
def settle_run(
    blob, ints, tab, runs, run, spare, resolution, tolerance, gap, out, count, work, slots, pending, rows, lane, more
):  # fmt: skip
    """Do what `settle_other` does for a run alone, of any kind, whose cell was asked in a lane of rows, if it has one.

    spare: from this record on HALVINGS are free, for halves that wait. more: (CELL_ROWS, LANES) scratch.
    """
    if not is_smooth(runs, run):
        return settle_other(blob, ints, tab, runs, run, resolution, tolerance, gap, out, count, work, slots, pending)
    waiting, verdict = np.int64(0), _told(blob, ints, runs, run, rows, lane, tolerance)
    while True:
        code = int(runs[run, CODE])
        if verdict == HALVED_IN or verdict == HALVED_OUT:
            halve(runs, run, spare + waiting, verdict == HALVED_IN)
            waiting += 1
        elif verdict != OPEN:
            if verdict == LOST:
                count = _follow(blob, ints, tab, runs, run, resolution, tolerance, gap, out, count, work)
            else:
                count = change(code & BEFORE != 0, code & AFTER != 0, runs[run, GUESS], gap, out, count)[1]
            if waiting == 0:
                return count
            waiting -= 1
            for k in range(RUN_SIZE):
                runs[run, k] = runs[spare + waiting, k]
        ask_cells(blob, ints, tab, runs, run, run + 1, tolerance, more)
        verdict = _told(blob, ints, runs, run, more, np.int64(0), tolerance)
