"""Runs of one leaf with a bend that is known: clear, or monotone, or halved, by one value and slope in the middle.

With (F − 1, dF/dt) at one place of a run and a bound of |d²F/dt²| over it, F keeps its sign along it, or is monotone,
or it is parted there. What neither proves is left to the cells of the leaf's chart (`hhsr.kernels.settle_run`).
The value and the slope, and the place of a crossing, are those of the cell's quadratic in the table, whose errors are
bounded; where that is not enough, the formula's.
"""

from hhsr.kernels.cell_along import AT, BENDS, COUNT, FIRST, NEW_CODE, NORM, RISE, RISE_STRAY, STEEP, UNIT
from hhsr.kernels.field_sums import field_at
from hhsr.kernels.lane import MERGE
from hhsr.kernels.layout import LANES
from hhsr.kernels.runs import (
    AFTER,
    BEFORE,
    BEND_ALONG,
    CODE,
    GUESS,
    HALVINGS,
    LEAST,
    MONOTONE,
    OWN,
    RISES,
    RUN_BEGIN,
    RUN_END,
    RUN_GAP,
    RUN_SIZE,
    ask_middle,
    leaf_of,
    place_of,
)
from hhsr.kernels.stretch import excess_along, improve
from hhsr.kernels.unmanaged import inlined

# What is known of a smooth run: it crosses once, but not yet where; it crosses at its guess; nowhere; nothing.
# Or that it may cross several times; it is to be parted where it is inside, or outside.
OPEN, CROSSED, CLEAR, LOST, HALVED_IN, HALVED_OUT = 0, 1, 2, 3, 4, 5
EXACT = 1e-9  # F − 1 is rounded to far less
ONE_MM = 1.0 / MERGE  # of RUN_GAP


@inlined
def _prove(runs, run, f, slope):
    """Return what (F − 1, dF/dt) at the guess of a run of one leaf say of it.

    OPEN: it is a monotone run from now on.
    """
    code, t = int(runs[run, CODE]), runs[run, GUESS]
    before, after = code & BEFORE != 0, code & AFTER != 0
    reach = max(t - runs[run, RUN_BEGIN], runs[run, RUN_END] - t)
    stray = runs[run, BEND_ALONG] * reach
    if abs(slope) > stray:
        if before == after:
            return CLEAR
        if before == (slope > 0.0):
            runs[run, CODE] = code - OWN + MONOTONE + (RISES if before else 0)
            runs[run, LEAST] = abs(slope) - stray
            return OPEN
    elif before == after and before == (f < 0.0) and abs(f) > (abs(slope) + 0.5 * stray) * reach + EXACT:
        return CLEAR
    return LOST


@inlined
def part(runs, run, f, stray):
    """Return what becomes of a run of one leaf that is not proven, with F − 1 in its middle: it is halved there.

    But not again and again. OPEN: F is to be asked.
    """
    if not abs(f) > stray:
        return OPEN
    if runs[run, LEAST] < HALVINGS:
        return HALVED_OUT if f > 0.0 else HALVED_IN
    return LOST


@inlined
def _improve_run(runs, run, turn, f, slope, tolerance):
    """Improve the guess of a smooth run, where (F − 1, dF/dt) are known; return what is known of it then.

    tolerance: of t. turn: how often it was improved before.
    """
    if int(runs[run, CODE]) & 7 == OWN:
        verdict = _prove(runs, run, f, slope)
        if verdict == LOST:
            verdict = part(runs, run, f, EXACT)
            return LOST if verdict == OPEN else verdict
        if verdict == CLEAR:
            return CLEAR
    done, runs[run, RUN_BEGIN], runs[run, RUN_END], runs[run, GUESS] = improve(
        turn, runs[run, RUN_BEGIN], runs[run, RUN_END], runs[run, GUESS], f, slope,
        int(runs[run, CODE]) & RISES != 0, runs[run, LEAST], runs[run, BEND_ALONG], tolerance,
    )  # fmt: skip
    return CROSSED if done else OPEN


@inlined
def take_over(runs, run, rows, lane):
    """Keep what the cell says of a smooth run: its guess, whether it is monotone, and its bounds."""
    runs[run, CODE], runs[run, GUESS] = rows[NEW_CODE, lane], rows[AT, lane]
    runs[run, LEAST], runs[run, BEND_ALONG] = rows[STEEP, lane], rows[BENDS, lane]


@inlined
def give(rows, lane, given, k):
    """Put what a value is asked with, of a run in a lane, side by side into row k of `given` (n, LANES)."""
    for row in range(LANES):
        given[k, row] = rows[RISE + row, lane]


@inlined
def ask_value(blob, runs, run, given, k, tolerance):
    """Return CROSSED, at its guess, or OPEN, of a monotone run after one exact value; tolerance: mm.

    given: row k, `give`.
    """
    slope, stray, norm = given[k, 0], given[k, RISE_STRAY - RISE], given[k, NORM - RISE]
    unit = (given[k, UNIT - RISE], given[k, UNIT - RISE + 1], given[k, UNIT - RISE + 2])
    s = field_at(blob, int(given[k, FIRST - RISE]), int(given[k, COUNT - RISE]), unit)
    f, t = norm / (1.0 - s) - 1.0, runs[run, GUESS]
    far = abs(f) / runs[run, LEAST]
    if not (stray + 0.5 * runs[run, BEND_ALONG] * far) * far <= abs(slope) * tolerance * runs[run, RUN_GAP] * ONE_MM:
        return OPEN
    runs[run, GUESS] = min(max(t - f / slope, runs[run, RUN_BEGIN]), runs[run, RUN_END])
    return CROSSED


@inlined
def ask_formulas(blob, ints, runs, run, tolerance):
    """Return what is known of a smooth run in the end: CROSSED, at its guess, or anything but OPEN. tolerance: mm."""
    leaf, turn, verdict = leaf_of(runs, run), 0, OPEN
    tolerance *= runs[run, RUN_GAP] * ONE_MM
    while verdict == OPEN:
        x, y, z, dx, dy, dz = place_of(runs, run)
        f, slope = excess_along(blob, ints, leaf, x, y, z, dx, dy, dz)
        verdict = _improve_run(runs, run, turn, f, slope, tolerance)
        turn += 1
    return verdict


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
