"""Runs of one leaf with a bend that is known: clear, or monotone, or halved, by exact values and slopes.

With (F − 1, dF/dt) at one place of a run and a bound of |d²F/dt²| over it, F keeps its sign along it, or is monotone,
or it is parted there. What neither proves is left to the cells of the leaf's chart (`hhsr.kernels.settle_run`).
"""

import numpy as np

from hhsr.kernels.along import EXCESS, PLACE, RISE, WAY, excess_together
from hhsr.kernels.lane import MERGE
from hhsr.kernels.layout import HALF_AXES
from hhsr.kernels.runs import (
    AFTER,
    ANSWER_COUNT,
    ANSWER_NEXT,
    ANSWER_PLACE,
    BEFORE,
    CODE,
    GUESS,
    HALVINGS,
    LEAST,
    MONOTONE,
    MOST,
    OWN,
    RISES,
    RUN_BEGIN,
    RUN_BEND,
    RUN_END,
    RUN_GAP,
    RUN_SIZE,
    ask_middle,
    key_of,
    leaf_of,
    place_of,
    set_key,
)
from hhsr.kernels.stretch import bend_along, centres_of, excess_along, improve
from hhsr.kernels.unmanaged import inlined, unmanaged
from hhsr.kernels.vectors import LANES

# What is known of a smooth run: it crosses once, but not yet where; it crosses at its guess; nowhere; nothing.
# Or that it may cross several times; it is to be parted where it is inside, or outside.
OPEN, CROSSED, CLEAR, LOST, HALVED_IN, HALVED_OUT = 0, 1, 2, 3, 4, 5
ROUNDED = 1e-9  # F − 1 is rounded to far less
ALONE = 4  # so few runs of one block are improved one by one: eight side by side take as long as some


@inlined
def _prove(runs, run, f, slope, bend):
    """Return what (F − 1, dF/dt) at the guess of a run of one leaf and a bound of |d²F/dt²| say of it.

    OPEN: it is a monotone run from now on.
    """
    code, t = int(runs[run, CODE]), runs[run, GUESS]
    before, after = code & BEFORE != 0, code & AFTER != 0
    reach = max(t - runs[run, RUN_BEGIN], runs[run, RUN_END] - t)
    stray = bend * reach
    if abs(slope) > stray:
        if before == after:
            return CLEAR
        if before == (slope > 0.0):
            runs[run, CODE] = code - OWN + MONOTONE + (RISES if slope > 0.0 else 0)
            runs[run, LEAST], runs[run, RUN_BEND] = abs(slope) - stray, bend
            return OPEN
    elif before == after and before == (f < 0.0) and abs(f) > (abs(slope) + 0.5 * stray) * reach + ROUNDED:
        return CLEAR
    return LOST


@inlined
def _improve_run(ints, tab, runs, run, f, slope, tolerance):
    """Improve the guess of a smooth run, where (F − 1, dF/dt) are known; return what is known of it then.

    One of a leaf that is not proven clear or monotone is to be halved at its guess, but not again and again.
    """
    if int(runs[run, CODE]) & 7 == OWN:
        verdict = _prove(runs, run, f, slope, runs[run, RUN_BEND])
        if verdict == LOST:
            x, y, z, dx, dy, dz = place_of(runs, run)
            t, begin, end = runs[run, GUESS], runs[run, RUN_BEGIN], runs[run, RUN_END]
            bend = bend_along(
                ints, tab, leaf_of(ints, runs, run), x - t * dx, y - t * dy, z - t * dz, dx, dy, dz, begin, end
            )
            if bend < runs[run, RUN_BEND]:
                runs[run, RUN_BEND] = bend
                verdict = _prove(runs, run, f, slope, bend)
        if verdict == LOST and abs(f) > ROUNDED and runs[run, LEAST] < HALVINGS:
            return HALVED_OUT if f > 0.0 else HALVED_IN
        if verdict != OPEN:
            return verdict
    done, runs[run, RUN_BEGIN], runs[run, RUN_END], runs[run, GUESS] = improve(
        int(runs[run, MOST]), runs[run, RUN_BEGIN], runs[run, RUN_END], runs[run, GUESS], f, slope,
        int(runs[run, CODE]) & RISES != 0, runs[run, LEAST], runs[run, RUN_BEND],
        tolerance * (runs[run, RUN_GAP] / MERGE),
    )  # fmt: skip
    runs[run, MOST] += 1.0
    return CROSSED if done else OPEN


@inlined
def halve(runs, run, other, inside):
    """Part a run of one leaf at its guess, in a state that is known there; `other` gets the second half."""
    code, t = int(runs[run, CODE]), runs[run, GUESS]
    runs[run, LEAST] += 1.0
    for k in range(RUN_SIZE):
        runs[other, k] = runs[run, k]
    runs[run, CODE], runs[run, RUN_END] = OWN + (code & BEFORE) + (AFTER if inside else 0), t
    runs[other, CODE], runs[other, RUN_BEGIN] = OWN + (code & AFTER) + (BEFORE if inside else 0), t
    ask_middle(runs, run)
    ask_middle(runs, other)


@inlined
def settle_smooth_run(blob, ints, tab, runs, run, tolerance):
    """Return what is known of a smooth run in the end. tolerance: mm."""
    leaf, verdict = leaf_of(ints, runs, run), OPEN
    while verdict == OPEN:
        x, y, z, dx, dy, dz = place_of(runs, run)
        f, slope = excess_along(blob, ints, leaf, x, y, z, dx, dy, dz)
        verdict = _improve_run(ints, tab, runs, run, f, slope, tolerance)
    return verdict


@unmanaged
def improve_together(
    blob, ints, tab, runs, used, order, first, count, later, left, others, lost, tolerance, rows, found, place, answers
):
    """Improve `count` ≤ LANES smooth runs of one key, order[first] …: what `settle_run` does, to the bit.

    Those that are settled go to `found` from a place on and have their answers (ANSWER_SIZE) filled in; open ones, and
    halves, of which the second are new runs from `used` on, go to `later` from `left` on, lost ones to `others` from
    `lost` on. Returns (used, left, lost, place). rows: (ALONG_ROWS, LANES) scratch. tolerance: mm.
    """
    leaf, block = leaf_of(ints, runs, order[first]), key_of(runs, order[first])
    if count > ALONE:
        o, n = centres_of(ints, leaf, block)
        for lane in range(LANES):
            x, y, z, dx, dy, dz = place_of(runs, order[first + min(lane, count - 1)])
            rows[PLACE, lane], rows[PLACE + 1, lane], rows[PLACE + 2, lane] = x, y, z
            rows[WAY, lane], rows[WAY + 1, lane], rows[WAY + 2, lane] = dx, dy, dz
        terms = n
        while terms > 0 and blob[o + 4 * n + terms - 1] == 0.0:  # what fills up the last LANES
            terms -= 1
        excess_together(rows, blob, np.int64(ints[leaf + HALF_AXES]), o, n, np.int64(terms))
    else:
        for lane in range(count):
            x, y, z, dx, dy, dz = place_of(runs, order[first + lane])
            rows[EXCESS, lane], rows[RISE, lane] = excess_along(blob, ints, leaf, x, y, z, dx, dy, dz)
    for lane in range(count):
        run, f, slope = order[first + lane], rows[EXCESS, lane], rows[RISE, lane]
        verdict = _improve_run(ints, tab, runs, run, f, slope, tolerance)
        if verdict == LOST:
            runs[run, RUN_BEND] = np.inf
            others[lost] = run
            lost += 1
        elif verdict == CROSSED or verdict == CLEAR:
            found[place] = runs[run, GUESS]
            crossed = 1 if verdict == CROSSED else 0
            answers[run, ANSWER_PLACE], answers[run, ANSWER_COUNT] = place, crossed
            place += crossed
        else:
            if verdict != OPEN:
                halve(runs, run, used, verdict == HALVED_IN)
                answers[used, ANSWER_NEXT], answers[run, ANSWER_NEXT] = answers[run, ANSWER_NEXT], used
                set_key(runs, used)
                later[left] = used
                left, used = left + 1, used + 1
            set_key(runs, run)
            later[left] = run
            left += 1
    return used, left, lost, place
