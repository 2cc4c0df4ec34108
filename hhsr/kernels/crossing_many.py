"""All crossings of many segments, or the first: some at a time, each in a lane, by the same walk as one alone.

Most of a walk waits for what it reads. So all lanes take their strides together (`hhsr.kernels.stride`), until some
have none; those go on alone to where they have again, and one that is at its end makes room for the next segment.
"""

import math

import numpy as np
from numba import config, njit

from hhsr.kernels.crossing import scratch
from hhsr.kernels.lane import BEGIN, COUNT, GAP, LEFT_AT, SEGMENT, STATE, STOP, T, set_out
from hhsr.kernels.layout import VOXELS, integers, tables
from hhsr.kernels.segment import PIECES
from hhsr.kernels.stride import stride
from hhsr.kernels.tree import into_tree
from hhsr.kernels.unmanaged import inlined, unmanaged
from hhsr.kernels.vectors import LANES, bits_set
from hhsr.kernels.voxels import BASES, BRICK_PLANES, BRICKS, BYTES, DETAILS, PLANES, solid_contains
from hhsr.kernels.walk import cross_voxel, go_on

WAITING = 3  # so many lanes are without a stride when the others wait for them
ROOM = 64  # crossings of one segment
# Instead of a count: a segment that is not finite; one that has no room here, of a solid without a grid, of one of
# gigabytes, or with JIT off.
NOT_FINITE, MANY = -1, -2
ROW, USED, LIVE = 0, 1, 2
# Of a blob: strides count its bytes in 32 bits; interpreted there are none.
MOST_SLOTS = 0 if config.DISABLE_JIT else 2**28  # type: ignore[attr-defined]


@inlined
def _next_segment(blob, ints, tab, lanes, lane, starts, ends, row, counts, begins):
    """Give a lane the next segment, from a row on, that meets the grid; return the row after it.

    Those before it are settled: counts, begins.
    """
    while row < starts.shape[0]:
        i = row
        row += 1
        counts[i], begins[i] = 0, False
        ax, ay, az, bx, by, bz = starts[i, 0], starts[i, 1], starts[i, 2], ends[i, 0], ends[i, 1], ends[i, 2]
        finite = math.isfinite(ax) and math.isfinite(ay) and math.isfinite(az)
        if not (finite and math.isfinite(bx) and math.isfinite(by) and math.isfinite(bz)):
            counts[i] = NOT_FINITE
            continue
        px, py, pz = into_tree(blob, ints, ax, ay, az)
        ex, ey, ez = into_tree(blob, ints, bx, by, bz)
        dx, dy, dz = ex - px, ey - py, ez - pz
        length = math.sqrt(dx * dx + dy * dy + dz * dz)
        if length == 0.0:
            begins[i] = solid_contains(blob, ints, tab, np.int64(0), px, py, pz)
        elif ints[VOXELS] == 0 or blob.shape[0] > MOST_SLOTS:
            counts[i] = MANY
        elif set_out(blob, ints, lanes, lane, px, py, pz, ex, ey, ez, length):
            lanes[SEGMENT, lane] = i
            return row
    lanes[SEGMENT, lane], lanes[STOP, lane], lanes[T, lane] = -1.0, -1.0, 0.0
    return row


@inlined
def _strode_to_end(lanes, lane):
    """Return whether a stride took a lane to its end in a state that holds there: outside, where it leaves the grid."""
    t, stop = lanes[T, lane], lanes[STOP, lane]
    return t >= stop and t != lanes[LEFT_AT, lane] and (stop >= 1.0 or lanes[STATE, lane] == 0.0)


@unmanaged
def _side_by_side(
    blob, ints, tab, starts, ends, first, resolution, tolerance, counts, begins, places, ts, found, begun, work, slots,
    pending,
):  # fmt: skip
    """Follow segments in the lanes until all are done; or return False where ts has no room for one more's crossings.

    begun: (3,) the row of the next segment, slots of ts used, lanes under way; all 0 to begin with, and as they were
    left to go on. found: (LANES, ROOM) scratch.
    """
    c = ints[VOXELS]
    lanes, words = work[PIECES + 1 :], blob.view(np.int32)
    nx, ny, nz, bricks, bases = ints[c], ints[c + 1], ints[c + 2], ints[c + BRICKS], ints[c + BASES]
    octets = ints[c + BYTES]
    brick_planes, planes, details = ints[c + BRICK_PLANES], ints[c + PLANES], ints[c + DETAILS]
    row, used, live = begun[ROW], begun[USED], begun[LIVE]
    if row == 0:
        for lane in range(LANES):
            row = _next_segment(blob, ints, tab, lanes, lane, starts, ends, row, counts, begins)
            live += 1 if lanes[SEGMENT, lane] >= 0.0 else 0
    while live > 0:
        if used + LANES * ROOM > ts.shape[0]:
            begun[ROW], begun[USED], begun[LIVE] = row, used, live
            return False
        while True:
            taken = stride(lanes, words, tab, nx, ny, nz, bricks, bases, octets, brick_planes, planes, details)
            going = bits_set(taken)
            if going == 0 or going <= live - WAITING:
                break
        for lane in range(LANES):
            i = np.int64(lanes[SEGMENT, lane])
            if (taken >> lane) & 1 or i < 0:
                continue
            if cross_voxel(blob, ints, tab, lanes, np.int64(lane), tolerance, found[lane]):
                if not (first and lanes[COUNT, lane] > 0.0 and lanes[T, lane] > found[lane, 0] + lanes[GAP, lane]):
                    continue
            elif not _strode_to_end(lanes, lane) and not go_on(
                blob, ints, tab, lanes, np.int64(lane), resolution, tolerance, first, np.bool_(False), found[lane],
                work, slots, pending,
            ):  # fmt: skip
                continue
            count = np.int64(lanes[COUNT, lane])
            if first:
                count = min(count, 1)
            begins[i], places[i], counts[i] = lanes[BEGIN, lane] > 0.0, used, count if count <= ROOM else MANY
            for k in range(count if count <= ROOM else 0):
                ts[used] = found[lane, k]
                used += 1
            row = _next_segment(blob, ints, tab, lanes, lane, starts, ends, row, counts, begins)
            live -= 1 if lanes[SEGMENT, lane] < 0.0 else 0
    begun[ROW], begun[USED], begun[LIVE] = row, used, live
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def _longer(ts):
    """Return ts (n,) with as much room again behind it."""
    out = np.empty(2 * ts.shape[0] + LANES * ROOM)
    out[: ts.shape[0]] = ts
    return out


@njit(cache=True, nogil=True, error_model="numpy")
def cross_many(blob, starts, ends, first, resolution, tolerance, counts, begins, places):
    """Return (m,) t of the crossings of LPS segments (n, 3) → (n, 3), each segment's in order.

    first: of the first crossing of each, at most. counts: (n,) crossings of each, NOT_FINITE, or MANY: to be followed
    alone. begins: (n,) whether it starts inside. places: (n,) where its crossings begin among all, if there are any.
    """
    ints, tab = integers(blob), tables(blob)
    work, slots, pending = scratch()
    found, ts, begun = np.empty((LANES, ROOM)), np.empty(2 * ROOM + starts.shape[0]), np.zeros(3, dtype=np.int64)
    work[PIECES + 1 + SEGMENT] = -1.0
    while not _side_by_side(
        blob, ints, tab, starts, ends, first, resolution, tolerance, counts, begins, places, ts, found, begun, work,
        slots, pending,
    ):  # fmt: skip
        ts = _longer(ts)
    return ts[: begun[USED]]


@njit(cache=True, nogil=True, error_model="numpy")
def place_first(order, counts, places, ts, out):
    """Put the first crossings, as `cross_many` tells of them, into rows `order` of out: NaN none, −1 not finite.

    Returns how many are not finite.
    """
    bad = 0
    for i in range(order.shape[0]):
        out[order[i]] = ts[places[i]] if counts[i] > 0 else (np.nan if counts[i] == 0 else -1.0)
        bad += 1 if counts[i] < 0 else 0
    return bad


@njit(cache=True, nogil=True, error_model="numpy")
def place_counts(order, counts, valid, out):
    """Put counts (k,), 0 where a segment is not finite, into rows `order` of out, and which are finite into valid."""
    for i in range(order.shape[0]):
        valid[order[i]], out[order[i]] = counts[i] >= 0, max(counts[i], 0)


@njit(cache=True, nogil=True, error_model="numpy")
def place_all(starts, ends, order, counts, begins, places, ts, offsets, t, points, entering):
    """Fill t (m,), points (m, 3) and entering (m,) with what `cross_many` found of segments (n, 3) → (n, 3).

    order: (n,) the row of the answers that each segment is for. offsets: where each row's crossings begin.
    """
    for i in range(starts.shape[0]):
        inside = begins[i]
        to = offsets[order[i]]
        for k in range(counts[i]):
            inside = not inside
            t[to + k], entering[to + k] = ts[places[i] + k], inside
            for c in range(3):
                points[to + k, c] = starts[i, c] + ts[places[i] + k] * (ends[i, c] - starts[i, c])
