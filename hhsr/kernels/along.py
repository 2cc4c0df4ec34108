"""A leaf's F − 1 at a point, and its change along a line.

The scale field is Σ w λ(h) over a block's centres, LANES at a time. λ's exponential is that of
`hhsr.kernels.sphere_rbf`.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import config, types
from numba.extending import intrinsic

from hhsr.kernels.cell import axis_scale
from hhsr.kernels.sphere_rbf import POWERS, gaussian_jet
from hhsr.kernels.unmanaged import inlined, unmanaged
from hhsr.kernels.vectors import DOUBLE, INT, LANES, LONG, Vector, fused, load

# The fourth power of their polynomial in 2h − 1 is λ's exponential: that at h = 1/2 is in them.
_P0, _P1, _P2, _P3, _P4, _P5, _P6, _P7, _P8, _P9, _P10, _P11 = (power * math.exp(-0.5) for power in POWERS)


def _terms(builder: Any, unit: Sequence[Vector], centre: Sequence[Vector]) -> tuple[Vector, Vector]:
    """Return (w e^(−4h) (1 − h), 1 − h) of centres (x, y, z, 1/(1 − cos σ), weight)."""
    cx, cy, cz, inverse, weight = centre
    tau = fused(unit[2], cz, fused(unit[1], cy, unit[0] * cx))
    one = Vector.of(builder, ir.Constant(DOUBLE, 1.0))
    rest = fused(tau, inverse, one - inverse).most(0.0)
    t = fused(rest, -2.0, 1.0)
    t2 = t * t
    t4 = t2 * t2
    low = fused(fused(t, _P3, _P2), t2, fused(t, _P1, _P0))
    low = fused(fused(fused(t, _P7, _P6), t2, fused(t, _P5, _P4)), t4, low)
    fourth = fused(fused(fused(t, _P11, _P10), t2, fused(t, _P9, _P8)), t4 * t4, low)
    half = fourth * fourth
    return weight * (half * half) * rest, rest


def emit_field(builder: Any, blob: Any, first: Any, count: Any, unit: Sequence[Any], way: Sequence[Any]) -> list[Any]:
    """Emit s of a direction, and ds along a way, where that has three parts, not none; LANES centres at a time."""
    unit, way = ([Vector.of(builder, number) for number in numbers] for numbers in (unit, way))
    before, body, after = builder.block, *(builder.append_basic_block(name) for name in ("centres", "summed"))
    zero, nothing = ir.Constant(LONG, 0), Vector.of(builder, ir.Constant(DOUBLE, 0.0)).value
    builder.cbranch(builder.icmp_signed(">", count, zero), body, after)
    builder.position_at_end(body)
    number, s, ds = builder.phi(LONG), builder.phi(nothing.type), builder.phi(nothing.type)
    places = [builder.add(first, number)]
    for _ in range(4):
        places.append(builder.add(places[-1], count))
    centre = [load(builder, builder.gep(blob, [place]), 0) for place in places]
    e, rest = _terms(builder, unit, centre)
    grown = [fused(e, rest, Vector(builder, s)).value, ds]
    if way:
        along = fused(way[2], centre[2], fused(way[1], centre[1], way[0] * centre[0]))
        grown[1] = fused(e * centre[3] * fused(rest, 4.0, 2.0), along, Vector(builder, ds)).value
    following = builder.add(number, ir.Constant(LONG, LANES))
    for phi, start, value in zip([number, s, ds], [zero, nothing, nothing], [following, *grown], strict=True):
        phi.add_incoming(start, before)
        phi.add_incoming(value, body)
    builder.cbranch(builder.icmp_signed("<", following, count), body, after)
    builder.position_at_end(after)
    sums = [builder.phi(nothing.type) for _ in grown]
    for total, value in zip(sums, grown, strict=True):
        total.add_incoming(nothing, before)
        total.add_incoming(value, body)
    return [_total(builder, Vector(builder, total)) for total in (sums if way else sums[:1])]


def _total(builder: Any, numbers: Vector) -> Any:
    """Return the sum of all lanes."""
    while numbers.lanes > 2:
        half = numbers.lanes // 2
        numbers = numbers.some(0, half) + numbers.some(half, half)
    one, other = (builder.extract_element(numbers.value, ir.Constant(INT, k)) for k in range(2))
    return builder.fadd(one, other)


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


@intrinsic
def _field_at(typing: Any, blob: Any, first: Any, count: Any, unit: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        blob = context.make_array(signature.args[0])(context, builder, arguments[0]).data
        unit = [builder.extract_value(arguments[3], k) for k in range(3)]
        return emit_field(builder, blob, arguments[1], arguments[2], unit, ())[0]

    return types.float64(blob, first, count, types.UniTuple(types.float64, 3)), emit


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

    def field_at(blob: Any, first: int, count: int, unit: Any) -> float:
        """Return s: as compiled, but for the last bits."""
        return field_along(blob, first, count, unit, unit)[0]

else:

    @unmanaged
    def field_along(blob, first, count, unit, way):
        """Return (s, ds) of a unit direction (3,): the scale field and its change along a tangent, way (3,).

        first: float slot of the block's centres, count: how many, a multiple of LANES.
        """
        return _field_along(blob, np.int64(first), np.int64(count), unit, way)

    @unmanaged
    def field_at(blob, first, count, unit):
        """Return s alone."""
        return _field_at(blob, np.int64(first), np.int64(count), unit)
