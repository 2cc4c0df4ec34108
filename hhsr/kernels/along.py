"""A leaf's F − 1 and its change along a line: at one point, or at eight of one block side by side, to the same bits.

The scale field is Σ w λ(h) over a block's centres, in one order, with the same roundings in both. λ's
exponential is that of `hhsr.kernels.sphere_rbf`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import config, types
from numba.extending import intrinsic

from hhsr.kernels.cell import axis_scale
from hhsr.kernels.sphere_rbf import POWERS, gaussian_jet
from hhsr.kernels.unmanaged import inlined, unmanaged
from hhsr.kernels.vectors import DOUBLE, INT, LANES, LONG, Vector, fused, load, root, store

# Rows of LANES numbers each, of points side by side: places (leaf's frame), ways, and then F − 1 and its change.
PLACE, WAY, EXCESS, RISE, ALONG_ROWS = 0, 3, 6, 7, 8
SUMS = 4  # the k-th centre's terms go to sum k mod SUMS: no addition waits long for the one before
# The fourth power of their polynomial in 2h − 1 is λ's exponential: that at h = 1/2 is in them.
_P0, _P1, _P2, _P3, _P4, _P5, _P6, _P7, _P8, _P9, _P10, _P11 = (power * math.exp(-0.5) for power in POWERS)


def _terms(builder: Any, unit: Any, way: Any, centre: Sequence[Vector]) -> tuple[Vector, Vector, Vector, Vector]:
    """Return (e, rest, f, g) of centres (x, y, z, 1/(1 − cos σ), weight): e·rest adds to s, f·g to its change."""
    cx, cy, cz, inverse, weight = centre
    tau = fused(unit[2], cz, fused(unit[1], cy, unit[0] * cx))
    one = Vector.of(builder, ir.Constant(DOUBLE, 1.0))
    rest = fused(tau, inverse, one - inverse).most(0.0)  # 1 − h
    t = fused(rest, -2.0, 1.0)
    t2 = t * t
    t4 = t2 * t2
    low = fused(fused(t, _P3, _P2), t2, fused(t, _P1, _P0))
    low = fused(fused(fused(t, _P7, _P6), t2, fused(t, _P5, _P4)), t4, low)
    fourth = fused(fused(fused(t, _P11, _P10), t2, fused(t, _P9, _P8)), t4 * t4, low)
    half = fourth * fourth
    e = weight * (half * half) * rest
    return e, rest, e * inverse * fused(rest, 4.0, 2.0), fused(way[2], cz, fused(way[1], cy, way[0] * cx))


def _summed(
    builder: Any, count: Any, step: int, nothing: list[Any], add: Callable[[Any, list[Any]], list[Any]]
) -> list[Any]:
    """Emit a loop over 0, step, … < count; return sums, from `nothing` on, as add(number, sums) grows them."""
    before, body, after = builder.block, *(builder.append_basic_block(name) for name in ("centres", "summed"))
    zero = ir.Constant(LONG, 0)
    builder.cbranch(builder.icmp_signed(">", count, zero), body, after)
    builder.position_at_end(body)
    number, sums = builder.phi(LONG), [builder.phi(begin.type) for begin in nothing]
    grown = add(number, sums)
    following = builder.add(number, ir.Constant(LONG, step))
    for phi, start, value in zip([number, *sums], [zero, *nothing], [following, *grown], strict=True):
        phi.add_incoming(start, before)
        phi.add_incoming(value, body)
    builder.cbranch(builder.icmp_signed("<", following, count), body, after)
    builder.position_at_end(after)
    totals = [builder.phi(begin.type) for begin in nothing]
    for total, begin, value in zip(totals, nothing, grown, strict=True):
        total.add_incoming(begin, before)
        total.add_incoming(value, body)
    return totals


def _columns(builder: Any, blob: Any, first: Any, count: Any, number: Any) -> list[Any]:
    """Return where the five numbers of a block's centre lie."""
    places = [builder.add(first, number)]
    for _ in range(4):
        places.append(builder.add(places[-1], count))
    return [builder.gep(blob, [place]) for place in places]


def emit_field(builder: Any, blob: Any, first: Any, count: Any, unit: Sequence[Any], way: Sequence[Any]) -> list[Any]:
    """Emit (s, ds) of one direction, LANES centres at a time, its terms added to SUMS sums, one after the other."""
    unit, way = ([Vector.of(builder, number) for number in numbers] for numbers in (unit, way))

    def add(number: Any, sums: list[Any]) -> list[Any]:
        columns = _columns(builder, blob, first, count, number)
        terms = _terms(builder, unit, way, [load(builder, column, 0) for column in columns])
        s, ds = (Vector(builder, total) for total in sums)
        for k in range(0, LANES, SUMS):
            e, rest, f, g = (term.some(k, SUMS) for term in terms)
            s, ds = fused(e, rest, s), fused(f, g, ds)
        return [s.value, ds.value]

    nothing = Vector.of(builder, ir.Constant(DOUBLE, 0.0), SUMS).value
    return [
        _total([builder.extract_element(total, ir.Constant(INT, k)) for k in range(SUMS)], builder.fadd)
        for total in _summed(builder, count, LANES, [nothing, nothing], add)
    ]


def emit_fields(
    builder: Any, blob: Any, first: Any, count: Any, terms: Any, unit: Sequence[Vector], way: Sequence[Vector]
) -> list[Vector]:
    """Emit (s, ds) of LANES directions at once, by the first `terms` of the centres and less than SUMS more."""

    def add(number: Any, sums: list[Any]) -> list[Any]:
        grown = [Vector(builder, total) for total in sums]
        for k in range(SUMS):
            columns = _columns(builder, blob, first, count, builder.add(number, ir.Constant(LONG, k)))
            centre = [Vector.of(builder, builder.load(column)) for column in columns]
            e, rest, f, g = _terms(builder, unit, way, centre)
            grown[k], grown[SUMS + k] = fused(e, rest, grown[k]), fused(f, g, grown[SUMS + k])
        return [total.value for total in grown]

    nothing = Vector.of(builder, ir.Constant(DOUBLE, 0.0)).value
    totals = [Vector(builder, total) for total in _summed(builder, terms, SUMS, [nothing] * (2 * SUMS), add)]
    return [_total(some, lambda one, other: one + other) for some in (totals[:SUMS], totals[SUMS:])]


def _total(sums: list[Any], plus: Callable[[Any, Any], Any]) -> Any:
    return plus(plus(sums[0], sums[1]), plus(sums[2], sums[3]))


def emit_excess(builder: Any, rows: Any, blob: Any, half_axes: Any, first: Any, count: Any, terms: Any) -> None:
    """Emit F − 1 and its change of LANES points at once, from rows into rows: `ray_along`, `excess_of`, in vectors."""
    numbers = [load(builder, rows, (PLACE + k) * LANES) for k in range(6)]
    (x, y, z), (dx, dy, dz) = numbers[:3], numbers[3:]
    one = Vector.of(builder, ir.Constant(DOUBLE, 1.0))
    inverse = one / root(x * x + y * y + z * z)
    unit = [x * inverse, y * inverse, z * inverse]
    radial = dx * unit[0] + dy * unit[1] + dz * unit[2]
    tangent = [(d - radial * u) * inverse for d, u in zip((dx, dy, dz), unit, strict=True)]
    s, ds = emit_fields(builder, blob, first, count, terms, unit, tangent)
    scaled = []
    for axis, place in enumerate((x, y, z)):
        sides = []
        for side in range(2):
            at = builder.add(half_axes, ir.Constant(LONG, 2 * axis + side))
            size = Vector.of(builder, builder.load(builder.gep(blob, [at])))
            sides.append(one / (size * size))
        scaled.append((place > 0.0).where(sides[0], sides[1]) * place)
    norm = root(scaled[0] * x + scaled[1] * y + scaled[2] * z)
    d = one / (one - s)
    f = norm * d
    store(builder, f - 1.0, rows, EXCESS * LANES)
    rise = (scaled[0] * dx + scaled[1] * dy + scaled[2] * dz) / norm + f * ds
    store(builder, rise * d, rows, RISE * LANES)


@intrinsic
def _field_along(typing: Any, blob: Any, first: Any, count: Any, unit: Any, way: Any) -> Any:
    three = types.UniTuple(types.float64, 3)
    signature = types.UniTuple(types.float64, 2)(blob, first, count, three, three)

    def emit(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        blob = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        unit, way = ([builder.extract_value(value, k) for k in range(3)] for value in arguments[3:])
        return context.make_tuple(
            builder, signature.return_type, emit_field(builder, blob, arguments[1], arguments[2], unit, way)
        )

    return signature, emit


@inlined
def ray_along(x, y, z, dx, dy, dz):
    """Return the unit direction (3,) of a point and what it changes by along d (3,)."""
    inverse = 1.0 / math.sqrt(x * x + y * y + z * z)
    ux, uy, uz = x * inverse, y * inverse, z * inverse
    radial = dx * ux + dy * uy + dz * uz
    return (ux, uy, uz), ((dx - radial * ux) * inverse, (dy - radial * uy) * inverse, (dz - radial * uz) * inverse)


@inlined
def excess_of(blob, half_axes, x, y, z, dx, dy, dz, s, ds):
    """Return (F − 1, ∂F/∂d) at a point where the scale field is s, and changes by ds along d."""
    cx, cy, cz = axis_scale(blob, half_axes, 0, x), axis_scale(blob, half_axes, 2, y), axis_scale(blob, half_axes, 4, z)
    norm = math.sqrt(cx * x * x + cy * y * y + cz * z * z)
    d = 1.0 / (1.0 - s)
    f = norm * d
    return f - 1.0, ((cx * x * dx + cy * y * dy + cz * z * dz) / norm + f * ds) * d


if config.DISABLE_JIT:  # type: ignore[attr-defined]

    def field_along(blob: Any, first: int, count: int, unit: Any, way: Any) -> tuple[float, float]:
        """Return (s, ds): as compiled, but for the last bits."""
        columns = blob[first : first + 5 * count].reshape(5, count)
        s, fx, fy, fz = gaussian_jet(*columns, *unit)
        return s, fx * way[0] + fy * way[1] + fz * way[2]

    def excess_together(rows: Any, blob: Any, half_axes: int, first: int, count: int, terms: int) -> None:
        """Fill rows EXCESS and RISE: as compiled, but for the last bits."""
        for lane in range(LANES):
            (x, y, z), (dx, dy, dz) = rows[PLACE : PLACE + 3, lane], rows[WAY : WAY + 3, lane]
            s, ds = field_along(blob, first, count, *ray_along(x, y, z, dx, dy, dz))
            rows[EXCESS, lane], rows[RISE, lane] = excess_of(blob, half_axes, x, y, z, dx, dy, dz, s, ds)

else:

    @unmanaged
    def field_along(blob, first, count, unit, way):
        """Return (s, ds) of a unit direction (3,): the scale field and its change along a tangent, way (3,).

        first: float slot of the block's centres, count: how many, a multiple of LANES.
        """
        return _field_along(blob, np.int64(first), np.int64(count), unit, way)

    @intrinsic
    def excess_together(typing: Any, rows: Any, blob: Any, half_axes: Any, first: Any, count: Any, terms: Any) -> Any:
        """Fill rows EXCESS and RISE of points side by side (ALONG_ROWS, LANES), whose directions lie in one block.

        half_axes: their float slot. first: that of the block's centres, count: how many; terms: how many from the first
        on, for those behind have no weight.
        """
        signature = types.void(rows, blob, half_axes, first, count, terms)

        def emit(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
            rows, blob = (
                context.make_array(kind)(context, builder, value).data
                for kind, value in zip(signature.args[:2], arguments[:2], strict=True)
            )
            emit_excess(builder, rows, blob, *arguments[2:])
            return context.get_dummy_value()

        return signature, emit
