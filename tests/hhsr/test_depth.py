"""How deep a segment runs: spans of it, and what a moved segment proves of them."""

from __future__ import annotations

import numpy as np
import pytest

from hhsr.kernels.clearance import lift
from hhsr.kernels.crossing import scratch
from hhsr.kernels.layout import integers, tables
from hhsr.kernels.spans import put_span, summit_of
from hhsr.kernels.tree import into_tree
from hhsr.shape import Shape
from tests.strategies import random_tree

SLACK = 0.001  # mm


@pytest.mark.parametrize("seed", range(6))
def test_what_a_moved_segment_closes_is_no_deeper_than_said(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = Shape(random_tree(rng))
    blob = shape.compiled.blob
    ints, tab = integers(blob), tables(blob)
    work, slots, pending = scratch()
    low, high = shape.bounds
    closed = kept = 0
    for _ in range(40):
        start, end = rng.uniform(low, high, (2, 3))
        met = shape.crossings(start, end)
        if len(met.t) < 2 or shape.contains(start):
            continue
        t0, t1 = met.t[0] + 1e-6, met.t[1] - 1e-6
        p = np.array(into_tree(blob, ints, *start))
        d = np.array(into_tree(blob, ints, *end)) - p
        at = rng.uniform(t0, t1)
        foot, distance = shape.closest_point(start + at * (end - start))
        x, y, z = into_tree(blob, ints, *foot)
        # A surface point far off bounds the span by much more than is asked.
        spans, lifted = np.zeros((64, 10)), np.empty(64)
        middles = np.linspace(t0, t1, 9)
        for s in range(8):
            put_span(spans, s, *p, *d, middles[s], *(p + 1e3), middles[s + 1], *(p + 1e3))
        most = -distance * rng.uniform(0.7, 1.1)
        used = lift(blob, ints, tab, spans, 8, *p, *d, at, x, y, z, most, SLACK, lifted, work, slots, pending)
        t = np.linspace(t0, t1, 200)
        is_open = np.zeros(200, dtype=bool)
        for s in range(used):
            is_open |= (spans[s, 0] - 1e-12 <= t) & (t <= spans[s, 4] + 1e-12)
        depth = -shape.signed_distance(start + t[:, None] * (end - start), tolerance_mm=1e-4)
        assert (depth[~is_open] <= most + 1e-4).all()
        closed, kept = closed + np.count_nonzero(~is_open), kept + np.count_nonzero(is_open)
    assert closed > 200
    assert kept > 200


def test_the_summit_of_a_ball_is_in_its_middle() -> None:
    # A chord of a ball of radius 10 about 0, 6 off its centre, by t = x: the feet of two of its points are known.
    def foot(t: float) -> np.ndarray:
        point = np.array([t, 6.0, 0.0])
        return 10.0 * point / np.linalg.norm(point)

    spans, way = np.zeros((4, 10)), (0.0, 6.0, 0.0, 1.0, 0.0, 0.0)
    for s, (a, b) in enumerate([(-8.0, -1.0), (-1.0, 2.0), (2.0, 8.0)]):
        put_span(spans, s, *way, a, *foot(a), b, *foot(b))
    s, t = summit_of(spans, 3, *way, 0, -4.0)
    assert s == 1
    assert t == pytest.approx(0.0, abs=0.1)
    # Where none is known to rise and fall, what was given stays.
    put_span(spans, 0, *way, 2.0, *foot(2.0), 8.0, *foot(8.0))
    assert summit_of(spans, 1, *way, 0, 5.0) == (0, 5.0)
