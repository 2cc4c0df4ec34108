"""The scale field along a line, of one direction and of eight side by side: the same bits, the formula's numbers."""

from __future__ import annotations

import ctypes

import llvmlite.binding as llvm
import numpy as np
import pytest
from llvmlite import ir

from hhsr.kernels.along import (
    ALONG_ROWS,
    EXCESS,
    PLACE,
    RISE,
    WAY,
    emit_excess,
    emit_field,
    emit_fields,
    excess_of,
    ray_along,
)
from hhsr.kernels.sphere_rbf import scale_on_sphere
from hhsr.kernels.vectors import LANES, load, store

Calls = tuple[object, object, object, object]
FIELD, CHANGE = EXCESS, RISE  # where the functions of this test put the scale field


@pytest.fixture(scope="module")
def calls() -> Calls:
    """What is emitted for one direction, for LANES, and for LANES points, as functions; and what keeps them."""
    double, long = ir.DoubleType(), ir.IntType(64)
    module = ir.Module()
    table = double.as_pointer()
    one = ir.Function(module, ir.FunctionType(ir.VoidType(), [table, table, long]), "one")
    builder = ir.IRBuilder(one.append_basic_block())
    way = [builder.load(builder.gep(one.args[0], [ir.Constant(long, k)])) for k in range(6)]
    sums = emit_field(builder, one.args[1], ir.Constant(long, 0), one.args[2], way[:3], way[3:])
    for k, total in enumerate(sums):
        builder.store(total, builder.gep(one.args[0], [ir.Constant(long, 6 + k)]))
    builder.ret_void()
    many = ir.Function(module, ir.FunctionType(ir.VoidType(), [table, table, long, long]), "many")
    builder = ir.IRBuilder(many.append_basic_block())
    given = [load(builder, many.args[0], LANES * k) for k in range(6)]
    for row, vector in zip(
        (FIELD, CHANGE),
        emit_fields(builder, many.args[1], ir.Constant(long, 0), *many.args[2:], given[:3], given[3:]),
        strict=True,
    ):
        store(builder, vector, many.args[0], row * LANES)
    builder.ret_void()
    points = ir.Function(module, ir.FunctionType(ir.VoidType(), [table, table, long, long]), "points")
    builder = ir.IRBuilder(points.append_basic_block())
    emit_excess(builder, points.args[0], points.args[1], ir.Constant(long, 0), ir.Constant(long, 6), *points.args[2:])
    builder.ret_void()
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(str(module)), machine)
    engine.finalize_object()
    pointer, integer = ctypes.c_void_p, ctypes.c_int64
    of_one = ctypes.CFUNCTYPE(None, pointer, pointer, integer)(engine.get_function_address("one"))
    of_many = ctypes.CFUNCTYPE(None, pointer, pointer, integer, integer)(engine.get_function_address("many"))
    of_points = ctypes.CFUNCTYPE(None, pointer, pointer, integer, integer)(engine.get_function_address("points"))
    return of_one, of_many, of_points, engine


def block_of(rng: np.random.Generator, real: int) -> np.ndarray:
    """Return a block's rows (5, count) of `real` centres, filled up by zeros."""
    block = np.zeros((5, -(-real // LANES) * LANES))
    centres = rng.normal(size=(3, real))
    block[:3, :real] = centres / np.sqrt((centres**2).sum(axis=0))
    block[3, :real], block[4, :real] = rng.uniform(0.4, 3.0, real), rng.normal(size=real)
    return block


@pytest.mark.parametrize("real", [0, 1, 8, 21, 40])
def test_eight_directions_have_the_sums_of_each_and_of_the_formula(calls: Calls, real: int) -> None:
    of_one, of_many, _, _ = calls
    rng = np.random.default_rng(real)
    block = block_of(rng, real)
    count = block.shape[1]
    rows = np.full((ALONG_ROWS, LANES), np.nan)
    unit = rng.normal(size=(3, LANES))
    unit /= np.sqrt((unit**2).sum(axis=0))
    way = rng.normal(size=(3, LANES))
    rows[:3], rows[3:6] = unit, way - (way * unit).sum(axis=0) * unit
    of_many(rows.ctypes.data, block.ctypes.data, count, real)  # type: ignore[operator]
    for lane in range(LANES):
        own = np.ascontiguousarray(rows[:, lane])
        own[FIELD:] = np.nan
        of_one(own.ctypes.data, block.ctypes.data, count)  # type: ignore[operator]
        assert np.array_equal(own[[FIELD, CHANGE]], rows[[FIELD, CHANGE], lane])
        at, along = rows[:3, lane], rows[3:6, lane]
        formula = [
            scale_on_sphere(*(at + step * along), block[:3].T.copy(), block[3], block[4]) for step in (0.0, 1e-6, -1e-6)
        ]
        size = np.abs(block[4]).sum()
        assert rows[FIELD, lane] == pytest.approx(formula[0], abs=1e-13 * (1 + size))
        assert rows[CHANGE, lane] == pytest.approx((formula[1] - formula[2]) / 2e-6, abs=1e-5 * (1 + size))


@pytest.mark.parametrize("real", [0, 5, 16])
def test_eight_points_have_the_value_and_slope_of_each(calls: Calls, real: int) -> None:
    of_one, _, of_points, _ = calls
    rng = np.random.default_rng(real)
    block = block_of(rng, real)
    block[4] *= 0.05
    blob = np.concatenate([rng.uniform(20.0, 60.0, 6), block.ravel()])
    rows = np.full((ALONG_ROWS, LANES), np.nan)
    rows[PLACE : PLACE + 3], rows[WAY : WAY + 3] = rng.normal(size=(3, LANES)) * 40, rng.normal(size=(3, LANES)) * 90
    of_points(rows.ctypes.data, blob.ctypes.data, block.shape[1], real)  # type: ignore[operator]
    for lane in range(LANES):
        place, way = rows[PLACE : PLACE + 3, lane].tolist(), rows[WAY : WAY + 3, lane].tolist()
        unit, tangent = ray_along(*place, *way)
        own = np.array([*unit, *tangent, np.nan, np.nan])
        of_one(own.ctypes.data, block.ctypes.data, block.shape[1])  # type: ignore[operator]
        alone = excess_of(blob, 0, *place, *way, own[FIELD], own[CHANGE])
        assert (rows[EXCESS, lane], rows[RISE, lane]) == alone
