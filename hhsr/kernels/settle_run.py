"""How a single run is settled."""

import math

import numpy as np

from hhsr.kernels.cell_along import AGAIN, ASKED, EXCESS, EXCESS_STRAY, GIVEN, KNOWN, ONCE, RUN, SURE, settle_by_cell
from hhsr.kernels.chart_walk import follow_cells
from hhsr.kernels.clipped import follow_tree, merge_touches
from hhsr.kernels.lane import MERGE
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
    """Add the crossings of one leaf's run, by the leaf's cells; return how many there are then."""
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
def _told(blob, ints, tab, runs, run, rows, tolerance):
    """Return what is known of a smooth run after its cell was asked; OPEN: another cell is to be."""
    rows[RUN, 0] = run
    settle_by_cell(rows, runs, blob, ints, tab, tolerance)
    known = rows[KNOWN, 0]
    take_over(runs, run, rows, np.int64(0))
    if known == AGAIN:
        return OPEN
    verdict = CROSSED if known == SURE else CLEAR
    if known == ASKED:
        verdict = part(runs, run, rows[EXCESS, 0], rows[EXCESS_STRAY, 0])
    elif known == ONCE:
        give(rows, np.int64(0), rows, np.int64(GIVEN))
        verdict = ask_value(blob, runs, run, rows, np.int64(GIVEN), tolerance)
    return ask_formulas(blob, ints, runs, run, tolerance) if verdict == OPEN else verdict


@unmanaged
def settle_run(
    blob, ints, tab, runs, run, spare, resolution, tolerance, gap, out, count, work, slots, pending, rows
):  # fmt: skip
    """Do what `settle_other` does for a run alone, of any kind.

    spare: from this record on HALVINGS are free, for halves that wait. rows: (CELL_ROWS, LANES) scratch.
    """
    if not is_smooth(runs, run):
        return settle_other(blob, ints, tab, runs, run, resolution, tolerance, gap, out, count, work, slots, pending)
    waiting = np.int64(0)
    while True:
        verdict = _told(blob, ints, tab, runs, run, rows, tolerance)
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
