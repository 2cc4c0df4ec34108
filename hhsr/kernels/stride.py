"""One stride of several segments at once through what the voxels settle by themselves.

A stride is what `hhsr.kernels.walk` does where a leap, a brick's plane, a byte or a voxel's plane proves the state that
the segment is in up to where it leaves: the same formulas in the same order, so the same t to the last bit. In vectors,
because a walk waits: each read sends it to the next, and nothing predicts its branches. Every lane, under way or not,
reads a voxel of the grid, whatever is made of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numba import types
from numba.extending import intrinsic

from hhsr.kernels.lane import (
    BACK,
    BEGIN,
    DEPTH,
    EXIT,
    INVERSE,
    LEAP_TABLE,
    NUDGED,
    SHIFT,
    SIGN,
    SLOPE,
    STATE,
    STEP_TABLE,
    STOP,
    SURFEL,
    T,
    U,
    V,
)
from hhsr.kernels.vectors import INT, LANES, Vector, fetch_ahead, gather, gather_four, load, power_of_two, store
from hhsr.kernels.voxels import FARTHEST_STEP, NO_SURFEL, OUT_BYTE, STEP_BITS, STEP_WORDS


def _byte(builder: Any, words: Any, index: Vector) -> Vector:
    """Return the byte at each lane's index (of bytes) of a table of 32-bit words."""
    return (gather(builder, words, index >> 2) >> ((index & 3) << 3)) & 255


def _linear(normal: Sequence[Vector], place: Sequence[Vector]) -> Vector:
    return normal[0] * place[0] + normal[1] * place[1] + normal[2] * place[2]


def emit_stride(builder: Any, lanes: Any, words: Any, tab: Any, grid: Sequence[Any]) -> Any:
    """Emit a stride; return a bit for each lane that took it."""

    def row(number: int) -> Vector:
        return load(builder, lanes, number * LANES)

    nx, ny, nz, bricks, bases, octets, brick_planes, planes, details = (
        Vector.of(builder, builder.trunc(number, INT)) for number in grid
    )
    t, stop, state = row(T), row(STOP), row(STATE)
    way = [row(V + k) for k in range(3)]
    place = [row(U + k) + t * way[k] for k in range(3)]
    last = [((n << 2) - 1).doubles() for n in (nx, ny, nz)]
    voxel = [place[k].most(0.0).least(last[k]).integers() for k in range(3)]
    brick = ((voxel[0] >> 2) * ny + (voxel[1] >> 2)) * nz + (voxel[2] >> 2)
    # A leap of bricks; else the brick's own plane; else the voxel's byte; else its plane.
    leap = _byte(builder, words, row(LEAP_TABLE).integers() + brick)
    leaps, leaps_in = leap > 0, leap < 128
    slot = gather(builder, words, bricks + brick).most(0)
    *normal, offset = gather_four(builder, tab, brick_planes + (slot << 2))
    level = _linear(normal, [place[k] - ((voxel[k] | 3) - 1).doubles() for k in range(3)]) + offset
    slope = _linear(normal, way)
    plain = ~leaps & (abs(level) > 1.0)
    near = t + (abs(level) - 1.0) / abs(slope)
    far = ((level > 0.0) ^ (slope > 0.0)).where(near, float("inf"))
    inner = ((voxel[0] & 3) << 4) | ((voxel[1] & 3) << 2) | (voxel[2] & 3)
    byte = _byte(builder, words, octets + (slot << 6) + inner)
    step = gather(builder, words, row(STEP_TABLE).integers() + (slot * STEP_WORDS) + (inner >> 4))
    step = (step >> ((inner & 15) * STEP_BITS)) & FARTHEST_STEP
    proven, byte_in = ~leaps & (byte > NO_SURFEL), byte < OUT_BYTE
    surfel = ~leaps & ~plain & (byte < NO_SURFEL)
    # Where no surfel is asked the first one stands for it: what is not needed is not fetched from afar.
    number = surfel.where(gather(builder, words, bases + slot) + byte, 0)
    reach = leaps.where(leaps_in.where(leap, (leap ^ 255) + 1), power_of_two(proven.where(step, 0)))
    far_out, end = reach.doubles(), stop
    for k in (2, 1, 0):
        forth, back, once, shift = row(SIGN + k), row(BACK + k), row(INVERSE + k), row(SHIFT + k)
        border = leaps.where(voxel[k] >> 2, voxel[k]).doubles() + forth * far_out + back
        met = leaps.where(border * 4.0, border) * once + shift
        end = met.least(end)
        far = ((((voxel[k] >> 2).doubles() + forth + back) * 4.0) * once + shift).least(far)
    end = plain.where(proven.where(end.most(far), far).least(stop), end)
    *normal, offset = gather_four(builder, tab, planes + (number << 2))
    depth = _linear(normal, [place[k] - voxel[k].doubles() - 0.5 for k in range(3)]) + offset
    slope = _linear(normal, way)
    left = depth + slope * (end - t)
    above, below = (depth > 1.0) & (left > 1.0), (depth < -1.0) & (left < -1.0)
    # What the plane leaves open is looked at next: `hhsr.kernels.walk.cross_voxel`. NaN: a cut passes.
    left_open = surfel & ~(above | below) & (t < stop)
    fetch_ahead(builder, tab, left_open.where(details, planes) + (number << 2))
    store(builder, (left_open & depth.is_(depth)).where(number.doubles(), -1.0), lanes, SURFEL * LANES)
    for number_of, value in ((DEPTH, depth), (SLOPE, slope), (EXIT, end)):
        store(builder, value, lanes, number_of * LANES)
    settled = leaps | plain | proven | (surfel & (above | below))
    inside = leaps.where(leaps_in, plain.where(level < 0.0, proven.where(byte_in, below)))
    # What the start's voxel proves is the state to begin with.
    begins, held = state < 0.0, inside.doubles()
    taken = settled & (begins | held.is_(state)) & (t < stop)
    store(builder, taken.where(end.most(t) + row(NUDGED), t), lanes, T * LANES)
    store(builder, taken.where(held, state), lanes, STATE * LANES)
    store(builder, (taken & begins).where(held, row(BEGIN)), lanes, BEGIN * LANES)
    return taken.bits()


@intrinsic
def stride(
    typing: Any, lanes: Any, words: Any, tab: Any, nx: Any, ny: Any, nz: Any, bricks: Any, bases: Any,
    octets: Any, brick_planes: Any, planes: Any, details: Any,
) -> Any:  # fmt: skip
    """Take a stride in each lane (`hhsr.kernels.lane`) that has one, and return their bits.

    words, tab: the blob as 32-bit integers, and its float32 tables; then what the grid's record says.
    """
    signature = types.int64(lanes, words, tab, nx, ny, nz, bricks, bases, octets, brick_planes, planes, details)

    def emit(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        lanes, words, tab = (
            context.make_array(kind)(context, builder, value).data
            for kind, value in zip(signature.args[:3], arguments[:3], strict=True)
        )
        return emit_stride(builder, lanes, words, tab, arguments[3:])

    return signature, emit
