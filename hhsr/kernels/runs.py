"""Runs: the stretches of a walk that no plane decides, kept as records, and how each is settled.

A walk goes on behind a run without its crossings, for the planes prove the state there. So the runs of many segments
can be settled in the order of the tables that they need. What is pending is the record after the last one.
"""

import math

import numpy as np

from hhsr.kernels.along import CHANGE, FIELD, TANGENT, UNIT, fields_along
from hhsr.kernels.cell import block_of, face_of
from hhsr.kernels.chart_walk import follow_cells
from hhsr.kernels.clipped import follow_tree, merge_touches
from hhsr.kernels.lane import END, FIRST_RUN, FOUND, GAP, LAST_RUN, MERGE, RUNS_USED, SPILLED, START
from hhsr.kernels.layout import FRAME, HALF_AXES, OWNER_INT_SIZE, OWNER_INTS, OWNER_RECORD, ROTATED
from hhsr.kernels.maps import cell_at
from hhsr.kernels.stretch import (
    centres_of,
    change,
    excess_along,
    excess_of,
    improve,
    ray_along,
    root_by_values,
)
from hhsr.kernels.tree import into_leaf, turn_into_leaf
from hhsr.kernels.unmanaged import inlined, unmanaged
from hhsr.kernels.vectors import LANES, ask_ahead

# Kinds of runs: none; F is proven monotone; one leaf's; anybody's; no stretch, but a change at one place.
NONE, MONOTONE, OWN, CLIPPED, POINT = 0, 1, 2, 3, 4
# A record: kind + 8·(state before) + 16·(state after) + 32·(F rises), −1 where its crossings were too many; t where it
# begins and ends; t where F is about 1; the least and greatest |dF/dt|; |d²F/dt²|; MERGE as a share of the segment
# (while it is pending, the sign of dF/dt); its owner + OWNERS·key; the segment's start and end (tree's frame, mm), or,
# of a monotone run that is ready, its start and vector in the leaf's frame; the number of the segment's next record, −1
# of its last. Once settled it begins with the place of its crossings and ends with their number.
CODE, RUN_BEGIN, RUN_END, GUESS, LEAST, MOST, RUN_BEND, RUN_GAP, OWNER = 0, 1, 2, 3, 4, 5, 6, 7, 8
RUN_FROM, RUN_TO, NEXT, RUN_SIZE = 9, 12, 15, 16
BEFORE, AFTER, RISES = 8, 16, 32  # in the code
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
def _leaf_of(ints, runs, run):
    return ints[ints[OWNER_INTS] + OWNER_INT_SIZE * owner_of(runs, run) + OWNER_RECORD]


@unmanaged
def make_ready(blob, ints, runs, run):
    """Bring a monotone run into its leaf's frame, GUESS within it; of a smooth one MOST counts its improvements.

    Only smooth ones, whose bend is known, get the key of a block.
    """
    leaf = _leaf_of(ints, runs, run)
    px, py, pz = runs[run, RUN_FROM], runs[run, RUN_FROM + 1], runs[run, RUN_FROM + 2]
    dx, dy, dz = runs[run, RUN_TO] - px, runs[run, RUN_TO + 1] - py, runs[run, RUN_TO + 2] - pz
    px, py, pz = into_leaf(blob, ints, leaf, px, py, pz)
    if ints[leaf + ROTATED] != 0:
        dx, dy, dz = turn_into_leaf(blob, ints[leaf + FRAME], dx, dy, dz)
    runs[run, RUN_FROM], runs[run, RUN_FROM + 1], runs[run, RUN_FROM + 2] = px, py, pz
    runs[run, RUN_TO], runs[run, RUN_TO + 1], runs[run, RUN_TO + 2] = dx, dy, dz
    runs[run, GUESS] = min(max(runs[run, GUESS], runs[run, RUN_BEGIN]), runs[run, RUN_END])
    if runs[run, RUN_BEND] < math.inf:
        runs[run, MOST] = 0.0
        _set_key(runs, run)


@inlined
def _set_key(runs, run):
    """Set a ready run's key: the block of directions in which the guess lies."""
    x, y, z, _, _, _ = _place_of(runs, run)
    face, a, b, _ = face_of(x, y, z)
    runs[run, OWNER] = owner_of(runs, run) + OWNERS * block_of(face, a, b)


@inlined
def _place_of(runs, run):
    """Return the guess's place (leaf's frame) of a run that is ready, and its vector."""
    t, dx, dy, dz = runs[run, GUESS], runs[run, RUN_TO], runs[run, RUN_TO + 1], runs[run, RUN_TO + 2]
    x, y, z = runs[run, RUN_FROM] + t * dx, runs[run, RUN_FROM + 1] + t * dy, runs[run, RUN_FROM + 2] + t * dz
    return x, y, z, dx, dy, dz


@inlined
def _improve_run(runs, run, f, slope, tolerance):
    """Improve the guess of a monotone run, where (F − 1, dF/dt) are known; return whether it is the crossing."""
    done, runs[run, RUN_BEGIN], runs[run, RUN_END], runs[run, GUESS] = improve(
        int(runs[run, MOST]), runs[run, RUN_BEGIN], runs[run, RUN_END], runs[run, GUESS], f, slope,
        int(runs[run, CODE]) & RISES != 0, runs[run, LEAST], runs[run, RUN_BEND],
        tolerance * (runs[run, RUN_GAP] / MERGE),
    )  # fmt: skip
    runs[run, MOST] += 1.0
    return done


@unmanaged
def _settle_monotone(blob, ints, runs, run, tolerance):
    """Return t of the crossing of a monotone run that is ready. tolerance: mm."""
    leaf = _leaf_of(ints, runs, run)
    while runs[run, RUN_BEND] < math.inf:
        x, y, z, dx, dy, dz = _place_of(runs, run)
        f, slope = excess_along(blob, ints, leaf, x, y, z, dx, dy, dz)
        if _improve_run(runs, run, f, slope, tolerance):
            return runs[run, GUESS]
    return root_by_values(
        blob, ints, leaf, runs[run, RUN_FROM], runs[run, RUN_FROM + 1], runs[run, RUN_FROM + 2],
        runs[run, RUN_TO], runs[run, RUN_TO + 1], runs[run, RUN_TO + 2], runs[run, RUN_BEGIN], runs[run, RUN_END],
        runs[run, GUESS], int(runs[run, CODE]) & RISES != 0, runs[run, LEAST], runs[run, MOST],
        tolerance * (runs[run, RUN_GAP] / MERGE),
    )  # fmt: skip


@unmanaged
def improve_together(blob, ints, runs, order, first, count, left, tolerance, rows, found, place):
    """Improve `count` ≤ LANES ready monotone runs of one key, order[first] …: what `settle_run` does, to the bit.

    Those that are settled go to `found` from a place on; the others are put into order from `left` on. Returns
    (left, place). rows: (ALONG_ROWS, LANES) scratch. tolerance: mm.
    """
    leaf, block = _leaf_of(ints, runs, order[first]), key_of(runs, order[first])
    o, n = centres_of(ints, leaf, block)
    for lane in range(LANES):
        x, y, z, dx, dy, dz = _place_of(runs, order[first + min(lane, count - 1)])
        (
            (rows[UNIT, lane], rows[UNIT + 1, lane], rows[UNIT + 2, lane]),
            (rows[TANGENT, lane], rows[TANGENT + 1, lane], rows[TANGENT + 2, lane]),
        ) = ray_along(x, y, z, dx, dy, dz)
    terms = n
    while terms > 0 and blob[o + 4 * n + terms - 1] == 0.0:  # what fills up the last LANES
        terms -= 1
    fields_along(rows, blob, o, n, np.int64(terms))
    for lane in range(count):
        run = order[first + lane]
        x, y, z, dx, dy, dz = _place_of(runs, run)
        f, slope = excess_of(blob, ints[leaf + HALF_AXES], x, y, z, dx, dy, dz, rows[FIELD, lane], rows[CHANGE, lane])
        if _improve_run(runs, run, f, slope, tolerance):
            found[place] = runs[run, GUESS]
            runs[run, RUN_BEGIN], runs[run, RUN_END] = place, 1.0
            place += 1
        else:
            _set_key(runs, run)
            order[left] = run
            left += 1
    return left, place


@unmanaged
def ask_for_cells(blob, ints, tab, runs, run):
    """Ask for the cells of the begin, the middle and the end of one leaf's run, to be near when it is settled."""
    if int(runs[run, CODE]) & 7 != OWN:
        return
    leaf = _leaf_of(ints, runs, run)
    px, py, pz = runs[run, RUN_FROM], runs[run, RUN_FROM + 1], runs[run, RUN_FROM + 2]
    dx, dy, dz = runs[run, RUN_TO] - px, runs[run, RUN_TO + 1] - py, runs[run, RUN_TO + 2] - pz
    for k in range(3):
        t = runs[run, RUN_BEGIN] + 0.5 * k * (runs[run, RUN_END] - runs[run, RUN_BEGIN])
        x, y, z = into_leaf(blob, ints, leaf, px + t * dx, py + t * dy, pz + t * dz)
        face, a, b, _ = face_of(x, y, z)
        o, _, _, _ = cell_at(ints, leaf, face, a, b)
        ask_ahead(tab, o)


@unmanaged
def settle_run(blob, ints, tab, runs, run, resolution, tolerance, gap, out, count, work, slots, pending):
    """Add the crossings of a run to out (k,), `count` being there; return how many there are then.

    A monotone run must be ready. gap: of t, below which a leaving and an entering are one touch.
    """
    code = int(runs[run, CODE])
    kind, state, new = code & 7, code & BEFORE != 0, code & AFTER != 0
    begin, end = runs[run, RUN_BEGIN], runs[run, RUN_END]
    if kind == POINT:
        return change(state, new, begin, gap, out, count)[1]
    if kind == MONOTONE:
        return change(state, new, _settle_monotone(blob, ints, runs, run, tolerance), gap, out, count)[1]
    px, py, pz = runs[run, RUN_FROM], runs[run, RUN_FROM + 1], runs[run, RUN_FROM + 2]
    dx, dy, dz = runs[run, RUN_TO] - px, runs[run, RUN_TO + 1] - py, runs[run, RUN_TO + 2] - pz
    if kind == CLIPPED:
        state, count, _ = follow_tree(
            blob, ints, tab, np.int64(0), px, py, pz, dx, dy, dz, begin, end, gap, resolution, tolerance,
            np.bool_(False), state, out, count, work, slots, pending,
        )  # fmt: skip
        state, count = change(state, new, end, gap, out, count)
        return merge_touches(out, count, gap)
    length = math.sqrt(dx * dx + dy * dy + dz * dz)
    leaf = _leaf_of(ints, runs, run)
    px, py, pz = into_leaf(blob, ints, leaf, px, py, pz)
    if ints[leaf + ROTATED] != 0:
        dx, dy, dz = turn_into_leaf(blob, ints[leaf + FRAME], dx, dy, dz)
    state, count = follow_cells(
        blob, ints, tab, leaf, px, py, pz, dx, dy, dz, length, begin, end, resolution, tolerance, gap, state, out,
        count, work,
    )  # fmt: skip
    return change(state, new, end, gap, out, count)[1]
