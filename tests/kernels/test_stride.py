"""A stride of all lanes against the same stride written out for one, over tables drawn at random."""

from __future__ import annotations

import ctypes
import math

import llvmlite.binding as llvm
import numpy as np
import pytest
from llvmlite import ir

from hhsr.kernels import lane as at
from hhsr.kernels.stride import emit_stride
from hhsr.kernels.vectors import LANES
from hhsr.kernels.voxels import FARTHEST_STEP, IN_BYTE, NO_SURFEL, OUT_BYTE, STEP_BITS, STEP_WORDS

SHAPE = (3, 4, 5)  # bricks
SLOTS, SURFELS = 40, 90


class Tables:
    """Tables as a grid has them, of random numbers, one after the other in one array of 32-bit words."""

    def __init__(self, rng: np.random.Generator) -> None:
        count = int(np.prod(SHAPE))
        leaps = rng.choice([0, 0, 0, 1, 2, 255, 254, 127], (8, count)).astype(np.uint8)
        slots = rng.integers(0, SLOTS, count).astype(np.int32)
        slots[rng.random(count) < 0.2] = -2
        leaps[:, slots < 0] = rng.choice([1, 3, 255], (8, int((slots < 0).sum())))
        octets = rng.choice([NO_SURFEL, IN_BYTE, OUT_BYTE, *range(30)], (SLOTS, 64)).astype(np.uint8)
        planes = rng.normal(size=(SLOTS, 4)).astype(np.float32) * rng.choice([1, 1e-3], (SLOTS, 1)).astype(np.float32)
        planes[: SLOTS // 2, 3] = rng.normal(size=SLOTS // 2) * 9  # so that many decide their brick
        surfels = rng.normal(size=(SURFELS, 4)).astype(np.float32)
        surfels[:, 3] *= 3
        surfels[rng.random(SURFELS) < 0.1] = np.nan
        pieces = [
            leaps.view(np.int32).reshape(-1), slots, rng.integers(0, SURFELS - 30, SLOTS).astype(np.int32),
            octets.view(np.int32).reshape(-1), planes.view(np.int32).reshape(-1), surfels.view(np.int32).reshape(-1),
            rng.integers(-(2**31), 2**31, 8 * SLOTS * STEP_WORDS).astype(np.int32),
            np.zeros(4 * SURFELS, dtype=np.int32),
        ]  # fmt: skip
        self.words = np.concatenate(pieces)
        starts = [int(n) for n in np.concatenate([[0], np.cumsum([len(piece) for piece in pieces])])]
        self.leaps, self.bricks, self.bases = 4 * starts[0], starts[1], starts[2]
        self.octets, self.brick_planes, self.planes = 4 * starts[3], starts[4], starts[5]
        self.steps, self.details = starts[6], starts[7]
        self.bytes, self.floats = self.words.view(np.uint8), self.words.view(np.float32)

    @property
    def grid(self) -> list[int]:
        return [*SHAPE, self.bricks, self.bases, self.octets, self.brick_planes, self.planes, self.details]

    def plane(self, start: int, number: int) -> np.ndarray:
        return self.floats[start + 4 * number :][:4].astype(float)


def random_lanes(rng: np.random.Generator, tables: Tables) -> np.ndarray:
    """Return lanes on their way through the grid; some at their end, some along axes, some that have not begun."""
    lanes = np.zeros((at.ROWS, LANES))
    for lane in range(LANES):
        start, stop = rng.uniform(0, 4, (2, 3)) * SHAPE
        v = stop - start
        v[rng.random(3) < 0.1] = 0.0
        lanes[at.U : at.U + 3, lane], lanes[at.V : at.V + 3, lane] = start, v
        still = v == 0.0
        with np.errstate(all="ignore"):
            lanes[at.INVERSE : at.INVERSE + 3, lane] = np.where(still, 0.0, 1.0 / v)
            lanes[at.SHIFT : at.SHIFT + 3, lane] = np.where(still, np.inf, -start / v)
        lanes[at.SIGN : at.SIGN + 3, lane] = np.where(v >= 0, 1.0, -1.0)
        lanes[at.BACK : at.BACK + 3, lane] = v < 0
        lanes[at.T, lane], lanes[at.STOP, lane] = rng.uniform(0, 1), rng.choice([0.5, 1.0, 1.0, 1.0])
        lanes[at.NUDGED, lane], lanes[at.STATE, lane] = 1e-9, rng.choice([-1.0, 0.0, 1.0])
        octant = int((v >= 0) @ [1, 2, 4])
        lanes[at.LEAP_TABLE, lane] = tables.leaps + octant * np.prod(SHAPE)
        lanes[at.STEP_TABLE, lane] = tables.steps + octant * SLOTS * STEP_WORDS
    return lanes


def twin(tables: Tables, lanes: np.ndarray, lane: int) -> tuple[bool, float, float, int]:
    """Return (whether one lane takes a stride, t, state, surfel left open) after it: what stride says it does."""
    t, stop, state = (float(lanes[row, lane]) for row in (at.T, at.STOP, at.STATE))
    way = lanes[at.V : at.V + 3, lane]
    place = lanes[at.U : at.U + 3, lane] + t * way
    voxel = np.clip(place.astype(int), 0, 4 * np.array(SHAPE) - 1)
    brick = int(np.ravel_multi_index(tuple(voxel // 4), SHAPE))
    leap = int(tables.bytes[int(lanes[at.LEAP_TABLE, lane]) + brick])
    cell, size, reach, far, surfel = voxel, 1, 1, math.inf, -1
    plain = proven = False
    known: bool | None = None
    slot = int(tables.words[tables.bricks + brick])
    if leap:
        cell, size, reach, known = voxel // 4, 4, leap if leap < 128 else 256 - leap, leap < 128
    else:
        gx, gy, gz, offset = tables.plane(tables.brick_planes, slot)
        middle = 4 * (voxel // 4) + 2
        level = gx * (place[0] - middle[0]) + gy * (place[1] - middle[1]) + gz * (place[2] - middle[2]) + offset
        slope = gx * way[0] + gy * way[1] + gz * way[2]
        inner = int(voxel[0] % 4 * 16 + voxel[1] % 4 * 4 + voxel[2] % 4)
        byte = int(tables.bytes[tables.octets + 64 * slot + inner])
        plain, proven = abs(level) > 1.0, byte > NO_SURFEL
        if proven:
            known = byte < OUT_BYTE
            word = int(np.uint32(tables.words[int(lanes[at.STEP_TABLE, lane]) + STEP_WORDS * slot + inner // 16]))
            reach = 1 << (word >> STEP_BITS * (inner % 16) & FARTHEST_STEP)
        if plain:  # the brick's own plane decides, and the voxel's leap may go on farther
            known = bool(level < 0.0)
            if (level > 0.0) != (slope > 0.0) and slope != 0.0:
                far = t + (abs(level) - 1.0) / abs(slope)
        elif byte < NO_SURFEL:
            surfel = int(tables.words[tables.bases + slot]) + byte

    def met(border: np.ndarray) -> float:
        return float(min(border * lanes[at.INVERSE : at.INVERSE + 3, lane] + lanes[at.SHIFT : at.SHIFT + 3, lane]))

    sign, back = lanes[at.SIGN : at.SIGN + 3, lane], lanes[at.BACK : at.BACK + 3, lane]
    end = met(size * (cell + sign * reach + back))
    if plain:
        far = min(far, met(4 * (voxel // 4 + sign + back)))
        end = max(end, far) if proven else far
    end = min(end, stop)
    if surfel >= 0:
        gx, gy, gz, offset = tables.plane(tables.planes, surfel)
        x, y, z = place - voxel - 0.5
        depth = gx * x + gy * y + gz * z + offset
        left = depth + (gx * way[0] + gy * way[1] + gz * way[2]) * (end - t)
        if min(abs(depth), abs(left)) > 1.0 and (depth > 0.0) == (left > 0.0):
            known = bool(depth < 0.0)
        if known is not None or math.isnan(depth):
            surfel = -1
    if t >= stop:
        surfel = -1
    taken = known is not None and t < stop and state in (-1.0, float(known))
    return (True, max(end, t) + 1e-9, float(bool(known)), surfel) if taken else (False, t, state, surfel)


@pytest.fixture(scope="module")
def stride() -> object:
    """The stride as a function of addresses and the grid's numbers, compiled."""
    double, single, word, long = ir.DoubleType(), ir.FloatType(), ir.IntType(32), ir.IntType(64)
    module = ir.Module()
    kind = ir.FunctionType(long, [double.as_pointer(), word.as_pointer(), single.as_pointer(), *[long] * 9])
    function = ir.Function(module, kind, "stride")
    builder = ir.IRBuilder(function.append_basic_block())
    builder.ret(emit_stride(builder, *function.args[:3], function.args[3:]))
    llvm.initialize_native_target()
    llvm.initialize_native_asmprinter()
    machine = llvm.Target.from_default_triple().create_target_machine()
    engine = llvm.create_mcjit_compiler(llvm.parse_assembly(str(module)), machine)
    engine.finalize_object()
    call = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_void_p] * 3, *[ctypes.c_int64] * 9)(
        engine.get_function_address("stride")
    )
    return engine, call


def test_a_stride_of_all_lanes_is_that_of_each(stride: tuple[object, object]) -> None:
    _, call = stride
    rng = np.random.default_rng(3)
    took, opened = 0, 0
    for _ in range(800):
        tables = Tables(rng)
        lanes = random_lanes(rng, tables)
        before = lanes.copy()
        bits = call(lanes.ctypes.data, tables.words.ctypes.data, tables.words.ctypes.data, *tables.grid)
        for lane in range(LANES):
            taken, t, state, surfel = twin(tables, before, lane)
            assert bool(bits >> lane & 1) == taken
            assert lanes[at.T, lane] == t
            assert lanes[at.STATE, lane] == state
            assert lanes[at.SURFEL, lane] == surfel
            begun = taken and before[at.STATE, lane] < 0
            assert lanes[at.BEGIN, lane] == (state if begun else before[at.BEGIN, lane])
            took, opened = took + taken, opened + (surfel >= 0)
    assert took > 1000
    assert opened > 100
