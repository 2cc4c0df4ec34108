"""How a single run is settled."""

import math

import numpy as np

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
    MONOTONE,
    MOST,
    POINT,
    RISES,
    RUN_BEGIN,
    RUN_BEND,
    RUN_END,
    RUN_FROM,
    RUN_GAP,
    RUN_SIZE,
    RUN_TO,
    leaf_of,
)
from hhsr.kernels.smooth_runs import HALVED_IN, HALVED_OUT, LOST, halve, settle_smooth_run
from hhsr.kernels.stretch import change, root_by_values
from hhsr.kernels.unmanaged import inlined, unmanaged


@inlined
def _follow(blob, ints, tab, runs, run, resolution, tolerance, gap, out, count, work):
    """Add the crossings of one leaf's run that is ready, by the leaf's cells; return how many there are then."""
    code, end = int(runs[run, CODE]), runs[run, RUN_END]
    dx, dy, dz = runs[run, RUN_TO], runs[run, RUN_TO + 1], runs[run, RUN_TO + 2]
    state, count = follow_cells(
        blob, ints, tab, leaf_of(ints, runs, run), runs[run, RUN_FROM], runs[run, RUN_FROM + 1],
        runs[run, RUN_FROM + 2], dx, dy, dz, math.sqrt(dx * dx + dy * dy + dz * dz), runs[run, RUN_BEGIN], end,
        resolution, tolerance, gap, code & BEFORE != 0, out, count, work,
    )  # fmt: skip
    return change(state, code & AFTER != 0, end, gap, out, count)[1]


@unmanaged
def _settle_halves(
    blob, ints, tab, runs, run, verdict, spare, resolution, tolerance, gap, out, count, work
):  # fmt: skip
    """Do what `settle_run` does for a run that is to be halved: halves that wait are kept from record `spare` on."""
    waiting = np.int64(0)
    while True:
        if verdict == HALVED_IN or verdict == HALVED_OUT:
            halve(runs, run, spare + waiting, verdict == HALVED_IN)
            waiting += 1
        else:
            code = int(runs[run, CODE])
            if verdict == LOST:
                count = _follow(blob, ints, tab, runs, run, resolution, tolerance, gap, out, count, work)
            else:
                count = change(code & BEFORE != 0, code & AFTER != 0, runs[run, GUESS], gap, out, count)[1]
            if waiting == 0:
                return count
            waiting -= 1
            for k in range(RUN_SIZE):
                runs[run, k] = runs[spare + waiting, k]
        verdict = settle_smooth_run(blob, ints, tab, runs, run, tolerance)


@unmanaged
def settle_run(blob, ints, tab, runs, run, spare, resolution, tolerance, gap, out, count, work, slots, pending):
    """Add the crossings of a run that is ready to out (k,), `count` being there; return how many there are then.

    gap: of t, below which a leaving and an entering are one touch. spare: from this record on HALVINGS are free.
    """
    code = int(runs[run, CODE])
    kind, state, new = code & 7, code & BEFORE != 0, code & AFTER != 0
    begin, end = runs[run, RUN_BEGIN], runs[run, RUN_END]
    if kind == POINT:
        return change(state, new, begin, gap, out, count)[1]
    px, py, pz = runs[run, RUN_FROM], runs[run, RUN_FROM + 1], runs[run, RUN_FROM + 2]
    dx, dy, dz = runs[run, RUN_TO], runs[run, RUN_TO + 1], runs[run, RUN_TO + 2]
    if kind == CLIPPED:
        state, count, _ = follow_tree(
            blob, ints, tab, np.int64(0), px, py, pz, dx - px, dy - py, dz - pz, begin, end, gap, resolution, tolerance,
            np.bool_(False), state, out, count, work, slots, pending,
        )  # fmt: skip
        state, count = change(state, new, end, gap, out, count)
        return merge_touches(out, count, gap)
    if runs[run, RUN_BEND] < math.inf:
        verdict = settle_smooth_run(blob, ints, tab, runs, run, tolerance)
        if verdict == HALVED_IN or verdict == HALVED_OUT:
            return _settle_halves(
                blob, ints, tab, runs, run, verdict, spare, resolution, tolerance, gap, out, count, work
            )
        if verdict != LOST:
            return change(state, new, runs[run, GUESS], gap, out, count)[1]
    leaf = leaf_of(ints, runs, run)
    if kind == MONOTONE:
        t = root_by_values(
            blob, ints, leaf, px, py, pz, dx, dy, dz, begin, end, runs[run, GUESS], code & RISES != 0,
            runs[run, LEAST], runs[run, MOST], tolerance * (runs[run, RUN_GAP] / MERGE),
        )  # fmt: skip
        return change(state, new, t, gap, out, count)[1]
    return _follow(blob, ints, tab, runs, run, resolution, tolerance, gap, out, count, work)
