"""One stride of several segments at once through what the voxels settle by themselves.

A stride is what `hhsr.kernels.walk` does where a leap, a brick's plane, a voxel or its plane proves the state that the
segment is in up to where it leaves: the same formulas in the same order, so the same t to the last bit. In vectors,
because a walk waits: each read sends it to the next, and nothing predicts its branches. Every lane, under way or not,
reads a voxel of the grid, whatever is made of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from numba import types
from numba.extending import intrinsic

from hhsr.kernels.lane import (
    ABREAST,
    BACK,
    BEGIN,
    DEPTH,
    EXIT,
    INVERSE,
    NUDGED,
    OCTANT,
    SHIFT,
    SIGN,
    SLOPE,
    STATE,
    STOP,
    SURFEL,
    T,
    U,
    V,
)
from hhsr.kernels.surfel import FINE
from hhsr.kernels.vectors import INT, SHORT, Vector, fetch_ahead, gather, gather_rows, load, store
from hhsr.kernels.voxels import BRICK_SIZE, FARTHEST_STEP, IN_BIT, NO_SURFEL, SHORT_BITS, STEP_BITS


def _linear(normal: Sequence[Vector], place: Sequence[Vector]) -> Vector:
    return normal[0] * place[0] + normal[1] * place[1] + normal[2] * place[2]


def _plane(first: Vector, second: Vector) -> list[Vector]:
    """Return the four numbers of planes, from their two words."""
    return [half.doubles() for half in (*first.halves(), *second.halves())]


def emit_stride(builder: Any, lanes: Any, words: Any, tab: Any, grid: Sequence[Any]) -> Any:
    """Emit a stride; return a bit for each lane that took it."""

    def row(number: int) -> Vector:
        return load(builder, lanes, number * ABREAST, ABREAST)

    nx, ny, nz, bricks, voxels, planes, details = (
        Vector.of(builder, builder.trunc(number, INT), ABREAST) for number in grid
    )
    t, stop, state = row(T), row(STOP), row(STATE)
    way = [row(V + k) for k in range(3)]
    place = [row(U + k) + t * way[k] for k in range(3)]
    last = [((n << 2) - 1).doubles() for n in (nx, ny, nz)]
    voxel = [place[k].most(0.0).least(last[k]).integers() for k in range(3)]
    brick = ((voxel[0] >> 2) * ny + (voxel[1] >> 2)) * nz + (voxel[2] >> 2)
    # A leap of bricks; else the brick's own plane; else the voxel's number; else its plane.
    one, other, first, base = gather_rows(builder, words, bricks + (brick * BRICK_SIZE), BRICK_SIZE)
    octant = row(OCTANT).integers()
    leap = ((octant > 3).where(other, one) >> ((octant & 3) << 3)) & 255
    leaps, leaps_in = first < 0, leap < 128
    *normal, offset = _plane(one, other)
    level = (_linear(normal, [place[k] - ((voxel[k] | 3) - 1).doubles() for k in range(3)]) + offset) * (1.0 / FINE)
    slope = _linear(normal, way) * (1.0 / FINE)
    plain = ~leaps & (abs(level) > 1.0)
    near = t + (abs(level) - 1.0) / abs(slope)
    far = ((level > 0.0) ^ (slope > 0.0)).where(near, float("inf"))
    inner = ((voxel[0] & 3) << 4) | ((voxel[1] & 3) << 2) | (voxel[2] & 3)
    shorts = builder.bitcast(words, SHORT.as_pointer())
    held = gather(builder, shorts, voxels + first.most(0) + inner).wide()
    step = (held >> (((held >> octant) & 1) * STEP_BITS + SHORT_BITS)) & FARTHEST_STEP
    proven, held_in = ~leaps & (held < 0), (held & IN_BIT) > 0
    surfel = ~leaps & ~plain & (held > -1) & (held < NO_SURFEL)
    # Where no surfel is asked the first one stands for it: what is not needed is not fetched from afar.
    number = surfel.where(base + held, 0)
    reach = leaps.where(leaps_in.where(leap, (leap ^ 255) + 1), proven.where(step, 0) + 1)
    far_out, end = reach.doubles(), stop
    for k in (2, 1, 0):
        forth, back, once, shift = row(SIGN + k), row(BACK + k), row(INVERSE + k), row(SHIFT + k)
        border = leaps.where(voxel[k] >> 2, voxel[k]).doubles() + forth * far_out + back
        met = leaps.where(border * 4.0, border) * once + shift
        end = met.least(end)
        far = ((((voxel[k] >> 2).doubles() + forth + back) * 4.0) * once + shift).least(far)
    end = plain.where(proven.where(end.most(far), far).least(stop), end)
    *normal, offset = _plane(*gather_rows(builder, words, planes + (number << 1), 2))
    depth = (_linear(normal, [place[k] - voxel[k].doubles() - 0.5 for k in range(3)]) + offset) * (1.0 / FINE)
    slope = _linear(normal, way) * (1.0 / FINE)
    left = depth + slope * (end - t)
    above, below = (depth > 1.0) & (left > 1.0), (depth < -1.0) & (left < -1.0)
    # What the plane leaves open is looked at next: `hhsr.kernels.walk.cross_voxel`.
    left_open = surfel & ~(above | below) & (t < stop)
    fetch_ahead(builder, tab, details + (left_open.where(number, 0) << 2))
    store(builder, left_open.where(number.doubles(), -1.0), lanes, SURFEL * ABREAST)
    for number_of, value in ((DEPTH, depth), (SLOPE, slope), (EXIT, end)):
        store(builder, value, lanes, number_of * ABREAST)
    settled = leaps | plain | proven | (surfel & (above | below))
    inside = leaps.where(leaps_in, plain.where(level < 0.0, proven.where(held_in, below)))
    # What the start's voxel proves is the state to begin with.
    begins, known = state < 0.0, inside.doubles()
    taken = settled & (begins | known.is_(state)) & (t < stop)
    store(builder, taken.where(end.most(t) + row(NUDGED), t), lanes, T * ABREAST)
    store(builder, taken.where(known, state), lanes, STATE * ABREAST)
    store(builder, (taken & begins).where(known, row(BEGIN)), lanes, BEGIN * ABREAST)
    return taken.bits()


@intrinsic
def stride(
    typing: Any, lanes: Any, words: Any, tab: Any, nx: Any, ny: Any, nz: Any, bricks: Any, voxels: Any, planes: Any,
    details: Any,
) -> Any:  # fmt: skip
    """Take a stride in each lane (`hhsr.kernels.lane`) that has one, and return their bits.

    words, tab: the blob as 32-bit integers, and its float32 tables; then what the grid's record says.
    """
    signature = types.int64(lanes, words, tab, nx, ny, nz, bricks, voxels, planes, details)

    def emit(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        lanes, words, tab = (
            context.make_array(kind)(context, builder, value).data
            for kind, value in zip(signature.args[:3], arguments[:3], strict=True)
        )
        return emit_stride(builder, lanes, words, tab, arguments[3:])

    return signature, emit
