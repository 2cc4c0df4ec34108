"""A stride of all lanes against the same stride written out for one, over tables drawn at random."""

from __future__ import annotations

import ctypes
import math

import numpy as np
import pytest
from llvmlite import ir

from hhsr.kernels import lane as at
from hhsr.kernels.stride import emit_stride
from hhsr.kernels.surfel import FINE
from hhsr.kernels.voxels import BRICK_SIZE, NO_SURFEL, leap_of, state_of, step_of
from tests.kernels.emitted import engine_of

SHAPE = (3, 4, 5)  # bricks
SLOTS, SURFELS = 40, 90


class Tables:
    """Tables as a grid has them, of random numbers, one after the other in one array of 32-bit words."""

    def __init__(self, rng: np.random.Generator) -> None:
        count = int(np.prod(SHAPE))
        bricks = np.zeros((count, BRICK_SIZE), dtype=np.int32)
        proven = rng.random(count) < 0.3
        bricks[:, :2] = short_planes(rng, count, 9).view(np.int32)
        bricks[proven, :2] = rng.choice([1, 2, 3, 127, -1, -2], (proven.sum(), 8)).astype(np.int8).view(np.int32)
        bricks[:, 2] = np.where(proven, -1, 64 * rng.integers(0, SLOTS, count))
        bricks[:, 3] = rng.integers(0, SURFELS - 30, count)
        voxels = rng.choice([NO_SURFEL, *range(30)], SLOTS * 64)
        settled = rng.random(SLOTS * 64) < 0.5
        voxels[settled] = rng.integers(-(2**15), 0, settled.sum())
        pieces = [
            bricks.reshape(-1), voxels.astype(np.int16).view(np.int32),
            short_planes(rng, SURFELS, 3).view(np.int32).reshape(-1), np.zeros(4 * SURFELS, dtype=np.int32),
        ]  # fmt: skip
        self.words = np.concatenate(pieces)
        starts = [int(n) for n in np.concatenate([[0], np.cumsum([len(piece) for piece in pieces])])]
        self.bricks, self.voxels, self.planes, self.details = starts[0], 2 * starts[1], starts[2], starts[3]
        self.shorts = self.words.view(np.int16)

    @property
    def grid(self) -> list[int]:
        return [*SHAPE, self.bricks, self.voxels, self.planes, self.details]

    def plane(self, word: int) -> np.ndarray:
        """Return the plane that begins at a 32-bit word."""
        return self.shorts[2 * word :][:4].astype(float)


def short_planes(rng: np.random.Generator, count: int, offset: float) -> np.ndarray:
    """Return (count, 4) 16-bit planes; some nearly flat, so that their offset decides."""
    planes = rng.normal(size=(count, 4)) * rng.choice([1, 1e-2], (count, 1))
    planes[: count // 2, 3] = rng.normal(size=count // 2) * offset
    planes[rng.random(count) < 0.05] = 0.0  # none
    return np.rint(np.clip(planes * FINE, -32000, 32000)).astype(np.int16)


def random_lanes(rng: np.random.Generator, tables: Tables) -> np.ndarray:
    """Return lanes on their way through the grid; some at their end, some along axes, some that have not begun."""
    lanes = np.zeros((at.ROWS, at.ABREAST))
    for lane in range(at.ABREAST):
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
        lanes[at.OCTANT, lane] = octant
    return lanes


def twin(tables: Tables, lanes: np.ndarray, lane: int) -> tuple[bool, float, float, int]:
    """Return (whether one lane takes a stride, t, state, surfel left open) after it: what stride says it does."""
    t, stop, state = (float(lanes[row, lane]) for row in (at.T, at.STOP, at.STATE))
    way = lanes[at.V : at.V + 3, lane]
    place = lanes[at.U : at.U + 3, lane] + t * way
    voxel = np.clip(place.astype(int), 0, 4 * np.array(SHAPE) - 1)
    brick = tables.bricks + BRICK_SIZE * int(np.ravel_multi_index(tuple(voxel // 4), SHAPE))
    octant, first = int(lanes[at.OCTANT, lane]), int(tables.words[brick + 2])
    cell, size, reach, far, surfel = voxel, 1, 1, math.inf, -1
    plain = proven = False
    known: bool | None = None
    if first < 0:
        leap = int(leap_of(tables.words, brick, octant))
        cell, size, reach, known = voxel // 4, 4, abs(leap), leap > 0
    else:
        gx, gy, gz, offset = tables.plane(brick)
        middle = 4 * (voxel // 4) + 2
        level = gx * (place[0] - middle[0]) + gy * (place[1] - middle[1]) + gz * (place[2] - middle[2]) + offset
        level, slope = level / FINE, (gx * way[0] + gy * way[1] + gz * way[2]) / FINE
        inner = int(voxel[0] % 4 * 16 + voxel[1] % 4 * 4 + voxel[2] % 4)
        held = int(tables.shorts[tables.voxels + first + inner])
        plain, proven = abs(level) > 1.0, held < 0
        if proven:
            known, reach = state_of(held) > 0, step_of(held, octant) + 1
        if plain:  # the brick's own plane decides, and the voxel's leap may go on farther
            known = bool(level < 0.0)
            if (level > 0.0) != (slope > 0.0) and slope != 0.0:
                far = t + (abs(level) - 1.0) / abs(slope)
        elif 0 <= held < NO_SURFEL:
            surfel = int(tables.words[brick + 3]) + held

    def met(border: np.ndarray) -> float:
        return float(min(border * lanes[at.INVERSE : at.INVERSE + 3, lane] + lanes[at.SHIFT : at.SHIFT + 3, lane]))

    sign, back = lanes[at.SIGN : at.SIGN + 3, lane], lanes[at.BACK : at.BACK + 3, lane]
    end = met(size * (cell + sign * reach + back))
    if plain:
        far = min(far, met(4 * (voxel // 4 + sign + back)))
        end = max(end, far) if proven else far
    end = min(end, stop)
    if surfel >= 0:
        gx, gy, gz, offset = tables.plane(tables.planes + 2 * surfel)
        x, y, z = place - voxel - 0.5
        depth = (gx * x + gy * y + gz * z + offset) / FINE
        left = depth + (gx * way[0] + gy * way[1] + gz * way[2]) / FINE * (end - t)
        if min(abs(depth), abs(left)) > 1.0 and (depth > 0.0) == (left > 0.0):
            known = bool(depth < 0.0)
        if known is not None:
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
    kind = ir.FunctionType(long, [double.as_pointer(), word.as_pointer(), single.as_pointer(), *[long] * 7])
    function = ir.Function(module, kind, "stride")
    builder = ir.IRBuilder(function.append_basic_block())
    builder.ret(emit_stride(builder, *function.args[:3], function.args[3:]))
    engine = engine_of(module)
    call = ctypes.CFUNCTYPE(ctypes.c_int64, *[ctypes.c_void_p] * 3, *[ctypes.c_int64] * 7)(
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
        for lane in range(at.ABREAST):
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
