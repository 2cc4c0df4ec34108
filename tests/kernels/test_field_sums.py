"""The scale field of a block's centres, eight at a time: the formula's numbers, emitted and as arrays."""

from __future__ import annotations

import ctypes
import math
from collections.abc import Callable

import numpy as np
import pytest
from llvmlite import ir

from hhsr.kernels.either_lanes import Counted
from hhsr.kernels.field_sums import (
    along_terms,
    bend_terms,
    field_along,
    field_at,
    field_bend,
    field_slopes,
    slope_terms,
    sums_function,
    value_terms,
)
from hhsr.kernels.sphere_rbf import scale_on_sphere
from hhsr.kernels.vectors import DOUBLE, LANES, LONG, Vector, load, totals
from tests.kernels.emitted import engine_of

TERMS = {"value": (value_terms, 3, 1), "along": (along_terms, 6, 2), "slope": (slope_terms, 3, 3)}
TERMS["bend"] = (bend_terms, 3, 7)
REAL = [0, 1, 8, 21, 40]


def block_of(rng: np.random.Generator, real: int) -> np.ndarray:
    """Return a block's rows (5, count) of `real` centres, filled up by zeros."""
    block = np.zeros((5, -(-real // LANES) * LANES))
    centres = rng.normal(size=(3, real))
    block[:3, :real] = centres / np.sqrt((centres**2).sum(axis=0))
    block[3, :real], block[4, :real] = rng.uniform(0.4, 3.0, real), rng.normal(size=real)
    return block


def formula(block: np.ndarray, x: float, y: float, z: float) -> float:
    """Return s of a direction of any length."""
    length = math.sqrt(x * x + y * y + z * z)
    return float(scale_on_sphere(x / length, y / length, z / length, block[:3].T.copy(), block[3], block[4]))


@pytest.fixture(scope="module", params=list(TERMS))
def emitted(request: pytest.FixtureRequest) -> tuple[Callable[..., np.ndarray], str]:
    """What is emitted for one kind of sums, as a function of (block, rows, direction), and which it is."""
    terms, size, sums = TERMS[request.param]
    module = ir.Module()
    function = sums_function(module, terms, sums, size)
    assert sums_function(module, terms, sums, size) is function
    tables, number = [DOUBLE.as_pointer()] * 3, ir.Constant(LONG, 5)
    outer = ir.Function(module, ir.FunctionType(ir.VoidType(), [*tables, LONG.as_pointer(), LONG]), "outer")
    builder = ir.IRBuilder(outer.append_basic_block())
    block, unit, filled, rows, count = outer.args
    given = [builder.load(builder.gep(rows, [ir.Constant(LONG, k)])) for k in range(number.constant)]
    direction = [builder.load(builder.gep(unit, [ir.Constant(LONG, k)])) for k in range(size)]
    answer = builder.call(function, [block, *given, count, *direction])
    for k in range(sums):
        builder.store(builder.extract_value(answer, k), builder.gep(filled, [ir.Constant(LONG, k)]))
    builder.ret_void()
    engine = engine_of(module)
    compiled = ctypes.CFUNCTYPE(None, *[ctypes.c_void_p] * 4, ctypes.c_int64)(engine.get_function_address("outer"))

    def call(block: np.ndarray, rows: list[int], unit: list[float], keep: object = engine) -> np.ndarray:
        out, slots, direction = np.full(sums, np.nan), np.array(rows), np.array(unit)
        compiled(block.ctypes.data, direction.ctypes.data, out.ctypes.data, slots.ctypes.data, block.shape[1])
        return out

    return call, request.param


@pytest.mark.parametrize("real", REAL)
def test_what_is_emitted_is_what_arrays_give(emitted: tuple[Callable[..., np.ndarray], str], real: int) -> None:
    call, name = emitted
    terms, size, _ = TERMS[name]
    rng = np.random.default_rng(real)
    block = block_of(rng, real)
    rows = [k * block.shape[1] for k in (1, 2, 0, 3, 4)]
    for _ in range(8):
        unit = rng.normal(size=size)
        unit[:3] /= np.sqrt(unit[:3] @ unit[:3])
        expected = [float((one * other).sum()) for one, other in terms(Counted(), unit, block[[1, 2, 0, 3, 4]])]
        scale = 1 + np.abs(block[4]).sum()
        np.testing.assert_allclose(call(block, rows, list(unit)), expected, rtol=1e-12, atol=1e-12 * scale)


@pytest.mark.parametrize("real", REAL)
def test_a_direction_has_the_field_of_the_formula(real: int) -> None:
    rng = np.random.default_rng(real)
    block = block_of(rng, real)
    blob, size = np.concatenate([rng.normal(size=7), block.ravel()]), 1 + np.abs(block[4]).sum()
    for _ in range(8):
        unit, way = rng.normal(size=(2, 3))
        unit /= np.sqrt(unit @ unit)
        way -= (way @ unit) * unit
        ahead, behind = (formula(block, *(unit + step * way)) for step in (1e-6, -1e-6))
        s, ds = field_along(blob, 7, block.shape[1], tuple(unit), tuple(way))
        assert s == field_at(blob, 7, block.shape[1], tuple(unit))
        assert s == pytest.approx(formula(block, *unit), abs=1e-13 * size)
        assert ds == pytest.approx((ahead - behind) / 2e-6, abs=1e-5 * size)


@pytest.mark.parametrize("real", REAL)
@pytest.mark.parametrize("face", range(6))
def test_a_chart_has_the_slopes_and_bends_of_the_formula(real: int, face: int) -> None:
    rng = np.random.default_rng(10 * real + face)
    block = block_of(rng, real)
    blob, size = np.concatenate([rng.normal(size=7), block.ravel()]), 1 + np.abs(block[4]).sum()
    axis, sign, step = face // 2, 1.0 - 2.0 * (face % 2), 1e-4

    def field(a: float, b: float) -> float:
        return formula(block, *np.roll([sign, a, b], axis))

    for _ in range(4):
        a, b = rng.uniform(-1.0, 1.0, 2)
        q = 1.0 / math.sqrt(1.0 + a * a + b * b)
        s, *slopes, aa, ab, bb = field_bend(blob, 7, block.shape[1], axis, sign * q, q * a, q * b, q)
        assert (s, *slopes) == pytest.approx(
            field_slopes(blob, 7, block.shape[1], axis, sign * q, q * a, q * b, q), abs=1e-12 * size
        )
        assert s == pytest.approx(field(a, b), abs=1e-13 * size)
        grid = np.array([[field(a + i * step, b + j * step) for j in (-1, 0, 1)] for i in (-1, 0, 1)])
        expected = [(grid[2, 1] - grid[0, 1]) / (2 * step), (grid[1, 2] - grid[1, 0]) / (2 * step)]
        assert slopes == pytest.approx(expected, abs=1e-4 * size)
        bends = [
            (grid[2, 1] - 2 * grid[1, 1] + grid[0, 1]) / step**2,
            (grid[2, 2] - grid[2, 0] - grid[0, 2] + grid[0, 0]) / (4 * step**2),
            (grid[1, 2] - 2 * grid[1, 1] + grid[1, 0]) / step**2,
        ]
        assert [aa, ab, bb] == pytest.approx(bends, abs=1e-2 * size)


@pytest.mark.parametrize("count", range(1, LANES + 1))
def test_totals_are_the_sums_of_all_lanes(count: int) -> None:
    module = ir.Module()
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [DOUBLE.as_pointer()] * 2), "sums")
    builder = ir.IRBuilder(function.append_basic_block())
    numbers: list[Vector] = [load(builder, function.args[0], LANES * k) for k in range(count)]
    for k, total in enumerate(totals(numbers)):
        builder.store(total, builder.gep(function.args[1], [ir.Constant(LONG, k)]))
    builder.ret_void()
    engine = engine_of(module)
    given, out = np.random.default_rng(count).normal(size=(count, LANES)), np.full(count, np.nan)
    ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p)(engine.get_function_address("sums"))(
        given.ctypes.data, out.ctypes.data
    )
    np.testing.assert_allclose(out, given.sum(axis=1), rtol=1e-12, atol=1e-14)
