"""Runs settled by their cells: the formulas in emitted code and in arrays, what they prove against F along lines."""

from __future__ import annotations

import ctypes
from collections.abc import Callable

import numpy as np
import pytest
from llvmlite import ir

from hhsr.kernels import cell_along as told
from hhsr.kernels import runs as at
from hhsr.kernels.lane import MERGE
from hhsr.kernels.layout import LANES, integers, tables
from hhsr.kernels.stretch import excess_along
from hhsr.kernels.table_lanes import CountedTables
from tests.kernels.emitted import engine_of
from tests.kernels.small_solids import arithmetic_of_c, solid  # noqa: F401
from tests.kernels.test_smooth_runs import grazing, leaf_of, put_run

COUNT = 160
TOLERANCE = 0.001
STEPS = 400


@pytest.fixture(scope="module")
def blob() -> np.ndarray:
    """A leaf with a dozen centres, compiled."""
    return solid("smooth").compiled.blob


@pytest.fixture(scope="module")
def runs(blob: np.ndarray) -> np.ndarray:
    """Runs of one leaf, COUNT of them, most of which all but touch its surface."""
    rng, runs = np.random.default_rng(4), np.zeros((COUNT, at.RUN_SIZE))
    for k in range(COUNT):
        p, d, begin, end = grazing(blob, rng)
        if k % 4 == 0:  # a part of them crosses steeply
            d = p + 0.5 * d
            p = 0.5 * d
        put_run(blob, runs, k, p, d, begin, end)
    return runs


def in_arrays(blob: np.ndarray, runs: np.ndarray) -> np.ndarray:
    """Return rows (GIVEN, COUNT) of all runs by arrays."""
    rows = np.zeros((told.GIVEN, COUNT))
    rows[told.RUN] = np.arange(COUNT)
    with np.errstate(all="ignore"):
        on = CountedTables(runs, blob, integers(blob), tables(blob))
        rows[told.KNOWN :] = told.settled(on, rows[told.RUN], TOLERANCE)
    return rows


@pytest.fixture(scope="module")
def emitted() -> tuple[dict[int, Callable[..., None]], object]:
    """What is emitted for LANES and for one, as functions of five tables and a tolerance; and what keeps them."""
    double, long, single = ir.DoubleType().as_pointer(), ir.IntType(64).as_pointer(), ir.FloatType().as_pointer()
    kind = ir.FunctionType(ir.VoidType(), [double, double, double, long, single, ir.DoubleType()])
    module = ir.Module()
    for lanes in (LANES, 1):
        function = ir.Function(module, kind, f"settle{lanes}")
        builder = ir.IRBuilder(function.append_basic_block())
        told.emit_settled(builder, lanes, *function.args)
        builder.ret_void()
    engine = engine_of(module)
    call = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 5, ctypes.c_double)
    return {lanes: call(engine.get_function_address(f"settle{lanes}")) for lanes in (LANES, 1)}, engine


def test_emitted_code_has_what_arrays_have(
    blob: np.ndarray, runs: np.ndarray, emitted: tuple[dict[int, Callable[..., None]], object]
) -> None:
    """And in one lane the same bits as in LANES."""
    expected, calls = in_arrays(blob, runs), emitted[0]
    ints, tab = integers(blob), tables(blob)
    for first in range(0, COUNT, LANES):
        rows = np.full((told.CELL_ROWS, LANES), np.nan)
        rows[told.RUN] = np.arange(first, first + LANES)
        calls[LANES](*(table.ctypes.data for table in (rows, runs, blob, ints, tab)), TOLERANCE)
        own = expected[:, first : first + LANES]
        assert np.array_equal(rows[[told.KNOWN, told.NEW_CODE]], own[[told.KNOWN, told.NEW_CODE]])
        np.testing.assert_allclose(rows[told.AT : told.GIVEN], own[told.AT :], rtol=1e-9, atol=1e-9)
        for lane in range(LANES):
            alone = np.full((told.CELL_ROWS, LANES), np.nan)
            alone[told.RUN, 0] = first + lane
            calls[1](*(table.ctypes.data for table in (alone, runs, blob, ints, tab)), TOLERANCE)
            assert np.array_equal(alone[: told.GIVEN, 0], rows[: told.GIVEN, lane], equal_nan=True)


def test_what_cells_tell_of_a_run_holds_along_it(blob: np.ndarray, runs: np.ndarray) -> None:
    """F and its slope lie within their strays, its bend below its bound; states and crossings are those of F."""
    ints, leaf, rows = integers(blob), leaf_of(blob), in_arrays(blob, runs)
    for k in range(COUNT):
        p, d = runs[k, at.RUN_FROM : at.RUN_FROM + 3], runs[k, at.RUN_TO : at.RUN_TO + 3]
        begin, end = runs[k, at.RUN_BEGIN], runs[k, at.RUN_END]
        known, t = rows[told.KNOWN, k], rows[told.AT, k]
        f, slope = excess_along(blob, ints, leaf, *(p + 0.5 * (begin + end) * d), *d)
        assert abs(f - rows[told.EXCESS, k]) <= rows[told.EXCESS_STRAY, k] + 1e-12
        value, there = excess_along(blob, ints, leaf, *(p + t * d), *d)
        assert abs(there - rows[told.RISE, k]) <= rows[told.RISE_STRAY, k] + 1e-9
        s = np.linspace(begin, end, STEPS)
        along = np.array([excess_along(blob, ints, leaf, *(p + x * d), *d) for x in s])
        assert np.abs(np.diff(along[:, 1]) / np.diff(s)).max() <= rows[told.BENDS, k] * (1 + 1e-9) + 1e-6
        changes = s[1:][np.diff(along[:, 0] <= 0.0)]
        if known == told.NOWHERE:
            assert len(changes) == 0
        if known in (told.ONCE, told.SURE, told.AGAIN):
            assert len(changes) == 1
            assert np.abs(along[:, 1]).min() >= rows[told.STEEP, k] * (1 - 1e-9)
            assert (int(rows[told.NEW_CODE, k]) & at.RISES != 0) == (slope > 0.0)
        if known == told.SURE:
            assert abs(value / there) <= TOLERANCE * runs[k, at.RUN_GAP] / MERGE
        if known == told.ONCE:  # what one exact value is asked with
            unit, norm = rows[told.UNIT : told.UNIT + 3, k], rows[told.NORM, k]
            x = p + t * d
            np.testing.assert_allclose(unit, x / np.sqrt(x @ x), rtol=0, atol=1e-12)
            first, count = int(rows[told.FIRST, k]), int(rows[told.COUNT, k])
            s = told_field(blob, first, count, unit)
            assert norm / (1.0 - s) - 1.0 == pytest.approx(value, abs=1e-11)
    seen = {int(known) for known in rows[told.KNOWN]}
    assert {told.ASKED, told.ONCE, told.NOWHERE} <= seen
    assert seen & {told.SURE, told.AGAIN}


def told_field(blob: np.ndarray, first: int, count: int, unit: np.ndarray) -> float:
    """Return Σ w λ(h) over a block's centres, by the formula."""
    x, y, z, inverse, weight = blob[first : first + 5 * count].reshape(5, count)
    h = np.minimum((1.0 - (x * unit[0] + y * unit[1] + z * unit[2])) * inverse, 1.0)
    return float(np.sum(weight * np.exp(-4.0 * h) * (1.0 - h) ** 2))


def test_runs_that_no_cell_knows_are_left_open(blob: np.ndarray, runs: np.ndarray) -> None:
    """Those of nobody, of no length in t, and with a bend that is not known."""
    other = runs.copy()
    other[0, at.CODE], other[1, at.CODE] = at.CLIPPED, at.POINT
    other[2, at.RUN_BEND] = np.inf
    other[3, at.RUN_END] = other[3, at.RUN_BEGIN]
    other[4, at.RUN_FROM : at.RUN_FROM + 3] = (
        -0.5 * (other[4, at.RUN_BEGIN] + other[4, at.RUN_END]) * other[4, at.RUN_TO : at.RUN_TO + 3]
    )  # through the leaf's centre
    rows = in_arrays(blob, other)
    assert (rows[told.KNOWN, :3] == told.ASKED).all()
    assert rows[told.KNOWN, 4] in (told.ASKED, told.NOWHERE)


def test_the_bend_in_space_falls_by_the_direction() -> None:
    """In any direction, of a ball: F = |p|/R bends by |d|²/(R·|p|) across the ray, and not at all along it."""
    on = CountedTables(np.zeros(1), np.zeros(1), np.zeros(1, dtype=int), np.zeros(1))
    rng = np.random.default_rng(1)

    def share(p: np.ndarray, d: np.ndarray, reach: float) -> float:
        with np.errstate(all="ignore"):
            return float(told._share_across(on, p, d, reach))

    for _ in range(300):
        p, d = rng.normal(size=(2, 3))
        p *= 5.0 / np.sqrt(p @ p)
        across = d - (d @ p) * p / 25.0
        true = (across @ across) / (d @ d)
        assert share(p, d, 0.0) >= (1 - 1e-9) * true / (25.0 / np.abs(p).max() ** 2)  # at the face's least
        assert share(p, p, 0.0) < 1e-9
        assert share(p, d, 1e-3) >= share(p, d, 0.0) - 1e-12
    assert share(np.array([1.0, 0.0, 0.0]), np.array([-1.0, 0.5, 0.0]), 0.9) == 1.0  # near the centre nothing is known
