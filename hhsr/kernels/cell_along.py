"""Smooth runs settled by the table alone, LANES side by side: by the quadratic of the cell in which the guess lies.

On a face p = m·(1, a, b) and F = m·W(a, b). With u = m·(a − c_a), v = m·(b − c_b) about a cell's middle, linear in
space, a quadratic W makes m·(F − 1) = g0 + g1·δ + g2·δ² along a line: its root costs no formula. By how much W strays
from the quadratic is in the table, so also how far the crossing can lie from that root. A run alone is asked in all
lanes, so that it gets the same bits.

The formulas are written once, for lanes of either kind: vectors of code that is emitted, or arrays.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numba import config, types
from numba.extending import intrinsic

from hhsr.kernels.lane import MERGE
from hhsr.kernels.layout import (
    BEND_AA,
    BEND_AB,
    BEND_BB,
    BEND_SIZE,
    BEND_TABLE,
    BLOCK_DATA,
    BLOCK_ROWS,
    BLOCKS,
    BLOCKS_PER_SIDE,
    CELL_SIZE,
    CELL_TABLE,
    CELLS,
    HALF_AXES,
    KINK,
    LANES,
    PARTING,
    SLOPE_A,
    SLOPE_B,
    THIRD,
    VALUE,
)
from hhsr.kernels.runs import (
    AFTER,
    BEFORE,
    BEND_ALONG,
    CODE,
    GUESS,
    LEAF,
    LEAST,
    LEAVES,
    MONOTONE,
    OWN,
    RISES,
    RUN_BEGIN,
    RUN_BEND,
    RUN_END,
    RUN_FROM,
    RUN_GAP,
    RUN_SIZE,
    RUN_TO,
    TURNED,
)
from hhsr.kernels.table_lanes import CountedTables, EmittedTables
from hhsr.kernels.vectors import Vector, load, store

# Rows of LANES numbers each: of the run its number; then what is known of it (below), the code, guess, least |dF/dt|
# (or count of halvings) and bend along the line that it has from now on; F − 1 in the middle of one leaf's run, and how
# far it can stray. What a value at the guess is asked with: dF/dt and how far it can stray, the direction, N, the float
# slot and the number of the centres of its block; and a row in which one run has these side by side.
RUN, KNOWN, NEW_CODE, AT, STEEP, BENDS, EXCESS, EXCESS_STRAY, RISE, RISE_STRAY, UNIT, NORM, FIRST, COUNT, GIVEN = (
    0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 13, 14, 15, 16
)  # fmt: skip
CELL_ROWS = 17
# It may cross, and AT is its middle; is proven monotone, and crosses near AT; crosses at AT; nowhere; is monotone, but
# AT lies over another cell, which is to be asked.
ASKED, ONCE, SURE, NOWHERE, AGAIN = 0, 1, 2, 3, 4
AGAINS = 2  # cells that are asked for one run
ROUNDED = 1e-7  # more than what float32 takes from a number
INSIDE = 1.0 + 1e-9  # of half a cell's side: models are proven a little beyond it


class Line(NamedTuple):
    """A line in the chart of a cell: u, v, m at its guess, what they change by, and what the cell tells."""

    place: Sequence[Any]
    way: Sequence[Any]
    kink: Any
    third: Any
    steep: Any  # what float32 takes from the slopes


def _strays(on: Any, line: Line, step: Any) -> tuple[Any, Any, Any, Any]:
    """Return (1/m, how far F and dF/dt stray from the quadratic, the greater of |a|, |b|) a step from the guess."""
    (u, v, m), (du, dv, dm) = line.place, line.way
    m = on.fused(step, dm, m)
    once = on.one / m
    a, b = on.fused(step, du, u) * once, on.fused(step, dv, v) * once
    away = on.root(on.fused(a, a, b * b))
    rest = line.third * away
    value = m * away * on.fused(away, on.fused(rest, 1.0 / 6.0, line.kink * 0.5), line.steep) + 4.0 * ROUNDED
    turn = abs(du - a * dm) + abs(dv - b * dm)
    slope = abs(dm) * once * value + turn * on.fused(away, on.fused(rest, 0.5, line.kink), line.steep)
    return once, value, slope, on.most(abs(a), abs(b))


def _share_across(on: Any, place: Sequence[Any], way: Sequence[Any], reach: Any) -> Any:
    """Return a bound of what is left of the bend in space along a line by its direction, within `reach` of a place.

    As in `_bend_along` d²F/dt² = cᵀ·∂²W·c/m³, and the bend in space is no less than
    |∂²W|·(p/m)²/m·d² at any point of the line: c²/(p²·d²) of it is left. c is p × d but for its part along the axis of
    the face, where the face does not change on the way.
    """
    (x, y, z), (dx, dy, dz) = place, way
    px, py, pz = y * dz - z * dy, z * dx - x * dz, x * dy - y * dx
    length2, way2 = x * x + y * y + z * z, dx * dx + dy * dy + dz * dz
    nearest2 = length2 - reach * abs(x * dx + y * dy + z * dz) * 2.0
    across2 = px * px + py * py + pz * pz
    low = [abs(p) - reach * abs(d) for p, d in zip(place, way, strict=True)]
    high = [abs(p) + reach * abs(d) for p, d in zip(place, way, strict=True)]
    part = on.where(low[2] > on.most(high[0], high[1]), pz * pz, 0.0)
    part = on.where(low[1] > on.most(high[0], high[2]), py * py, part)
    part = on.where(low[0] > on.most(high[1], high[2]), px * px, part)
    share = (across2 - part) / (nearest2 * way2) * (1.0 + 1e-6) + 1e-12
    return on.where((nearest2 > length2 * 0.5) & (share < 1.0), share, 1.0)


def settled(on: Any, number: Any, tolerance: Any) -> list[Any]:
    """Return rows KNOWN … COUNT of some runs that are in their leaf's frame, by their numbers. tolerance: mm."""
    record = on.record(on.longs(number) * RUN_SIZE)
    code = on.longs(record[CODE])
    own, before, after = on.equal(code & 7, OWN), (code & BEFORE) > 0, (code & AFTER) > 0
    valid = (own | on.equal(code & 7, MONOTONE)) & (record[RUN_BEND] < np.inf)
    begin, end = record[RUN_BEGIN], record[RUN_END]
    t = on.where(own, (begin + end) * 0.5, on.least(on.most(record[GUESS], begin), end))
    way = record[RUN_TO : RUN_TO + 3]
    place = [record[RUN_FROM + k] + t * way[k] for k in range(3)]
    reach = on.most(t - begin, end - t)
    bend = on.least(record[RUN_BEND] * _share_across(on, place, way, reach), record[BEND_ALONG])

    # The face: minor axes a and b, major one m. Then the cell, whose middle u and v are counted from.
    x, y, z = (abs(number) for number in place)
    first, second = (x >= y) & (x >= z), y >= z

    def turned(numbers: Sequence[Any]) -> list[Any]:
        pairs = [(numbers[(k + 1) % 3], on.where(second, numbers[(k + 2) % 3], numbers[k])) for k in range(3)]
        return [on.where(first, one, other) for one, other in pairs]

    (u, v, m), (du, dv, dm) = turned(place), turned(way)
    back = m < 0.0
    m, dm = abs(m), on.where(back, dm * -1.0, dm)
    face = on.where(first, on.number(0.0), on.where(second, on.number(2.0), 4.0)) + on.where(back, on.number(1.0), 0.0)
    leaf = on.leaf(on.where(valid, on.longs(record[LEAF]) & (LEAVES - 1), 0))
    once = on.one / m
    cell, half, ca, cb, block = _cell(on, valid, leaf, face, u * once, v * once)
    forth = on.where(back, on.number(-1.0), 1.0)
    begun = turned([record[RUN_FROM + k] + begin * way[k] for k in range(3)])
    ended = turned([record[RUN_FROM + k] + end * way[k] for k in range(3)])
    along = _bend_along(on, valid, leaf, face, forth, begun, ended, end - begin)
    bend = on.least(along, bend)
    u, v, du, dv = u - m * ca, v - m * cb, du - dm * ca, dv - dm * cb

    line, (g0, g1, g2) = _quadratic(on, cell, half, (u, v, m), (du, dv, dm))

    # In the middle of one leaf's run: it is clear, or monotone, or neither is proven.
    once, excess_stray, rise_stray, beyond = _strays(on, line, on.number(0.0))
    over = beyond <= half * INSIDE
    excess_stray, rise_stray = on.where(over, excess_stray, np.inf), on.where(over, rise_stray, np.inf)
    excess = g0 * once
    rise = (g1 - excess * dm) * once
    least = abs(rise) - rise_stray - bend * reach
    kept = ~(before ^ (excess < 0.0)) & (
        abs(excess) > (abs(rise) + rise_stray + bend * reach * 0.5) * reach + excess_stray
    )
    clear = own & ~(before ^ after) & ((least > 0.0) | kept)
    turns = (before ^ after) & (least > 0.0) & ~(before ^ (rise > 0.0))
    crosses = valid & (turns | ~own)
    steep = on.where(own & turns, least, record[LEAST])
    rises = on.where(before, on.number(MONOTONE - OWN + RISES), MONOTONE - OWN)

    # A monotone one crosses where the quadratic does, but for what that strays there.
    step = g0 / g1 * -1.0
    step = step - g2 * step * step / on.fused(g2 * step, 2.0, g1)
    at = on.least(on.most(t + step, begin), end)
    step = at - t
    once, stray, turn, beyond = _strays(on, line, step)
    f = on.fused(on.fused(g2, step, g1), step, g0) * once
    slope = (on.fused(g2 * step, 2.0, g1) - f * dm) * once
    turn = on.where(beyond <= half * INSIDE, turn, np.inf)
    least = on.most(abs(slope) - turn - bend * (end - begin), steep)
    sure = (turn < np.inf) & (abs(f) + stray <= least * tolerance * record[RUN_GAP] * (1.0 / MERGE))
    number = on.number
    again = on.equal(turn, np.inf) & (record[CODE] < AGAINS * TURNED)
    crossed = on.where(sure, number(SURE), on.where(again, number(AGAIN), ONCE))
    known = on.where(crosses, crossed, on.where(valid & clear, number(NOWHERE), ASKED))
    code = record[CODE] + on.where(own & turns, rises, 0.0) + on.where(crosses & again, number(TURNED), 0.0)
    at, steep = on.where(crosses, at, t), on.where(crosses, least, steep)
    rise, rise_stray = on.where(crosses, slope, rise), on.where(crosses, turn, rise_stray)
    place = [on.fused(step, d, p) for d, p in zip(way, place, strict=True)]
    value = _value(on, valid, leaf, block, place)
    return [known, code, at, steep, bend, excess, excess_stray, rise, rise_stray, *value]


def _value(on: Any, valid: Any, leaf: Sequence[Any], block: Any, place: Sequence[Any]) -> list[Any]:
    """Return rows UNIT … COUNT at a place: N as `hhsr.kernels.along.excess_of` has it."""
    once = on.one / on.root(on.fused(place[0], place[0], on.fused(place[1], place[1], place[2] * place[2])))
    axes = on.axes(on.where(valid, leaf[HALF_AXES], 0))
    parts = [p / on.where(p > 0.0, axes[2 * k], axes[2 * k + 1]) for k, p in enumerate(place)]
    norm = on.root(on.fused(parts[0], parts[0], on.fused(parts[1], parts[1], parts[2] * parts[2])))
    start, stop = on.pair(on.where(valid, leaf[BLOCKS] + block, 0))
    count = on.doubles(on.longs((on.doubles(stop - start) + 0.5) * (1.0 / BLOCK_ROWS)))
    return [*(p * once for p in place), norm, on.doubles(leaf[BLOCK_DATA] + start), count]


def _quadratic(
    on: Any, cell: Sequence[Any], half: Any, place: Sequence[Any], way: Sequence[Any]
) -> tuple[Line, tuple[Any, Any, Any]]:
    """Return a line (u, v, m) in a cell's chart, and g0, g1, g2 along it."""
    (u, v, m), (du, dv, dm) = place, way
    wa, wb, aa, ab, bb = (cell[k] for k in (SLOPE_A, SLOPE_B, BEND_AA, BEND_AB, BEND_BB))
    w = cell[VALUE] - half * half * (aa + bb) * 0.25
    line = Line(place, way, cell[KINK], cell[THIRD], (abs(wa) + abs(wb)) * (2.0 * ROUNDED))
    slope, rise = on.fused(wa, u, wb * v), on.fused(wa, du, wb * dv)
    ru, rv = on.fused(aa, u, ab * v), on.fused(ab, u, bb * v)
    su, sv = on.fused(aa, du, ab * dv), on.fused(ab, du, bb * dv)
    g0 = on.fused(on.fused(w, m, slope - 1.0), m, on.fused(ru, u, rv * v) * 0.5)
    g1 = on.fused(on.fused(w * 2.0, m, slope - 1.0), dm, on.fused(rise, m, on.fused(ru, du, rv * dv)))
    g2 = on.fused(on.fused(w, dm, rise), dm, on.fused(su, du, sv * dv) * 0.5)
    return line, (g0, g1, g2)


def _bend_along(
    on: Any,
    valid: Any,
    leaf: Sequence[Any],
    face: Any,
    forth: Any,
    begun: Sequence[Any],
    ended: Sequence[Any],
    way: Any,
) -> Any:
    """Return a bound of |d²F/dt²| between two ends (along minor and major axes), `way` of t apart; infinite: unknown.

    On a face p = m·(1, a, b) and F = m·W(a, b). Along the line (a, b) moves by c/m², with a c that stays, so
    d²F/dt² = cᵀ·∂²W·c/m³. ∂²W is bounded over the base cells between those of the two ends, four at most.
    """
    m0, m1 = begun[2] * forth, ended[2] * forth
    once0, once1 = on.one / m0, on.one / m1
    a0, b0, a1, b1 = begun[0] * once0, begun[1] * once0, ended[0] * once1, ended[1] * once1
    least, most = (on.least(a0, a1), on.least(b0, b1)), (on.most(a0, a1), on.most(b0, b1))
    ok = valid & (m0 > 0.0) & (m1 > 0.0) & (on.least(*least) >= -1.0) & (on.most(*most) <= 1.0)
    n = on.doubles(leaf[CELLS])

    def index(x: Any) -> Any:
        return on.longs(on.least(on.most((x + 1.0) * 0.5 * n, 0.0), n - 1.0))

    (i0, j0), (i1, j1) = (index(x) for x in least), (index(x) for x in most)
    ok = ok & ((i1 - i0) < 2) & ((j1 - j0) < 2)
    bend = on.number(0.0)
    for i in (i0, i1):
        for j in (j0, j1):
            place = leaf[BEND_TABLE] + ((on.longs(face) * leaf[CELLS] + i) * leaf[CELLS] + j) * BEND_SIZE
            low, high = on.bends(on.where(ok, place, 0))
            bend = on.most(bend, on.most(low * -1.0, high))
    once, m = m0 * m1 / way, on.least(m0, m1)
    ca, cb = (a1 - a0) * once, (b1 - b0) * once
    return on.where(ok, bend * (ca * ca + cb * cb) / (m * m * m) * (1.0 + 1e-6), np.inf)


def _cell(on: Any, valid: Any, leaf: Sequence[Any], face: Any, a: Any, b: Any) -> tuple[list[Any], Any, Any, Any, Any]:
    """Return a cell's numbers, half its side, its middle, its block; `hhsr.kernels.maps.cell_at` in lanes."""
    n = on.doubles(leaf[CELLS])

    def split(x: Any, side: Any) -> tuple[Any, Any]:
        """Return the whole part of x, one of `side`, and what is left."""
        whole = on.doubles(on.longs(on.least(on.most(x, 0.0), side - 1.0)))
        return whole, x - whole

    i, u = split((a + 1.0) * 0.5 * n, n)
    j, v = split((b + 1.0) * 0.5 * n, n)
    word = on.word(on.where(valid, leaf[PARTING] + on.longs((face * n + i) * n + j), 0))
    s = on.doubles(on.power(word & 7))
    p, _ = split(u * s, s)
    q, _ = split(v * s, s)
    half = on.one / (n * s)
    cell = on.cell(on.where(valid, leaf[CELL_TABLE] + ((word >> 4) + on.longs(p * s + q)) * CELL_SIZE, 0))
    blocks = on.one / n * BLOCKS_PER_SIDE
    block = (on.longs(face) * BLOCKS_PER_SIDE + on.longs(i * blocks)) * BLOCKS_PER_SIDE + on.longs(j * blocks)
    return cell, half, ((i * s + p) * 2.0 + 1.0) * half - 1.0, ((j * s + q) * 2.0 + 1.0) * half - 1.0, block


def emit_settled(
    builder: Any, lanes: int, rows: Any, runs: Any, blob: Any, ints: Any, tab: Any, tolerance: Any
) -> None:
    """Emit rows KNOWN … COUNT of the runs whose numbers are in row RUN, in the first lanes."""
    on = EmittedTables(builder, lanes, runs, blob, ints, tab)
    numbers = load(builder, rows, RUN * LANES, lanes)
    for k, row in enumerate(settled(on, numbers, Vector.of(builder, tolerance, lanes))):
        store(builder, row, rows, (KNOWN + k) * LANES)


if config.DISABLE_JIT:  # type: ignore[attr-defined]

    def settle_by_cells(rows: Any, runs: Any, blob: Any, ints: Any, tab: Any, tolerance: float) -> None:
        """Fill rows KNOWN … COUNT: as compiled, but for the last bits."""
        with np.errstate(all="ignore"):
            rows[KNOWN:GIVEN] = settled(CountedTables(runs, blob, ints, tab), rows[RUN], tolerance)

    def settle_by_cell(rows: Any, runs: Any, blob: Any, ints: Any, tab: Any, tolerance: float) -> None:
        """Do so for the first lane."""
        rows[RUN] = rows[RUN, 0]
        settle_by_cells(rows, runs, blob, ints, tab, tolerance)

else:

    def _emitter(signature: Any, lanes: int) -> Any:
        def emit(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
            rows, runs, blob, ints, tab = (
                context.make_array(kind)(context, builder, value).data
                for kind, value in zip(signature.args[:5], arguments[:5], strict=True)
            )
            emit_settled(builder, lanes, rows, runs, blob, ints, tab, arguments[5])
            return context.get_dummy_value()

        return signature, emit

    @intrinsic
    def settle_by_cells(typing: Any, rows: Any, runs: Any, blob: Any, ints: Any, tab: Any, tolerance: Any) -> Any:
        """Fill rows KNOWN … COUNT (CELL_ROWS, LANES) of the runs whose numbers are in row RUN. tolerance: mm."""
        return _emitter(types.void(rows, runs, blob, ints, tab, tolerance), LANES)

    @intrinsic
    def settle_by_cell(typing: Any, rows: Any, runs: Any, blob: Any, ints: Any, tab: Any, tolerance: Any) -> Any:
        """Do so for the first lane: to the same bits, but much less code, which a single call finds far away."""
        return _emitter(types.void(rows, runs, blob, ints, tab, tolerance), 1)
