"""Runs of one leaf: what is settled of them against F along them."""

from __future__ import annotations

import numpy as np
import pytest

from hhsr.kernels import runs as at
from hhsr.kernels import smooth_runs
from hhsr.kernels.cell_along import BENDS, CELL_ROWS, KNOWN, settled
from hhsr.kernels.crossing import scratch
from hhsr.kernels.lane import MERGE
from hhsr.kernels.layout import LANES, OWNER_INTS, OWNER_RECORD, integers, tables
from hhsr.kernels.settle_run import settle_run
from hhsr.kernels.stretch import excess, excess_along
from hhsr.kernels.table_lanes import CountedTables
from tests.kernels.small_solids import arithmetic_of_c, solid  # noqa: F401

COUNT = 150


@pytest.fixture
def blob() -> np.ndarray:
    """A leaf with a dozen centres, whose bends are known, compiled."""
    return solid("smooth").compiled.blob


def leaf_of(blob: np.ndarray) -> int:
    ints = integers(blob)
    return int(ints[int(ints[OWNER_INTS]) + OWNER_RECORD])


def grazing(blob: np.ndarray, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, float, float]:
    """Return p, d, and the begin and end of a stretch that all but touches the surface (leaf's frame)."""
    ints, leaf = integers(blob), leaf_of(blob)
    u, way = rng.normal(size=(2, 3))
    u *= 6.0 / np.sqrt(u @ u)
    for _ in range(40):  # F grows along the ray: onto the surface, or a little off it
        u *= 1.0 - 0.5 * excess(blob, ints, leaf, *u)
    slopes = [excess_along(blob, ints, leaf, *u, *axis)[1] for axis in np.eye(3)]
    normal = np.array(slopes) / np.sqrt(np.sum(np.square(slopes)))
    way -= (way @ normal) * normal * rng.uniform(0.9, 1.0)
    d = way * (12.0 / np.sqrt(way @ way))
    middle, half = rng.uniform(0.4, 0.6), rng.uniform(0.01, 0.08)
    return u + normal * rng.normal() * 0.02 - middle * d, d, middle - half, middle + half


def put_run(
    blob: np.ndarray, runs: np.ndarray, run: int, p: np.ndarray, d: np.ndarray, begin: float, end: float
) -> None:
    """Put a run of one leaf into a record, with a bend in space that bounds nothing tightly."""
    ints, leaf = integers(blob), leaf_of(blob)
    before, after = (excess(blob, ints, leaf, *(p + t * d)) <= 0.0 for t in (begin, end))
    runs[run] = 0.0
    runs[run, at.CODE] = at.OWN + (at.BEFORE if before else 0) + (at.AFTER if after else 0)
    runs[run, at.RUN_BEGIN], runs[run, at.RUN_END], runs[run, at.GUESS] = begin, end, 0.5 * (begin + end)
    runs[run, at.RUN_FROM : at.RUN_FROM + 3], runs[run, at.RUN_TO : at.RUN_TO + 3] = p, d
    runs[run, at.RUN_BEND], runs[run, at.BEND_ALONG] = 1e9, np.inf
    runs[run, at.LEAF], runs[run, at.RUN_GAP], runs[run, at.NEXT] = leaf, MERGE / np.sqrt(d @ d), -1.0


def test_runs_have_the_crossings_of_f_along_them(blob: np.ndarray) -> None:
    """By their cells, by the formulas, halved or followed through the chart: what F says at a thousand steps."""
    ints, tab, leaf = integers(blob), tables(blob), leaf_of(blob)
    work, slots, pending = scratch()
    rows = np.zeros((CELL_ROWS, LANES))
    runs = np.zeros((at.HALVINGS + 1, at.RUN_SIZE))
    rng, out = np.random.default_rng(2), np.empty(64)
    seen: dict[int, int] = {}
    twice = 0
    for _ in range(COUNT):
        p, d, begin, end = grazing(blob, rng)
        put_run(blob, runs, 0, p, d, begin, end)
        with np.errstate(all="ignore"):
            told = settled(CountedTables(runs, blob, ints, tab), np.zeros(1), 0.001)
        runs[0, at.BEND_ALONG] = told[BENDS - KNOWN][0]
        f, slope = excess_along(blob, ints, leaf, *(p + 0.5 * (begin + end) * d), *d)
        verdict = int(smooth_runs._prove(runs, 0, f, slope))
        seen[verdict] = seen.get(verdict, 0) + 1
        put_run(blob, runs, 0, p, d, begin, end)
        count = settle_run(
            blob, ints, tab, runs, 0, 1, 0.01, 0.001, runs[0, at.RUN_GAP], out, 0, work, slots, pending, rows
        )
        t = np.linspace(begin, end, 1001)
        values = np.array([excess(blob, ints, leaf, *(p + s * d)) for s in t])
        changes = t[1:][np.diff(values <= 0.0)]
        twice += len(changes) > 1
        assert (count - len(changes)) % 2 == 0
        if count == len(changes):
            assert np.abs(out[:count] - changes).max(initial=0.0) <= 1e-3 / 12.0 + (end - begin) / 1000
        else:  # a pair that the steps miss, or one no wider than the resolution
            assert np.abs(values).min() < 1e-4
    assert {smooth_runs.OPEN, smooth_runs.CLEAR, smooth_runs.LOST} <= set(seen)
    assert twice > 5
