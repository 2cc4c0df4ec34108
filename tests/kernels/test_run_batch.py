"""The runs of many segments, settled together, step by step without the compiler: what each segment alone has."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numba import config

from hhsr.kernels.cell_along import CELL_ROWS
from hhsr.kernels.crossing import scratch
from hhsr.kernels.lane import BEGIN, FIRST_RUN, MERGE, ROWS, RUNS_USED, set_out
from hhsr.kernels.layout import integers, tables
from hhsr.kernels.run_batch import (
    MANY,
    ROOM,
    gather_crossings,
    most_keys,
    most_runs,
    order_runs,
    settle_others,
    settle_smooth,
)
from hhsr.kernels.runs import ANSWER_COUNT, ANSWER_NEXT, ANSWER_PLACE, ANSWER_SIZE, RUN_SIZE
from hhsr.kernels.segment import PIECES
from hhsr.kernels.tree import into_tree
from hhsr.kernels.vectors import LANES
from hhsr.kernels.walk import go_on
from tests.kernels.small_solids import arithmetic_of_c, solid  # noqa: F401
from tests.kernels.test_solid_kernels import SMOOTH, around

COUNT = 25


@pytest.mark.skipif(not config.DISABLE_JIT, reason="compiled, every batch of segments asks it")  # type: ignore[attr-defined]
@pytest.mark.parametrize("name", SMOOTH)
def test_many_segments_have_the_crossings_of_each(name: str) -> None:
    shape = solid(name)
    blob = shape.compiled.blob
    ints, tab = integers(blob), tables(blob)
    work, slots, pending = scratch()
    lanes, runs = work[PIECES : PIECES + ROWS], np.zeros((60 * COUNT, RUN_SIZE))
    starts, ends = around(name, 6, COUNT), around(name, 7, COUNT)
    places = np.full(COUNT, -1)
    inside = np.zeros(COUNT, dtype=bool)
    for i in range(COUNT):
        p, q = into_tree(blob, ints, *starts[i]), into_tree(blob, ints, *ends[i])
        if set_out(blob, ints, lanes, 0, *p, *q, math.dist(p, q)):
            assert go_on(blob, ints, tab, lanes, 0, False, True, runs)
            places[i], inside[i] = int(lanes[FIRST_RUN, 0]), lanes[BEGIN, 0] > 0.0
    used = int(lanes[RUNS_USED, 0])
    most = int(most_runs(runs, used))
    assert used <= most <= len(runs)
    order, later = np.empty(2 * most, dtype=np.int32), np.empty((4, most + 1), dtype=np.int32)
    bins, answers = np.empty(most_keys(ints), dtype=np.int32), np.empty((most, ANSWER_SIZE), dtype=np.int32)
    smooth = int(order_runs(ints, runs, used, bins, order, answers))
    assert sorted(order[:used].tolist()) == list(range(used))
    found, ts = np.empty(ROOM * (most + 1)), np.empty(ROOM * (most + 1))
    rows, given = np.zeros((CELL_ROWS, LANES)), np.empty((most + 1, LANES))
    end, settled = settle_smooth(blob, ints, tab, runs, used, order, smooth, later, given, 0.001, found, rows, answers)
    begun = np.array([smooth, settled])
    assert settle_others(blob, ints, tab, runs, order, end, begun, 0.01, 0.001, found, work, slots, pending, answers)
    for i in range(COUNT):
        alone = shape.crossings(starts[i], ends[i])
        count, last = gather_crossings(
            answers, found, False, places[i], 0, MERGE / math.dist(starts[i], ends[i]), ts, 0
        )
        assert count == last == len(alone.t)
        assert np.allclose(ts[:count], alone.t, rtol=0, atol=1e-12)
        assert inside[i] == shape.contains(starts[i])


def test_a_first_crossing_that_is_a_touch_sends_for_the_others() -> None:
    """The walk for a first crossing ends behind it: where that is a touch after all, the segment is followed alone."""
    answers, found, ts = np.zeros((2, ANSWER_SIZE), dtype=np.int32), np.array([0.25, 0.25, 0.75]), np.zeros(4)
    answers[0, [ANSWER_COUNT, ANSWER_PLACE, ANSWER_NEXT]] = 1, 0, 1
    answers[1, [ANSWER_COUNT, ANSWER_PLACE, ANSWER_NEXT]] = 1, 1, -1
    first = gather_crossings(answers, found, np.bool_(True), np.int64(0), np.int64(0), 1e-9, ts, np.int64(1))
    assert first == (MANY, 1)
    assert gather_crossings(answers, found, np.bool_(False), np.int64(0), np.int64(0), 1e-9, ts, np.int64(1)) == (0, 1)
    answers[1, ANSWER_COUNT] = 2
    first = gather_crossings(answers, found, np.bool_(True), np.int64(0), np.int64(0), 1e-9, ts, np.int64(1))
    assert first == (1, 2)
    assert ts[1] == 0.75
