"""The grid of voxels about a solid: bricks first, then the voxels of those that the surface passes."""

from __future__ import annotations

import numpy as np

from hhsr.batches import in_parts
from hhsr.compiled.blob import LINE, joined, read_only
from hhsr.kernels import layout as at
from hhsr.kernels import voxels as voxel_at
from hhsr.kernels.surfel import DETAIL, EXTRA, FINE, LARGEST, SURFEL_OWNER, SURFEL_SIZE, THICK, TURN
from hhsr.model import FloatArray


def voxel_grid(blob: FloatArray, low: FloatArray, side: float, counts: np.ndarray) -> FloatArray:
    """Return the blob with a grid behind it: lowest corner (3,), side of a voxel (mm), bricks along each axis (3,)."""
    view, brick = read_only(blob), voxel_at.BRICK
    states = np.empty(tuple(int(c) for c in counts), dtype=np.int8)
    in_parts(len(states), 2, lambda i, j: voxel_at.fill_bricks(view, low, brick * side, i, j, states))
    mixed = np.argwhere(states == 0)
    voxels, bases = np.empty((len(mixed), brick**3), dtype=np.int16), np.empty(len(mixed), dtype=np.int32)
    planes = np.empty((len(mixed), SURFEL_SIZE), dtype=np.float32)

    def prove(i: int, j: int) -> tuple[int, int, np.ndarray, np.ndarray]:
        room = np.empty((brick**3 * (j - i) + 1, SURFEL_SIZE), dtype=np.float32)
        more = np.empty((2 * brick**3 * (j - i) + 2, SURFEL_SIZE), dtype=np.float32)
        used, extra = voxel_at.fill_voxels(
            view, low, side, mixed[i:j], voxels[i:j], bases[i:j], planes[i:j], room, more
        )
        return i, j, room[:used].copy(), more[:extra].copy()

    found = in_parts(len(mixed), 64, prove)
    first, extra = 0, sum(len(some) for _, _, some, _ in found)
    for i, j, some, more in found:
        bases[i:j] += first
        some[some[:, DETAIL + SURFEL_OWNER] < 0, DETAIL + EXTRA] += extra
        first, extra = first + len(some), extra + len(more)
    surfels = np.concatenate([some for _, _, some, _ in found] + [more for _, _, _, more in found])
    _add_steps(states, voxels)
    bricks = np.full((*states.shape, voxel_at.BRICK_SIZE), -1, dtype=np.int32)
    leaps = bricks.view(np.int8)
    for octant in range(8):
        leap = np.empty(states.shape, dtype=np.int8)
        voxel_at.fill_octant(states, octant, leap)
        leaps[..., octant] = leap
    bricks[states == 0, : voxel_at.BRICK_VOXELS] = _short(planes, 0.5 * brick).view(np.int32)
    bricks[states == 0, voxel_at.BRICK_VOXELS] = brick**3 * np.arange(len(mixed))
    bricks[states == 0, voxel_at.BRICK_SURFEL] = bases
    start = len(blob)
    frame = np.array([*low, side, 1.0 / side])
    apart = np.zeros(-(start + voxel_at.VOXEL_INTS + frame.size) % LINE)  # no brick, no plane lies on two lines
    tables: list[np.ndarray] = [
        frame, apart, bricks, _short(surfels, 0.5), surfels[:, DETAIL:], voxels,
        np.zeros(16),  # strides read a row of each table, also where there is none
    ]  # fmt: skip
    places = np.concatenate([[0], np.cumsum([-(-table.nbytes // 8) for table in tables])]) + start + voxel_at.VOXEL_INTS
    grown = joined([blob, np.zeros(voxel_at.VOXEL_INTS, dtype=np.int64), *tables])
    head = grown.view(np.int64)[: at.HEADER_SIZE]
    record = grown.view(np.int64)[start : start + voxel_at.VOXEL_INTS]
    record[:3], record[voxel_at.BRICKS] = counts, 2 * places[2]
    record[voxel_at.PLANES], record[voxel_at.VOXELS_AT] = 4 * places[3], 4 * places[5]
    record[voxel_at.DETAILS] = 2 * (places[4] - head[at.MAP_START])
    head[at.VOXELS], head[at.VOXEL_FRAME] = start, places[0]
    return grown


def _short(surfels: np.ndarray, half: float) -> np.ndarray:
    """Return the planes (n, 4) of surfels (n, SURFEL_SIZE) as 16-bit numbers, thicker so that no claim is lost.

    half: the side of what they are over, halved, in voxels. With |rounding| ≤ 1/2 of each number a plane strays by no
    more than e there; at s times the thickness it is within 1 where s·e + 1 ≤ s. Thickness and turn are changed.
    """
    planes = np.nan_to_num(surfels[:, :DETAIL].astype(np.float64))
    stray = (1.5 * half + 0.5) / FINE
    scale = np.maximum((1.0 + 1e-6) / (1.0 - stray), np.abs(planes).max(axis=1, initial=0.0) * (FINE / LARGEST))
    alone = surfels[:, DETAIL + SURFEL_OWNER] >= 0
    surfels[alone, DETAIL + THICK] *= scale[alone] * (1.0 + 1e-6)
    surfels[alone, DETAIL + TURN] += surfels[alone, DETAIL + THICK] / FINE
    short: np.ndarray = np.rint(planes * (FINE / scale[:, None])).astype(np.int16)
    return short


def _add_steps(bricks: np.ndarray, voxels: np.ndarray) -> None:
    """Add to the voxels (n, 64) of bricks that are not proven the leaps of those that are: two, and each octant's."""
    states = np.empty(tuple(voxel_at.BRICK * n for n in bricks.shape), dtype=np.int8)
    voxel_at.state_voxels(bricks, voxels, states)
    steps = np.empty((8, *voxels.shape), dtype=np.int8)

    def fill(i: int, j: int) -> None:
        for octant in range(i, j):
            leaps = np.empty_like(states)
            voxel_at.fill_octant(states, octant, leaps)
            voxel_at.fill_steps(bricks, leaps, steps[octant])

    in_parts(8, 1, fill)
    # The shortest, and the one that makes all together longest: as many as reach it, and what each gains.
    short = steps.min(axis=0)
    long, gained = short.copy(), np.zeros(short.shape, dtype=np.int8)
    for step in range(1, voxel_at.FARTHEST_STEP + 1):
        gain = (steps >= step).sum(axis=0, dtype=np.int8) * (step - short)
        long[gain > gained] = step
        gained = np.maximum(gain, gained)
    bits = (short.astype(np.int16) | (long.astype(np.int16) << voxel_at.STEP_BITS)) << voxel_at.SHORT_BITS
    for octant in range(8):
        bits |= (steps[octant] >= long).astype(np.int16) << octant
    voxels |= np.where(voxels < 0, bits, np.int16(0))
