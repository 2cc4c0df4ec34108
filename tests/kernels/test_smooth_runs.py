"""Runs of one leaf: bounds of their bend against slopes, and what is proven of them against F along them."""

from __future__ import annotations

import numpy as np
import pytest

from hhsr.kernels import runs as at
from hhsr.kernels import smooth_runs
from hhsr.kernels.crossing import RUNS, scratch
from hhsr.kernels.lane import MERGE, ROWS
from hhsr.kernels.layout import OWNER_INTS, OWNER_RECORD, integers, tables
from hhsr.kernels.segment import PIECES
from hhsr.kernels.settle_run import settle_run
from hhsr.kernels.stretch import bend_along, excess, excess_along, share_across
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


def test_bends_are_bounded(blob: np.ndarray) -> None:
    ints, tab, leaf = integers(blob), tables(blob), leaf_of(blob)
    rng, known, less = np.random.default_rng(0), 0, 0
    for _ in range(COUNT):
        p, d, begin, end = grazing(blob, rng)
        bound = bend_along(ints, tab, leaf, *p, *d, begin, end)
        share = share_across(*(p + 0.5 * (begin + end) * d), *d, 0.5 * (end - begin))
        assert 0.0 < share <= 1.0
        less += share < 0.9
        if not np.isfinite(bound):
            continue
        known += 1
        t = np.linspace(begin, end, 41)
        slopes = np.array([excess_along(blob, ints, leaf, *(p + s * d), *d)[1] for s in t])
        assert np.abs(np.diff(slopes) / np.diff(t)).max() <= bound * (1 + 1e-9) + 1e-6
    assert known > 60
    assert less > 20


def test_the_bend_in_space_falls_by_the_direction() -> None:
    """In any direction, of a ball: F = |p|/R bends by |d|²/(R·|p|) across the ray, and not at all along it."""
    rng = np.random.default_rng(1)
    for _ in range(300):
        p, d = rng.normal(size=(2, 3))
        p *= 5.0 / np.sqrt(p @ p)
        across = d - (d @ p) * p / 25.0
        true = (across @ across) / (d @ d)
        assert share_across(*p, *d, 0.0) >= (1 - 1e-9) * true / (25.0 / np.abs(p).max() ** 2)  # at the face's least
        assert share_across(*p, *p, 0.0) < 1e-9
        assert share_across(*p, *d, 1e-3) >= share_across(*p, *d, 0.0) - 1e-12
    assert share_across(1.0, 0.0, 0.0, -1.0, 0.5, 0.0, 0.9) == 1.0  # it comes near the centre: nothing is known


def ready_run(blob: np.ndarray, runs: np.ndarray, p: np.ndarray, d: np.ndarray, begin: float, end: float) -> bool:
    """Put a run of one leaf that is ready into record 0; return whether its bend is known."""
    ints, tab, leaf = integers(blob), tables(blob), leaf_of(blob)
    before, after = (excess(blob, ints, leaf, *(p + t * d)) <= 0.0 for t in (begin, end))
    runs[0] = 0.0
    runs[0, at.CODE] = at.OWN + (at.BEFORE if before else 0) + (at.AFTER if after else 0)
    runs[0, at.RUN_BEGIN], runs[0, at.RUN_END], runs[0, at.GUESS] = begin, end, 0.5 * (begin + end)
    runs[0, at.RUN_FROM : at.RUN_FROM + 3], runs[0, at.RUN_TO : at.RUN_TO + 3] = p, d
    runs[0, at.RUN_BEND] = bend_along(ints, tab, leaf, *p, *d, begin, end)
    runs[0, at.RUN_GAP], runs[0, at.NEXT] = MERGE / np.sqrt(d @ d), -1.0
    return bool(np.isfinite(runs[0, at.RUN_BEND]))


def test_runs_have_the_crossings_of_f_along_them(blob: np.ndarray) -> None:
    """By exact slopes, halved or followed through the chart: what F says at a thousand steps."""
    ints, tab, leaf = integers(blob), tables(blob), leaf_of(blob)
    work, slots, pending = scratch()
    runs = work[PIECES + ROWS :].reshape(RUNS + at.HALVINGS, at.RUN_SIZE)
    rng, out = np.random.default_rng(2), np.empty(64)
    seen: dict[int, int] = {}
    twice = 0
    for _ in range(COUNT):
        p, d, begin, end = grazing(blob, rng)
        if not ready_run(blob, runs, p, d, begin, end):
            continue
        x = p + 0.5 * (begin + end) * d
        f, slope = excess_along(blob, ints, leaf, *x, *d)
        verdict = int(smooth_runs._prove(runs, 0, f, slope, runs[0, at.RUN_BEND]))
        seen[verdict] = seen.get(verdict, 0) + 1
        ready_run(blob, runs, p, d, begin, end)
        count = settle_run(
            blob, ints, tab, runs, 0, RUNS, 0.01, 0.001, runs[0, at.RUN_GAP], out, 0, work, slots, pending
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
