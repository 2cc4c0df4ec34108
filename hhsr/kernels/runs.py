"""Runs: the stretches of a walk that no plane decides, kept as records.

A walk goes on behind a run without its crossings, for the planes prove the state there. So the runs of many segments
can be settled in the order of the tables that they need. What is pending is the record after the last one.
"""

import math

import numpy as np

from hhsr.kernels.cell import block_of, face_of
from hhsr.kernels.lane import END, FIRST_RUN, FOUND, GAP, LAST_RUN, RUNS_USED, SPILLED, START
from hhsr.kernels.layout import BLOCK_ROWS, FRAME, OWNER_INT_SIZE, OWNER_INTS, OWNER_RECORD, ROTATED
from hhsr.kernels.maps import cell_at
from hhsr.kernels.stretch import centres_of, share_across
from hhsr.kernels.tree import into_leaf, turn_into_leaf
from hhsr.kernels.unmanaged import inlined, unmanaged
from hhsr.kernels.vectors import LANES, ask_ahead

# Kinds of runs: none; F is proven monotone; one leaf's; anybody's; no stretch, but a change at one place.
NONE, MONOTONE, OWN, CLIPPED, POINT = 0, 1, 2, 3, 4
# A record: kind + 8·(state before) + 16·(state after) + 32·(F rises); t where it begins and ends; t where F is about 1;
# the least and greatest |dF/dt|; |d²F/dt²|; MERGE as a share of the segment (while it is pending, the sign of dF/dt);
# its owner + OWNERS·key; the segment's start and end (tree's frame, mm), or, of one leaf's run that is ready, its start
# and vector in the leaf's frame; the number of the segment's next record, −1 of its last.
CODE, RUN_BEGIN, RUN_END, GUESS, LEAST, MOST, RUN_BEND, RUN_GAP, OWNER = 0, 1, 2, 3, 4, 5, 6, 7, 8
RUN_FROM, RUN_TO, NEXT, RUN_SIZE = 9, 12, 15, 16
BEFORE, AFTER, RISES = 8, 16, 32  # in the code
# Of settled runs a short record, for they are put together one segment after another: the place of its crossings, how
# many there are (−1: too many), the number of the segment's next run.
ANSWER_PLACE, ANSWER_COUNT, ANSWER_NEXT, ANSWER_SIZE = 0, 1, 2, 3
HALVINGS = 2  # of one run, one in another; a run of one leaf counts them where others have LEAST
OWNERS = 65_536
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
def close(kind, runs, lanes, lane, state, new, end, surfel):
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
    owner = max(runs[run, OWNER], 0.0) if kind != POINT else 0.0
    runs[run, OWNER] = owner + OWNERS * (max(surfel, np.int64(0)) >> KEY_SHIFT)
    runs[run, RUN_GAP] = lanes[GAP, lane]
    runs[run, RUN_END], runs[run, NEXT] = end, -1.0
    for k in range(3):
        runs[run, RUN_FROM + k], runs[run, RUN_TO + k] = lanes[START + k, lane], lanes[END + k, lane]
    last = int(lanes[LAST_RUN, lane])
    if last < 0:
        lanes[FIRST_RUN, lane] = run
    else:
        runs[last, NEXT] = run
    lanes[LAST_RUN, lane], lanes[RUNS_USED, 0] = run, run + 1
    if state != new:
        lanes[FOUND, lane] = min(lanes[FOUND, lane], end)


@inlined
def note(runs, lanes, lane, state, new, t):
    """Keep a change of state at t, if it is one."""
    if state != new:
        runs[int(lanes[RUNS_USED, 0]), RUN_BEGIN] = t
        close(np.int64(POINT), runs, lanes, lane, state, new, t, np.int64(-1))


@inlined
def owner_of(runs, run):
    return int(runs[run, OWNER]) & (OWNERS - 1)


@inlined
def key_of(runs, run):
    """Return the key of a run: of its surfels, or, of a ready one, its block of directions."""
    return int(runs[run, OWNER]) // OWNERS


@inlined
def leaf_of(ints, runs, run):
    return ints[ints[OWNER_INTS] + OWNER_INT_SIZE * owner_of(runs, run) + OWNER_RECORD]


@unmanaged
def make_ready(blob, ints, runs, run):
    """Bring a run into its leaf's frame, GUESS within it; of a smooth one MOST counts its improvements.

    Runs of nobody, or of no length, stay as they are. Only smooth ones, whose bend is known, get the key of a block.
    """
    kind = int(runs[run, CODE]) & 7
    if kind != MONOTONE and kind != OWN:
        return
    leaf = leaf_of(ints, runs, run)
    px, py, pz = runs[run, RUN_FROM], runs[run, RUN_FROM + 1], runs[run, RUN_FROM + 2]
    dx, dy, dz = runs[run, RUN_TO] - px, runs[run, RUN_TO + 1] - py, runs[run, RUN_TO + 2] - pz
    px, py, pz = into_leaf(blob, ints, leaf, px, py, pz)
    if ints[leaf + ROTATED] != 0:
        dx, dy, dz = turn_into_leaf(blob, ints[leaf + FRAME], dx, dy, dz)
    runs[run, RUN_FROM], runs[run, RUN_FROM + 1], runs[run, RUN_FROM + 2] = px, py, pz
    runs[run, RUN_TO], runs[run, RUN_TO + 1], runs[run, RUN_TO + 2] = dx, dy, dz
    if kind == OWN:
        runs[run, LEAST] = 0.0
        ask_middle(runs, run)
    begin, end = runs[run, RUN_BEGIN], runs[run, RUN_END]
    t = min(max(runs[run, GUESS], begin), end)
    runs[run, GUESS] = t
    if runs[run, RUN_BEND] < math.inf:
        reach = max(t - begin, end - t)
        runs[run, RUN_BEND] *= share_across(px + t * dx, py + t * dy, pz + t * dz, dx, dy, dz, reach)
        runs[run, MOST] = 0.0
        set_key(runs, run)


@inlined
def ask_middle(runs, run):
    runs[run, GUESS] = 0.5 * (runs[run, RUN_BEGIN] + runs[run, RUN_END])


@inlined
def set_key(runs, run):
    """Set a ready run's key: the block of directions in which the guess lies."""
    x, y, z, _, _, _ = place_of(runs, run)
    face, a, b, _ = face_of(x, y, z)
    runs[run, OWNER] = owner_of(runs, run) + OWNERS * block_of(face, a, b)


@inlined
def place_of(runs, run):
    """Return the guess's place (leaf's frame) of a run that is ready, and its vector."""
    t, dx, dy, dz = runs[run, GUESS], runs[run, RUN_TO], runs[run, RUN_TO + 1], runs[run, RUN_TO + 2]
    x, y, z = runs[run, RUN_FROM] + t * dx, runs[run, RUN_FROM + 1] + t * dy, runs[run, RUN_FROM + 2] + t * dz
    return x, y, z, dx, dy, dz


@inlined
def ask_for_record(runs, run):
    """Ask for a run's record, to be near when it is settled."""
    ask_ahead(runs, RUN_SIZE * np.int64(run))
    ask_ahead(runs, RUN_SIZE * np.int64(run) + RUN_SIZE // 2)


@inlined
def ask_for_block(blob, ints, runs, run):
    """Ask for the centres of the block of a smooth run, to be near when it is improved."""
    o, n = centres_of(ints, leaf_of(ints, runs, run), key_of(runs, run))
    for slot in range(o, o + BLOCK_ROWS * n, LANES):
        ask_ahead(blob, slot)


@unmanaged
def ask_for_cells(ints, tab, runs, run):
    """Ask for the cells of the begin, the middle and the end of one leaf's run, to be near when it is settled."""
    if int(runs[run, CODE]) & 7 != OWN:
        return
    leaf = leaf_of(ints, runs, run)
    for k in range(3):
        t = runs[run, RUN_BEGIN] + 0.5 * k * (runs[run, RUN_END] - runs[run, RUN_BEGIN])
        x = runs[run, RUN_FROM] + t * runs[run, RUN_TO]
        y = runs[run, RUN_FROM + 1] + t * runs[run, RUN_TO + 1]
        z = runs[run, RUN_FROM + 2] + t * runs[run, RUN_TO + 2]
        face, a, b, _ = face_of(x, y, z)
        o, _, _, _ = cell_at(ints, leaf, face, a, b)
        ask_ahead(tab, o)
