"""Bounds of the sixteen discs of a block at once, against a point or a segment: a row of a block is one vector.

In float32 throughout: `loose` (mm) is more than that rounds at the coordinates at hand. A compiler that is left to find
the vectors asks on each call whether the rows overlap what is written, and makes the mask of sixteen 64-bit numbers:
that takes longer than the bounds.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numba import config, types
from numba.extending import intrinsic

from hhsr.kernels.unmanaged import inlined
from hhsr.kernels.vectors import FLOAT, Vector, fused, load, root, store

DISC_SIZE = 8
WIDE = 16
BLOCK = WIDE * DISC_SIZE
LOOSE = 2e-6
MOST = 1e38  # a squared distance that float32 still holds
SHORT, LONG = 1.0 - 1e-6, 1.0 + 1e-6
TINY, BLUR = 1e-30, 4e-6  # mm²; what float32 leaves of a squared cosine, and more


def _dot(one: Sequence[Vector], other: Sequence[Vector]) -> Vector:
    return fused(one[2], other[2], fused(one[1], other[1], one[0] * other[0]))


def _rows(builder: Any, block: Any) -> tuple[list[Vector], list[Vector], Vector, Vector]:
    """Return centres, normals, how thick and how wide."""
    rows = [load(builder, block, WIDE * row, WIDE) for row in range(DISC_SIZE)]
    return rows[:3], rows[3:6], rows[6], rows[7]


def emit_to_point(builder: Any, block: Any, point: Sequence[Any], loose: Any, limit: Any, bounds: Any) -> Any:
    """Emit lower bounds of the squared distances of a point; return a bit for each that is no more than `limit`."""
    centre, normal, thick, wide = _rows(builder, block)
    e = Vector.of(builder, loose, WIDE)
    away = [Vector.of(builder, x, WIDE) - c for x, c in zip(point, centre, strict=True)]
    h = abs(_dot(away, normal))
    along = (h * SHORT - (thick + e)).most(0.0)
    h *= LONG
    aside = root((_dot(away, away) - h * h).most(0.0)) * SHORT
    aside = (aside - (wide + e)).most(0.0)
    least = fused(along, along, aside * aside) * SHORT
    store(builder, least, bounds, 0)
    return (least <= Vector.of(builder, limit, WIDE)).bits()


def emit_to_segment(
    builder: Any,
    block: Any,
    point: Sequence[Any],
    vector: Sequence[Any],
    over: Any,
    loose: Any,
    limit: Any,
    bounds: Any,
) -> Any:
    """Do as `emit_to_point` for p + t·d: by the slab about a disc's plane, and by the plane across the shortest way.

    The shortest way from the disc's centre to the segment has a direction u in which no point of the segment lies
    farther back; the disc reaches RADIUS·√(1 − (n·u)²) + THICK that way. Roundings turn u by less than loose/length.
    over: 1/d².
    """
    centre, normal, thick, wide = _rows(builder, block)
    e = Vector.of(builder, loose, WIDE)
    away = [Vector.of(builder, x, WIDE) - c for x, c in zip(point, centre, strict=True)]
    way = [Vector.of(builder, x, WIDE) for x in vector]
    thick, wide = thick + e, wide + e
    h = _dot(away, normal)
    g = h + _dot(way, normal)
    # Both ends on one side: the nearer one's height; else the segment meets the plane.
    slab = (h.least(g)).most(h.most(g) * -1.0) * SHORT - thick
    # A t off the nearest point's by rounding: its distance hardly grows.
    t = (_dot(away, way) * -1.0 * Vector.of(builder, over, WIDE)).most(0.0).least(1.0)
    away = [fused(t, v, r) for v, r in zip(way, away, strict=True)]
    length2 = _dot(away, away).most(TINY)
    length = root(length2)
    h = _dot(away, normal)
    # √((1 − h²/length²) + blur)·radius + e·radius/length, all of it times length: one division less.
    aside = root((length2 - h * h).most(0.0) + length2 * BLUR) + e
    low = (length * SHORT - wide * aside / length - thick).most(slab).most(0.0)
    least = low * low * SHORT
    store(builder, least, bounds, 0)
    return (least <= Vector.of(builder, limit, WIDE)).bits()


@intrinsic
def _to_point(typing: Any, blocks: Any, i: Any, x: Any, y: Any, z: Any, loose: Any, limit: Any, bounds: Any) -> Any:
    def emit(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        block, bounds = _places(context, builder, signature, arguments)
        x, y, z, loose, limit = (builder.fptrunc(number, FLOAT) for number in arguments[2:7])
        return emit_to_point(builder, block, (x, y, z), loose, limit, bounds)

    number = types.float64
    return types.int64(blocks, types.int64, number, number, number, number, number, bounds), emit


@intrinsic
def _to_segment(
    typing: Any, blocks: Any, i: Any, x: Any, y: Any, z: Any, dx: Any, dy: Any, dz: Any, over: Any, loose: Any,
    limit: Any, bounds: Any,
) -> Any:  # fmt: skip
    def emit(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> Any:
        block, bounds = _places(context, builder, signature, arguments)
        x, y, z, dx, dy, dz, over, loose, limit = (builder.fptrunc(number, FLOAT) for number in arguments[2:11])
        return emit_to_segment(builder, block, (x, y, z), (dx, dy, dz), over, loose, limit, bounds)

    number = types.float64
    return types.int64(blocks, types.int64, *[number] * 9, bounds), emit


def _places(context: Any, builder: Any, signature: Any, arguments: Sequence[Any]) -> tuple[Any, Any]:
    """Return where the block and the bounds lie: of the first, the second and the last argument."""
    blocks = context.make_array(signature.args[0])(context, builder, arguments[0]).data
    block = builder.gep(blocks, [builder.mul(arguments[1], arguments[1].type(BLOCK))])
    return block, context.make_array(signature.args[-1])(context, builder, arguments[-1]).data


if config.DISABLE_JIT:  # type: ignore[attr-defined]
    # Roundings aside, as compiled.

    def bound_to_point(blocks: Any, i: int, x: Any, y: Any, z: Any, loose: float, most: float, bounds: Any) -> int:
        """Fill bounds (16,) and return their mask, as compiled."""
        cx, cy, cz, nx, ny, nz, thick, wide = np.float64(blocks[BLOCK * i : BLOCK * i + BLOCK]).reshape(DISC_SIZE, WIDE)
        rx, ry, rz = x - cx, y - cy, z - cz
        h = abs(rx * nx + ry * ny + rz * nz)
        along = np.maximum(h * SHORT - (thick + loose), 0.0)
        aside = np.sqrt(np.maximum(rx * rx + ry * ry + rz * rz - (h * LONG) ** 2, 0.0)) * SHORT
        aside = np.maximum(aside - (wide + loose), 0.0)
        return _mask((along * along + aside * aside) * SHORT, most, bounds)

    def bound_to_segment(
        blocks: Any, i: int, x: Any, y: Any, z: Any, dx: Any, dy: Any, dz: Any, loose: float, most: float, bounds: Any
    ) -> int:
        """Do as `bound_to_point` for p + t·d, of a length."""
        cx, cy, cz, nx, ny, nz, thick, wide = np.float64(blocks[BLOCK * i : BLOCK * i + BLOCK]).reshape(DISC_SIZE, WIDE)
        rx, ry, rz = x - cx, y - cy, z - cz
        h = rx * nx + ry * ny + rz * nz
        g = h + (dx * nx + dy * ny + dz * nz)
        slab = np.maximum(np.minimum(h, g), -np.maximum(h, g)) * SHORT - thick - loose
        t = np.clip(-(rx * dx + ry * dy + rz * dz) / (dx * dx + dy * dy + dz * dz), 0.0, 1.0)
        rx, ry, rz = rx + t * dx, ry + t * dy, rz + t * dz
        length2 = np.maximum(rx * rx + ry * ry + rz * rz, TINY)
        length, h = np.sqrt(length2), rx * nx + ry * ny + rz * nz
        aside = np.sqrt(np.maximum(length2 - h * h, 0.0) + length2 * BLUR) + loose
        low = np.maximum(length * SHORT - (wide + loose) * aside / length - thick - loose, np.maximum(slab, 0.0))
        return _mask(low * low * SHORT, most, bounds)

    def _mask(least: Any, most: float, bounds: Any) -> int:
        bounds[:WIDE] = least
        return sum(1 << c for c in range(WIDE) if bounds[c] <= min(most, MOST) * LONG)

else:

    @inlined
    def bound_to_point(blocks, i, x, y, z, loose, most, bounds):
        """Fill bounds (16,) float32 with lower bounds of the squared distances of a point to the discs of a block.

        Returns a mask: bit c is set where bound c is no more than `most`. blocks: float32, from block 0 on.
        """
        return _to_point(blocks, i, x, y, z, loose, min(most, MOST) * LONG, bounds)

    @inlined
    def bound_to_segment(blocks, i, x, y, z, dx, dy, dz, loose, most, bounds):
        """Do as `bound_to_point` for p + t·d, of a length."""
        over = 1.0 / (dx * dx + dy * dy + dz * dz)
        return _to_segment(blocks, i, x, y, z, dx, dy, dz, over, loose, min(most, MOST) * LONG, bounds)
