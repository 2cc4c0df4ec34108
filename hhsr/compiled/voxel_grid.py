"""The grid of voxels about a solid: bricks first, then the voxels of those that the surface passes."""

from __future__ import annotations

import numpy as np

from hhsr.batches import in_parts
from hhsr.compiled.blob import joined, read_only
from hhsr.kernels import layout as at
from hhsr.kernels import voxels as voxel_at
from hhsr.kernels.surfel import DETAIL, EXTRA, SURFEL_OWNER, SURFEL_SIZE
from hhsr.model import FloatArray


def voxel_grid(blob: FloatArray, low: FloatArray, side: float, counts: np.ndarray) -> FloatArray:
    """Return the blob with a grid behind it: lowest corner (3,), side of a voxel (mm), bricks along each axis (3,)."""
    view, brick = read_only(blob), voxel_at.BRICK
    states = np.empty(tuple(int(c) for c in counts), dtype=np.int8)
    in_parts(len(states), 2, lambda i, j: voxel_at.fill_bricks(view, low, brick * side, i, j, states))
    mixed = np.argwhere(states == 0)
    octets, bases = np.empty((len(mixed), brick**3), dtype=np.uint8), np.empty(len(mixed), dtype=np.int32)
    planes = np.empty((len(mixed), SURFEL_SIZE), dtype=np.float32)

    def prove(i: int, j: int) -> tuple[int, int, np.ndarray, np.ndarray]:
        room = np.empty((brick**3 * (j - i) + 1, SURFEL_SIZE), dtype=np.float32)
        more = np.empty((2 * brick**3 * (j - i) + 2, SURFEL_SIZE), dtype=np.float32)
        used, extra = voxel_at.fill_voxels(
            view, low, side, mixed[i:j], octets[i:j], bases[i:j], planes[i:j], room, more
        )
        return i, j, room[:used].copy(), more[:extra].copy()

    found = in_parts(len(mixed), 64, prove)
    first, extra = 0, sum(len(some) for _, _, some, _ in found)
    for i, j, some, more in found:
        bases[i:j] += first
        some[some[:, DETAIL + SURFEL_OWNER] < 0, DETAIL + EXTRA] += extra
        first, extra = first + len(some), extra + len(more)
    surfels = np.concatenate([some for _, _, some, _ in found] + [more for _, _, _, more in found])
    leaps = np.empty((8, *states.shape), dtype=np.int8)
    for octant in range(8):
        voxel_at.fill_octant(states, octant, leaps[octant])
    steps = _steps(states, octets)
    slots = np.where(states > 0, voxel_at.INSIDE_BRICK, voxel_at.OUTSIDE_BRICK).astype(np.int32)
    slots[states == 0] = np.arange(len(mixed))
    start = len(blob)
    frame = np.array([*low, side, 1.0 / side])
    tables: list[np.ndarray] = [
        frame, leaps, slots, bases, octets, planes[:, :DETAIL], surfels[:, :DETAIL], surfels[:, DETAIL:], steps,
        np.zeros(16),  # strides read a row of each table, also where there is none
    ]  # fmt: skip
    places = np.concatenate([[0], np.cumsum([-(-table.nbytes // 8) for table in tables])]) + start + voxel_at.VOXEL_INTS
    record = np.zeros(voxel_at.VOXEL_INTS, dtype=np.int64)
    record[:3], record[voxel_at.OCTANT_WORDS] = counts, steps[0].size
    record[voxel_at.LEAPS], record[voxel_at.BYTES] = 8 * places[1], 8 * places[4]
    record[[voxel_at.BRICKS, voxel_at.BASES, voxel_at.STEPS]] = 2 * places[[2, 3, 8]]
    grown = joined([blob, record, *tables])
    head = grown.view(np.int64)[: at.HEADER_SIZE]
    record = grown.view(np.int64)[start : start + voxel_at.VOXEL_INTS]
    record[voxel_at.BRICK_PLANES : voxel_at.DETAILS + 1] = 2 * (places[5:8] - head[at.MAP_START])
    head[at.VOXELS], head[at.VOXEL_FRAME] = start, places[0]
    return grown


def _steps(bricks: np.ndarray, octets: np.ndarray) -> np.ndarray:
    """Return the leaps (8, n, STEP_WORDS), packed, of the voxels of the bricks with bytes (n, 64), by octant."""
    states = np.empty(tuple(voxel_at.BRICK * n for n in bricks.shape), dtype=np.int8)
    voxel_at.state_voxels(bricks, octets, states)
    out = np.empty((8, len(octets), voxel_at.STEP_WORDS), dtype=np.uint32)

    def fill(i: int, j: int) -> None:
        for octant in range(i, j):
            leaps = np.empty_like(states)
            voxel_at.fill_octant(states, octant, leaps)
            voxel_at.fill_steps(bricks, leaps, out[octant])

    in_parts(8, 1, fill)
    return out
