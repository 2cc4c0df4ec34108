"""The scale field along a line, eight centres at a time: the formula's numbers."""

from __future__ import annotations

import ctypes

import numpy as np
import pytest
from llvmlite import ir

from hhsr.kernels.along import emit_field, excess_of, ray_along
from hhsr.kernels.sphere_rbf import scale_on_sphere
from hhsr.kernels.vectors import LANES
from tests.kernels.emitted import engine_of

FIELD, CHANGE, ALONE, SIZE = 6, 7, 8, 9  # of the functions' numbers: a direction, a way, and what is filled in


@pytest.fixture(scope="module")
def call() -> tuple[object, object]:
    """What is emitted for a direction, with a way and without, as a function; and what keeps it."""
    double, long = ir.DoubleType(), ir.IntType(64)
    module = ir.Module()
    table = double.as_pointer()
    function = ir.Function(module, ir.FunctionType(ir.VoidType(), [table, table, long]), "field")
    builder = ir.IRBuilder(function.append_basic_block())
    numbers, block, count = function.args
    way = [builder.load(builder.gep(numbers, [ir.Constant(long, k)])) for k in range(6)]
    sums = emit_field(builder, block, ir.Constant(long, 0), count, way[:3], way[3:])
    sums += emit_field(builder, block, ir.Constant(long, 0), count, way[:3], ())
    for k, total in enumerate(sums):
        builder.store(total, builder.gep(numbers, [ir.Constant(long, FIELD + k)]))
    builder.ret_void()
    engine = engine_of(module)
    kind = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_void_p, ctypes.c_int64)
    return kind(engine.get_function_address("field")), engine


def block_of(rng: np.random.Generator, real: int) -> np.ndarray:
    """Return a block's rows (5, count) of `real` centres, filled up by zeros."""
    block = np.zeros((5, -(-real // LANES) * LANES))
    centres = rng.normal(size=(3, real))
    block[:3, :real] = centres / np.sqrt((centres**2).sum(axis=0))
    block[3, :real], block[4, :real] = rng.uniform(0.4, 3.0, real), rng.normal(size=real)
    return block


@pytest.mark.parametrize("real", [0, 1, 8, 21, 40])
def test_a_direction_has_the_sums_of_the_formula(call: tuple[object, object], real: int) -> None:
    rng = np.random.default_rng(real)
    block = block_of(rng, real)
    size = np.abs(block[4]).sum()
    for _ in range(8):
        unit, way = rng.normal(size=(2, 3))
        unit /= np.sqrt(unit @ unit)
        way -= (way @ unit) * unit
        numbers = np.full(SIZE, np.nan)
        numbers[:6] = *unit, *way
        call[0](numbers.ctypes.data, block.ctypes.data, block.shape[1])  # type: ignore[operator]
        formula = [
            scale_on_sphere(*(unit + step * way), block[:3].T.copy(), block[3], block[4]) for step in (0.0, 1e-6, -1e-6)
        ]
        assert numbers[FIELD] == numbers[ALONE] == pytest.approx(formula[0], abs=1e-13 * (1 + size))
        assert numbers[CHANGE] == pytest.approx((formula[1] - formula[2]) / 2e-6, abs=1e-5 * (1 + size))


def test_f_and_its_change_are_those_of_the_formula() -> None:
    """F = N/(1 − s), with a change of s that is told: against its difference a little farther on."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        half_axes, s, ds = rng.uniform(20.0, 60.0, 6), rng.uniform(-0.3, 0.3), rng.normal() * 0.1
        place, way = rng.normal(size=(2, 3)) * 40
        unit, tangent = ray_along(*place, *way)
        assert np.dot(unit, tangent) == pytest.approx(0.0, abs=1e-9)
        f, change = excess_of(half_axes, 0, *place, *way, s, ds)
        sides = np.where(place > 0.0, half_axes[::2], half_axes[1::2])
        norms = [np.sqrt(np.sum(((place + step * way) / sides) ** 2)) for step in (0.0, 1e-6, -1e-6)]
        assert f == pytest.approx(norms[0] / (1.0 - s) - 1.0, abs=1e-12)
        ahead, behind = norms[1] / (1.0 - s - 1e-6 * ds), norms[2] / (1.0 - s + 1e-6 * ds)
        assert change == pytest.approx((ahead - behind) / 2e-6, abs=1e-6)
