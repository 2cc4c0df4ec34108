"""The maps of all leaves: how finely each is parted, within one allowance of memory."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from hhsr.batches import in_parts
from hhsr.compiled.records import Owner
from hhsr.kernels import layout as at
from hhsr.kernels.maps import fill_ranges, prove_base, prove_cells, pyramid_size
from hhsr.model import FloatArray

Float32Array = NDArray[np.float32]

CELLS_TOTAL = 144_000  # 36 bytes each, and with its facet and disc some 76
FINEST = 0.004  # mm: no cell is parted below this thickness
FACES = 6  # of a leaf's cube of directions
SHRINKS = 8.0  # halving a cell divides its thickness by about this, while the remainder of the bound rules


def fill_leaf_maps(blob: FloatArray, blob_view: FloatArray, owners: list[Owner], parted: bool) -> Float32Array:
    """Prove the maps of the model leaves; return their tables and note in the blob where each lies among them."""
    ints = blob.view(np.int64)
    proven = [_room(int(ints[owner.record + at.CELLS])) for owner in owners]
    sides = FACES * len(owners)  # each thread takes some: leaves differ much in size

    def prove(i: int, j: int) -> None:
        for side in range(i, j):
            owner = owners[side // FACES]
            prove_base(
                blob_view, owner.record, int(ints[owner.record + at.CELLS]), side % FACES, owner.planes_at,
                len(owner.planes), *proven[side // FACES],
            )  # fmt: skip

    in_parts(sides, 1, prove)
    thick = [thickness for _, _, thickness, _ in proven]
    level = _levels(thick) if parted else [np.zeros(t.shape, dtype=np.int64) for t in thick]
    tables: list[Float32Array] = []
    place = 0
    for owner, (_, _, thickness, bend), k in zip(owners, proven, level, strict=True):
        record = ints[owner.record : owner.record + at.LEAF_INT_SIZE]
        first = np.concatenate([[0], np.cumsum(4 ** k.ravel())])
        start = int(record[at.PARTING])
        ints[start : start + thickness.size] = first[:-1] * 16 + 8 * (thickness.ravel() > 0) + k.ravel()
        ranges, bends = 2 * pyramid_size(int(record[at.CELLS])), at.BEND_SIZE * thickness.size
        record[at.RANGE_TABLE], record[at.BEND_TABLE] = place, place + ranges
        record[at.CELL_TABLE] = place + ranges + bends
        table = np.empty(ranges + bends + at.CELL_SIZE * int(first[-1]), dtype=np.float32)
        table[ranges : ranges + bends] = bend.ravel()
        tables.append(table)
        place += table.size

    def fill(i: int, j: int) -> None:
        for side in range(i, j):
            owner, table = owners[side // FACES], tables[side // FACES]
            models, spans, thickness, _ = proven[side // FACES]
            record = ints[owner.record : owner.record + at.LEAF_INT_SIZE]
            n, start = int(record[at.CELLS]), int(record[at.PARTING])
            words = ints[start : start + thickness.size].reshape(thickness.shape)
            ranges, bends = 2 * pyramid_size(n), at.BEND_SIZE * thickness.size
            cells = table[ranges + bends :].reshape(-1, at.CELL_SIZE)
            bend = table[ranges : ranges + bends].reshape(6, n, n, at.BEND_SIZE)
            prove_cells(blob_view, owner.record, n, side % FACES, words, models, spans, cells, bend)

    in_parts(sides, 1, fill)
    for owner, (_, spans, _, _), table in zip(owners, proven, tables, strict=True):
        n, box = (int(x) for x in ints[owner.record + np.array([at.CELLS, at.BOX])])
        fill_ranges(n, spans, table[: 2 * pyramid_size(n)].reshape(-1, 2), blob[box : box + 8])
    return np.concatenate(tables) if tables else np.empty(0, dtype=np.float32)


def _room(n: int) -> tuple[Float32Array, FloatArray, FloatArray, Float32Array]:
    """Return room for the models, spans, thickness and bends of a leaf's base cells."""
    models, spans = np.empty((6, n, n, at.CELL_SIZE), dtype=np.float32), np.empty((6, n, n, 2))
    return models, spans, np.empty((6, n, n)), np.empty((6, n, n, at.BEND_SIZE), dtype=np.float32)


def _levels(thickness: list[FloatArray]) -> list[NDArray[np.int64]]:
    """Return (6, n, n) how often each base cell is halved: one thickness for all, as thin as the allowance permits."""
    low, high = np.log(FINEST), np.log(1e4)

    def halvings(goal: float) -> list[NDArray[np.int64]]:
        levels = []
        for t in thickness:
            more = np.ceil((np.log(np.maximum(t, 1e-12)) - goal) / np.log(SHRINKS))
            levels.append(np.where(t > 0, np.clip(1 + more, 0, at.FINEST_PARTING), 0).astype(np.int64))
        return levels

    def too_many(goal: float) -> bool:
        return sum(int((4**k).sum()) for k in halvings(goal)) > CELLS_TOTAL

    if not too_many(low):
        return halvings(low)
    for _ in range(20):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if too_many(middle) else (low, middle)
    return halvings(high)
