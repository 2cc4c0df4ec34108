"""The scale field and its change along a line: for one point, or for eight of one block side by side, to the same bits.

Σ w λ(h) over a block's centres, one after the other, with the same roundings in both. λ's exponential is that of
`hhsr.kernels.sphere_rbf`.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import config, types
from numba.extending import intrinsic

from hhsr.kernels.sphere_rbf import POWERS, gaussian_jet
from hhsr.kernels.unmanaged import unmanaged
from hhsr.kernels.vectors import DOUBLE, INT, LANES, LONG, Vector, fused, load, store

# Rows of LANES numbers each, of points side by side: unit directions, what they change by along a way (tangent), and
# then s and its change.
UNIT, TANGENT, FIELD, CHANGE, ALONG_ROWS = 0, 3, 6, 7, 8
_P0, _P1, _P2, _P3, _P4, _P5, _P6, _P7, _P8, _P9, _P10, _P11 = POWERS
_MIDDLE = math.exp(-2.0)


def _terms(builder: Any, unit: Any, way: Any, centre: Sequence[Vector]) -> tuple[Vector, Vector, Vector, Vector]:
    """Return (e, rest, f, g) of centres (x, y, z, 1/(1 − cos σ), weight): e·rest adds to s, f·g to its change."""
    cx, cy, cz, inverse, weight = centre
    tau = fused(unit[2], cz, fused(unit[1], cy, unit[0] * cx))
    one = Vector.of(builder, ir.Constant(DOUBLE, 1.0))
    h = ((one - tau) * inverse).least(1.0)
    t = fused(h, 2.0, -1.0)
    t2 = t * t
    t4 = t2 * t2
    low = fused(fused(t, _P3, _P2), t2, fused(t, _P1, _P0))
    low = fused(fused(fused(t, _P7, _P6), t2, fused(t, _P5, _P4)), t4, low)
    root = fused(fused(fused(t, _P11, _P10), t2, fused(t, _P9, _P8)), t4 * t4, low)
    quarter = root * root
    rest = one - h
    e = weight * (quarter * quarter * _MIDDLE) * rest
    return e, rest, e * inverse * fused(rest, 4.0, 2.0), fused(way[2], cz, fused(way[1], cy, way[0] * cx))


def _summed(builder: Any, count: Any, step: int, nothing: Any, add: Callable[[Any, list[Any]], list[Any]]) -> list[Any]:
    """Emit a loop over 0, step, … < count; return two sums, from `nothing` on, as add(number, sums) grows them."""
    before, body, after = builder.block, *(builder.append_basic_block(name) for name in ("centres", "summed"))
    zero = ir.Constant(LONG, 0)
    builder.cbranch(builder.icmp_signed(">", count, zero), body, after)
    builder.position_at_end(body)
    number, sums = builder.phi(LONG), [builder.phi(nothing.type) for _ in range(2)]
    grown = add(number, sums)
    following = builder.add(number, ir.Constant(LONG, step))
    for phi, start, value in zip([number, *sums], [zero, nothing, nothing], [following, *grown], strict=True):
        phi.add_incoming(start, before)
        phi.add_incoming(value, body)
    builder.cbranch(builder.icmp_signed("<", following, count), body, after)
    builder.position_at_end(after)
    totals = [builder.phi(nothing.type) for _ in range(2)]
    for total, value in zip(totals, grown, strict=True):
        total.add_incoming(nothing, before)
        total.add_incoming(value, body)
    return totals


def _columns(builder: Any, blob: Any, first: Any, count: Any, number: Any) -> list[Any]:
    """Return where the five numbers of a block's centre lie."""
    places = [builder.add(first, number)]
    for _ in range(4):
        places.append(builder.add(places[-1], count))
    return [builder.gep(blob, [place]) for place in places]


def emit_field(builder: Any, blob: Any, first: Any, count: Any, unit: Sequence[Any], way: Sequence[Any]) -> list[Any]:
    """Emit (s, ds) of one direction, LANES centres at a time, whose terms are added one after the other."""
    unit, way = ([Vector.of(builder, number) for number in numbers] for numbers in (unit, way))

    def add(number: Any, sums: list[Any]) -> list[Any]:
        columns = _columns(builder, blob, first, count, number)
        e, rest, f, g = _terms(builder, unit, way, [load(builder, column, 0) for column in columns])
        for k in range(LANES):
            one, other, third, fourth = (builder.extract_element(v.value, ir.Constant(INT, k)) for v in (e, rest, f, g))
            sums = [builder.fma(one, other, sums[0]), builder.fma(third, fourth, sums[1])]
        return sums

    return _summed(builder, count, LANES, ir.Constant(DOUBLE, 0.0), add)


def emit_fields(builder: Any, rows: Any, blob: Any, first: Any, count: Any, terms: Any) -> None:
    """Emit (s, ds) of LANES directions at once, from rows into rows, by the first `terms` of the centres."""
    given = [load(builder, rows, (UNIT + k) * LANES) for k in range(6)]

    def add(number: Any, sums: list[Any]) -> list[Any]:
        columns = _columns(builder, blob, first, count, number)
        centre = [Vector.of(builder, builder.load(column)) for column in columns]
        e, rest, f, g = _terms(builder, given[:3], given[3:], centre)
        s, ds = (Vector(builder, total) for total in sums)
        return [fused(e, rest, s).value, fused(f, g, ds).value]

    nothing = Vector.of(builder, ir.Constant(DOUBLE, 0.0)).value
    for row, total in zip((FIELD, CHANGE), _summed(builder, terms, 1, nothing, add), strict=True):
        store(builder, Vector(builder, total), rows, row * LANES)


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


if config.DISABLE_JIT:  # type: ignore[attr-defined]

    def field_along(blob: Any, first: int, count: int, unit: Any, way: Any) -> tuple[float, float]:
        """Return (s, ds): as compiled, but for the last bits."""
        columns = blob[first : first + 5 * count].reshape(5, count)
        s, fx, fy, fz = gaussian_jet(*columns, *unit)
        return s, fx * way[0] + fy * way[1] + fz * way[2]

    def fields_along(rows: Any, blob: Any, first: int, count: int, terms: int) -> None:
        """Fill rows FIELD and CHANGE: as compiled, but for the last bits."""
        for lane in range(LANES):
            unit, way = rows[UNIT : UNIT + 3, lane], rows[TANGENT : TANGENT + 3, lane]
            rows[FIELD, lane], rows[CHANGE, lane] = field_along(blob, first, count, unit, way)

else:

    @unmanaged
    def field_along(blob, first, count, unit, way):
        """Return (s, ds) of a unit direction (3,): the scale field and its change along a tangent, way (3,).

        first: float slot of the block's centres, count: how many, a multiple of LANES.
        """
        return _field_along(blob, np.int64(first), np.int64(count), unit, way)

    @intrinsic
    def fields_along(typing: Any, rows: Any, blob: Any, first: Any, count: Any, terms: Any) -> Any:
        """Fill rows FIELD and CHANGE of points side by side (ALONG_ROWS, LANES), over the centres of one block.

        first: their float slot, count: how many; terms: how many from the first on, for those behind have no weight.
        """
        signature = types.void(rows, blob, first, count, terms)

        def emit(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
            rows, blob = (
                context.make_array(kind)(context, builder, value).data
                for kind, value in zip(signature.args[:2], arguments[:2], strict=True)
            )
            emit_fields(builder, rows, blob, *arguments[2:])
            return context.get_dummy_value()

        return signature, emit
