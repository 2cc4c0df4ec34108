"""Runs: the stretches of a walk that no plane decides, kept as records.

A walk goes on behind a run without its crossings, for the planes prove the state there. So the runs of many segments
can be settled in the order of the tables that they need. What is pending is the record after the last one.
"""

import math

import numpy as np

from hhsr.kernels.lane import END, FIRST_RUN, FOUND, GAP, LAST_RUN, RUNS_USED, SPILLED, START
from hhsr.kernels.layout import FRAME, OWNER_INT_SIZE, OWNER_INTS, OWNER_RECORD, ROTATED
from hhsr.kernels.tree import into_leaf, turn_into_leaf
from hhsr.kernels.unmanaged import inlined
from hhsr.kernels.vectors import ask_ahead

# Kinds of runs: none; F is proven monotone; one leaf's; anybody's; no stretch, but a change at one place.
NONE, MONOTONE, OWN, CLIPPED, POINT = 0, 1, 2, 3, 4
# A record: kind + 8·(state before) + 16·(state after) + 32·(F rises) + 64·(cells asked before, `cell_along`); t where
# it begins and ends; t where F is about 1; the least and greatest |dF/dt|; |d²F/dt²| by the bend in space; MERGE as a
# share of the segment (while it is pending, the sign of dF/dt); its leaf's record + LEAVES·key (while it is pending,
# its owner); the segment's start and end (tree's frame, mm), or, of one leaf's run, its start and vector in the leaf's
# frame; the number of the segment's next record, −1 of its last.
CODE, RUN_BEGIN, RUN_END, GUESS, LEAST, MOST, RUN_BEND, RUN_GAP, LEAF = 0, 1, 2, 3, 4, 5, 6, 7, 8
RUN_FROM, RUN_TO, NEXT, RUN_SIZE = 9, 12, 15, 16
BEND_ALONG = MOST  # of a smooth run, whose bend is known, another bound of |d²F/dt²|
OWNER = LEAF  # while it is pending
BEFORE, AFTER, RISES, TURNED = 8, 16, 32, 64  # in the code
# Of settled runs a short record, for they are put together one segment after another: the place of its crossings, how
# many there are (−1: too many), the number of the segment's next run.
ANSWER_PLACE, ANSWER_COUNT, ANSWER_NEXT, ANSWER_SIZE = 0, 1, 2, 3
HALVINGS = 2  # of one run, one in another; a run of one leaf counts them where others have LEAST
LEAVES = 2**30
KEY_SHIFT = 4  # surfels of a key, as a power of two


@inlined
def enter(kind, runs, lanes, a, b, owner, slope, stray, bend, guess):
    """Add [a, b] of a voxel to the pending run, or begin one; return its kind. Owner −1: a voxel without a surfel."""
    run = int(lanes[RUNS_USED, 0])
    new = CLIPPED if owner < 0 else (MONOTONE if abs(slope) > stray else OWN)
    if kind == NONE:
        runs[run, RUN_BEGIN], runs[run, OWNER], runs[run, RUN_GAP] = a, owner, slope
        runs[run, LEAST], runs[run, MOST] = abs(slope) - stray, abs(slope) + stray
        runs[run, RUN_BEND], runs[run, GUESS] = bend, guess
        return new
    if kind == CLIPPED or new == CLIPPED or runs[run, OWNER] != owner:
        return CLIPPED
    runs[run, RUN_BEND] = max(runs[run, RUN_BEND], bend)
    if kind == MONOTONE and new == MONOTONE and (runs[run, RUN_GAP] > 0.0) == (slope > 0.0):
        runs[run, LEAST] = min(runs[run, LEAST], abs(slope) - stray)
        runs[run, MOST] = max(runs[run, MOST], abs(slope) + stray)
        if guess >= a:  # the plane of this voxel is the one that the crossing lies on, or past
            runs[run, GUESS] = guess
        return MONOTONE
    return OWN


@inlined
def close(blob, ints, kind, runs, lanes, lane, state, new, end, surfel):
    """End the pending run of a lane at t = `end` in the state `new`; a monotone one between like states is dropped.

    surfel: one of those it passes (else −1): neighbours have neighbouring numbers.
    """
    if kind == MONOTONE and state == new:
        return
    run = int(lanes[RUNS_USED, 0])
    if run + 1 >= runs.shape[0]:  # the next one needs a record to be pending in
        lanes[SPILLED, lane] = 1.0
        return
    rises = kind == MONOTONE and runs[run, RUN_GAP] > 0.0
    runs[run, CODE] = kind + (BEFORE if state else 0) + (AFTER if new else 0) + (RISES if rises else 0)
    runs[run, RUN_END] = end
    _complete(blob, ints, runs, run, lanes, lane, LEAVES * (max(surfel, np.int64(0)) >> KEY_SHIFT))
    last = int(lanes[LAST_RUN, lane])
    if last < 0:
        lanes[FIRST_RUN, lane] = run
    else:
        runs[last, NEXT] = run
    lanes[LAST_RUN, lane], lanes[RUNS_USED, 0] = run, run + 1
    if state != new:
        lanes[FOUND, lane] = min(lanes[FOUND, lane], end)


@inlined
def _complete(blob, ints, runs, run, lanes, lane, key):
    """Fill in what a closed run says of its lane's segment: where it lies, in its leaf's frame if it is one leaf's."""
    kind = int(runs[run, CODE]) & 7
    px, py, pz = lanes[START, lane], lanes[START + 1, lane], lanes[START + 2, lane]
    qx, qy, qz = lanes[END, lane], lanes[END + 1, lane], lanes[END + 2, lane]
    runs[run, RUN_GAP], runs[run, NEXT] = lanes[GAP, lane], -1.0
    if kind == MONOTONE or kind == OWN:
        leaf = ints[ints[OWNER_INTS] + OWNER_INT_SIZE * int(runs[run, OWNER]) + OWNER_RECORD]
        qx, qy, qz = qx - px, qy - py, qz - pz
        px, py, pz = into_leaf(blob, ints, leaf, px, py, pz)
        if ints[leaf + ROTATED] != 0:
            qx, qy, qz = turn_into_leaf(blob, ints[leaf + FRAME], qx, qy, qz)
        runs[run, GUESS] = min(max(runs[run, GUESS], runs[run, RUN_BEGIN]), runs[run, RUN_END])
        if kind == OWN:
            runs[run, LEAST] = 0.0
        if runs[run, RUN_BEND] < math.inf:
            runs[run, BEND_ALONG] = math.inf
        key += leaf
    runs[run, LEAF] = key
    runs[run, RUN_FROM], runs[run, RUN_FROM + 1], runs[run, RUN_FROM + 2] = px, py, pz
    runs[run, RUN_TO], runs[run, RUN_TO + 1], runs[run, RUN_TO + 2] = qx, qy, qz


@inlined
def note(blob, ints, runs, lanes, lane, state, new, t):
    """Keep a change of state at t, if it is one."""
    if state != new:
        runs[int(lanes[RUNS_USED, 0]), RUN_BEGIN] = t
        close(blob, ints, np.int64(POINT), runs, lanes, lane, state, new, t, np.int64(-1))


@inlined
def leaf_of(runs, run):
    """Return the integer slot of the record of the leaf of one leaf's run."""
    return int(runs[run, LEAF]) & (LEAVES - 1)


@inlined
def key_of(runs, run):
    """Return the key of a run: of the surfels that it passes."""
    return int(runs[run, LEAF]) // LEAVES


@inlined
def is_smooth(runs, run):
    """Return whether a run is one leaf's, and its bend is known."""
    kind = int(runs[run, CODE]) & 7
    return (kind == MONOTONE or kind == OWN) and runs[run, RUN_BEND] < math.inf


@inlined
def ask_middle(runs, run):
    runs[run, GUESS] = 0.5 * (runs[run, RUN_BEGIN] + runs[run, RUN_END])


@inlined
def place_of(runs, run):
    """Return the guess's place of one leaf's run (leaf's frame), and its vector."""
    t, dx, dy, dz = runs[run, GUESS], runs[run, RUN_TO], runs[run, RUN_TO + 1], runs[run, RUN_TO + 2]
    x, y, z = runs[run, RUN_FROM] + t * dx, runs[run, RUN_FROM + 1] + t * dy, runs[run, RUN_FROM + 2] + t * dz
    return x, y, z, dx, dy, dz


@inlined
def ask_for_record(runs, run):
    """Ask for a run's record, to be near when it is settled."""
    ask_ahead(runs, RUN_SIZE * np.int64(run))
    ask_ahead(runs, RUN_SIZE * np.int64(run) + RUN_SIZE // 2)
