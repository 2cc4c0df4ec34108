"""The scale field of a block's centres at a direction, and how it changes: LANES centres side by side.

s = Σ w λ(h), λ = e^(−4h) (1 − h)² with h = (1 − τ)/(1 − cos σ), τ = u·c (DESIGN §1); then ∂(wλ)/∂τ =
w e^(−4h) (1 − h)(6 − 4h)/(1 − cos σ). Right to 1e-13·Σ|w|: what rounding leaves of 1 − τ. Rows of zeros, by which a
block is filled up, add nothing.

The formulas are written once, for lanes of either kind: vectors of code that is emitted, or arrays. A compiler that is
left to find the lanes takes half as many at once, and asks on each call whether rows overlap: twice the time.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
from llvmlite import ir
from numba import config, types
from numba.extending import intrinsic

from hhsr.kernels.either_lanes import Counted, Emitted
from hhsr.kernels.unmanaged import unmanaged
from hhsr.kernels.vectors import DOUBLE, LANES, LONG, Vector, load, totals

# e^(−t/2) on [−1, 1]: Chebyshev interpolation of degree 11 (error 2.4e-16) in powers of t, from 40 digits. No call of
# the C library stands in the loop then. With t = 2h − 1 its fourth power, times e^(−2), is λ's exponential: a fourth
# root of that is in the numbers used.
POWERS = (
    0.9999999999999998,
    -0.49999999999999994,
    0.12500000000001799,
    -0.02083333333333508,
    0.002604166666456743,
    -0.0002604166666526762,
    2.170138978433107e-05,
    -1.550099254304914e-06,
    9.687947422138764e-08,
    -5.382209016747527e-09,
    2.70647493210243e-10,
    -1.229633898293371e-11,
)
_P0, _P1, _P2, _P3, _P4, _P5, _P6, _P7, _P8, _P9, _P10, _P11 = (power * math.exp(-0.5) for power in POWERS)

Terms = list[tuple[Any, Any]]  # of each sum: two factors


def _share(on: Any, tau: Any, inverse: Any, weight: Any) -> tuple[Any, Any, Any]:
    """Return (w e^(−4h), 1 − h but at least 0, whether that is more) of centres."""
    rest = on.fused(tau, inverse, on.one - inverse)
    within, rest = rest > 0.0, on.most(rest, 0.0)
    t = on.fused(rest, -2.0, 1.0)
    t2 = t * t
    t4 = t2 * t2
    low = on.fused(on.fused(t, _P3, _P2), t2, on.fused(t, _P1, _P0))
    low = on.fused(on.fused(on.fused(t, _P7, _P6), t2, on.fused(t, _P5, _P4)), t4, low)
    fourth = on.fused(on.fused(on.fused(t, _P11, _P10), t2, on.fused(t, _P9, _P8)), t4 * t4, low)
    half = fourth * fourth
    return weight * (half * half), rest, within


def _dot(on: Any, one: Sequence[Any], other: Sequence[Any]) -> Any:
    return on.fused(one[2], other[2], on.fused(one[1], other[1], one[0] * other[0]))


def value_terms(on: Any, unit: Sequence[Any], centre: Sequence[Any]) -> Terms:
    """Return the terms of s. unit: a direction; centre: rows of the directions, 1/(1 − cos σ), w."""
    e, rest, _ = _share(on, _dot(on, unit, centre), *centre[3:])
    return [(e * rest, rest)]


def along_terms(on: Any, unit: Sequence[Any], centre: Sequence[Any]) -> Terms:
    """Return the terms of s and of what it changes by. unit: a direction, then what that changes by (six numbers)."""
    e, rest, _ = _share(on, _dot(on, unit, centre), *centre[3:])
    e *= rest
    return [(e, rest), (e * centre[3] * on.fused(rest, 4.0, 2.0), _dot(on, unit[3:], centre))]


def slope_terms(on: Any, unit: Sequence[Any], centre: Sequence[Any]) -> Terms:
    """Return the terms of s, s_a/q, s_b/q in a face's chart, of the unit direction u = q·(±1, a, b).

    τ_a = q (c_a − τ u_a).
    """
    tau = _dot(on, unit, centre)
    e, rest, _ = _share(on, tau, *centre[3:])
    e *= rest
    back, turned = tau * -1.0, e * centre[3] * on.fused(rest, 4.0, 2.0)
    return [(e, rest), *((turned, on.fused(back, unit[k], centre[k])) for k in (1, 2))]


def bend_terms(on: Any, unit: Sequence[Any], centre: Sequence[Any]) -> Terms:
    """Return the terms of those and of Σ ∂s/∂τ τ, Σ ∂²s/∂τ² τ_a²/q², …τ_a τ_b/q², …τ_b²/q²."""
    tau, inverse = _dot(on, unit, centre), centre[3]
    e, rest, within = _share(on, tau, *centre[3:])
    back, turned = tau * -1.0, e * rest * inverse * on.fused(rest, 4.0, 2.0)
    ta, tb = (on.fused(back, unit[k], centre[k]) for k in (1, 2))
    # Beyond the border (h = 1) λ is 0, with all its derivatives.
    bent = on.where(within, e, 0.0) * (inverse * inverse) * on.fused(on.fused(rest, 16.0, 16.0), rest, 2.0)
    bent_a = bent * ta
    return [
        (e * rest, rest), (turned, ta), (turned, tb), (turned, tau), (bent_a, ta), (bent_a, tb), (bent * tb, tb)
    ]  # fmt: skip


def emit_sums(
    builder: Any,
    terms: Callable[[Any, Sequence[Any], Sequence[Any]], Terms],
    sums: int,
    blob: Any,
    rows: Sequence[Any],
    count: Any,
    unit: Sequence[Any],
) -> list[Any]:
    """Emit so many sums of a direction over `count` centres, whose rows begin at these slots; LANES at a time."""
    on = Emitted(builder, LANES)
    unit, nothing = [Vector.of(builder, number) for number in unit], on.number(0.0).value
    before, body, after = builder.block, *(builder.append_basic_block(name) for name in ("centres", "summed"))
    zero = ir.Constant(LONG, 0)
    builder.cbranch(builder.icmp_signed(">", count, zero), body, after)
    builder.position_at_end(body)
    number, totalled = builder.phi(LONG), [builder.phi(nothing.type) for _ in range(sums)]
    centre = [load(builder, builder.gep(blob, [builder.add(row, number)]), 0) for row in rows]
    grown = [
        on.fused(one, other, Vector(builder, total)).value
        for (one, other), total in zip(terms(on, unit, centre), totalled, strict=True)
    ]
    following = builder.add(number, ir.Constant(LONG, LANES))
    for phi, start, value in zip([number, *totalled], [zero] + [nothing] * sums, [following, *grown], strict=True):
        phi.add_incoming(start, before)
        phi.add_incoming(value, body)
    builder.cbranch(builder.icmp_signed("<", following, count), body, after)
    builder.position_at_end(after)
    ended = [builder.phi(nothing.type) for _ in grown]
    for phi, value in zip(ended, grown, strict=True):
        phi.add_incoming(nothing, before)
        phi.add_incoming(value, body)
    return totals([Vector(builder, phi) for phi in ended])


def sums_function(module: Any, terms: Any, sums: int, size: int) -> Any:
    """Return a function of (blob, five rows, count, `size` numbers of a direction) in a module, which gives the sums.

    Not emitted where it is asked for: with it in each place the code takes twice as long to compile, and is no faster.
    """
    name = f"hhsr.{terms.__name__}"
    if name in module.globals:
        return module.globals[name]
    result = ir.LiteralStructType([DOUBLE] * sums)
    kind = ir.FunctionType(result, [DOUBLE.as_pointer()] + [LONG] * 6 + [DOUBLE] * size)
    function = ir.Function(module, kind, name)
    function.linkage = "linkonce_odr"
    for attribute in ("noinline", "nounwind"):
        function.attributes.add(attribute)
    builder = ir.IRBuilder(function.append_basic_block())
    blob, count = function.args[0], function.args[6]
    given = emit_sums(builder, terms, sums, blob, function.args[1:6], count, function.args[7:])
    answer = ir.Constant(result, ir.Undefined)
    for k, number in enumerate(given):
        answer = builder.insert_value(answer, number, k)
    builder.ret(answer)
    return function


def _summed(terms: Callable[[Any, Sequence[Any], Sequence[Any]], Terms], sums: int) -> Any:
    """Return a function of (blob, rows, count, unit) that gives so many sums; without JIT, but for the last bits."""
    if config.DISABLE_JIT:  # type: ignore[attr-defined]

        def counted(blob: Any, rows: Sequence[int], count: int, unit: Sequence[float]) -> tuple[float, ...]:
            centre = [blob[row : row + count] for row in rows]
            return tuple(float((one * other).sum()) for one, other in terms(Counted(), unit, centre))

        return counted

    @intrinsic
    def emitted(typing: Any, blob: Any, rows: Any, count: Any, unit: Any) -> Any:
        def emit(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
            blob = context.make_array(signature.args[0])(context, builder, arguments[0]).data
            rows, unit = (
                [builder.extract_value(arguments[k], i) for i in range(signature.args[k].count)] for k in (1, 3)
            )
            function = sums_function(builder.module, terms, sums, len(unit))
            given = builder.call(function, [blob, *rows, arguments[2], *unit])
            numbers = [builder.extract_value(given, k) for k in range(sums)]
            return context.make_tuple(builder, signature.return_type, numbers)

        return types.UniTuple(types.float64, sums)(blob, rows, count, unit), emit

    return emitted


_value, _along, _slopes, _bend = (
    _summed(terms, sums) for terms, sums in ((value_terms, 1), (along_terms, 2), (slope_terms, 3), (bend_terms, 7))
)


@unmanaged
def _rows(first, count, axis):
    """Return where the rows of a block begin, those of the directions from an axis on."""
    first, count = np.int64(first), np.int64(count)
    return (
        first + count * axis, first + count * ((axis + 1) % 3), first + count * ((axis + 2) % 3), first + 3 * count,
        first + 4 * count,
    )  # fmt: skip


@unmanaged
def field_at(blob, first, count, unit):
    """Return s of a unit direction (3,). first: float slot of the block's centres, count: how many, with those of 0."""
    return _value(blob, _rows(first, count, np.int64(0)), np.int64(count), unit)[0]


@unmanaged
def field_along(blob, first, count, unit, way):
    """Return (s, ds): the scale field and its change along a tangent, way (3,)."""
    both = (unit[0], unit[1], unit[2], way[0], way[1], way[2])
    return _along(blob, _rows(first, count, np.int64(0)), np.int64(count), both)


@unmanaged
def field_slopes(blob, first, count, axis, um, ua, ub, q):
    """Return (s, s_a, s_b) in a face's chart, of the unit direction u = q·(±1, a, b), whose parts are um, ua, ub.

    axis: 0 to 2, the major one of the face.
    """
    s, sa, sb = _slopes(blob, _rows(first, count, np.int64(axis)), np.int64(count), (um, ua, ub))
    return s, q * sa, q * sb


@unmanaged
def field_bend(blob, first, count, axis, um, ua, ub, q):
    """Return (s, s_a, s_b, s_aa, s_ab, s_bb).

    τ_aa = −q (2 τ_a u_a + τ q (1 − u_a²)), τ_ab = −q (τ_b u_a + τ_a u_b − τ q u_a u_b).
    """
    s, sa, sb, along, aa, ab, bb = _bend(blob, _rows(first, count, np.int64(axis)), np.int64(count), (um, ua, ub))
    q2 = q * q
    aa = q2 * (aa - 2.0 * sa * ua - along * (1.0 - ua * ua))
    bb = q2 * (bb - 2.0 * sb * ub - along * (1.0 - ub * ub))
    ab = q2 * (ab - sb * ua - sa * ub + along * ua * ub)
    return s, q * sa, q * sb, aa, ab, bb
