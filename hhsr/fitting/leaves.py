"""The leaves of a parting, all together, within one budget (DESIGN §3)."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numba
import numpy as np

from hhsr.fitting.lookahead import Piece
from hhsr.fitting.refine import (
    Task,
    figures,
    hint_rows,
    hold_rows,
    improved,
    mending_rows,
    start_rows,
    task_of,
)
from hhsr.fitting.scale_field import fit_ellipsoid, grid_for, leaf_of, select_centres
from hhsr.fitting.solid import Solid
from hhsr.fitting.spend import counts_within
from hhsr.model import CentreGrid, FloatArray, ModelLeaf, ScaleField, frozen

T = TypeVar("T")

LEAF_NUMBERS = 9
ATOMS_PER_NUMBER = 7
SCOUTS_ATOMS = 4
FINEST = (60, 8_000)
ROUNDS = 3
STEPS = 3
POWER = 1.5
SEED = 5


class Fitted(NamedTuple):
    """Leaves in the order of their pieces; mean and largest miss (mm); the share of samples that no centre sees."""

    leaves: list[ModelLeaf]
    mean: float
    largest: float
    unseen: float


def fit_leaves(solid: Solid, pieces: list[Piece], budget: int, thorough: bool) -> Fitted:
    """Return the leaves of the pieces within a budget of numbers.

    thorough: three rounds of selection on what the last round missed, against one.
    """
    free = budget - LEAF_NUMBERS * len(pieces)
    if free < 0:
        raise ValueError(f"budget: got {budget} numbers for {len(pieces)} leaves, expected {LEAF_NUMBERS} for each")
    grid = grid_for(int(np.clip((ATOMS_PER_NUMBER if thorough else SCOUTS_ATOMS) * budget / len(pieces), *FINEST)))
    tasks = in_threads(
        lambda k: task_of(solid, pieces[k].region, pieces[k].members, pieces[k].centre, SEED), len(pieces)
    )
    axes = in_threads(
        lambda k: fit_ellipsoid(start_rows(tasks[k], solid, pieces[k].centre).joined(hint_rows(tasks[k], solid))),
        len(pieces),
    )
    leaves = [bare_leaf(p.centre, a, grid) for p, a in zip(pieces, axes, strict=True)]
    limits = [int(2.0 * free / len(pieces)) + 1] * len(pieces)
    for turn in range(ROUNDS if thorough else 1):
        leaves = _chosen(solid, pieces, tasks, leaves, axes, grid, limits, free, turn == 0)
        limits = [min(int(1.3 * leaf.scale_field.weights.size) + 8, free) for leaf in leaves]
        leaves = _refined(solid, tasks, leaves, STEPS if thorough else 1)
    return _judged(solid, tasks, leaves)


def bare_leaf(centre: FloatArray, half_axes: FloatArray, grid: CentreGrid) -> ModelLeaf:
    """Return a leaf without centres."""
    return leaf_of(centre, half_axes, ScaleField(grid, frozen([], np.int64), frozen([])))


def _chosen(
    solid: Solid,
    pieces: list[Piece],
    tasks: list[Task],
    leaves: list[ModelLeaf],
    axes: list[FloatArray],
    grid: CentreGrid,
    limits: list[int],
    free: int,
    first: bool,
) -> list[ModelLeaf]:
    """Return leaves with centres chosen anew, by what the leaves so far miss."""

    def selected(k: int):  # type: ignore[no-untyped-def]
        if first:
            rows = start_rows(tasks[k], solid, pieces[k].centre).joined(hold_rows(tasks[k], solid, axes[k]))
        else:
            rows = mending_rows(solid, tasks[k], leaves[k])
        return select_centres(rows, axes[k], grid, limits[k])

    selections = in_threads(selected, len(pieces))
    counts = counts_within([s.gains for s in selections], grid.size, free)
    return [leaf_of(p.centre, a, s.field(k)) for p, a, s, k in zip(pieces, axes, selections, counts, strict=True)]


def _refined(solid: Solid, tasks: list[Task], leaves: list[ModelLeaf], steps: int) -> list[ModelLeaf]:
    """Return the leaves after some Gauss-Newton steps each."""
    return in_threads(lambda k: improved(solid, tasks[k], leaves[k], steps, POWER), len(leaves))


def _judged(solid: Solid, tasks: list[Task], leaves: list[ModelLeaf]) -> Fitted:
    """Return the leaves with what they miss."""
    found = in_threads(lambda k: figures(solid, tasks[k], leaves[k]), len(leaves))
    count = solid.samples.points.shape[0]
    return Fitted(
        leaves,
        sum(f.total for f in found) / count,
        max(f.largest for f in found),
        sum(f.unseen for f in found) / count,
    )


def in_threads(work: Callable[[int], T], count: int) -> list[T]:
    """Return [work(0), …], made on as many threads as numba may use; each piece of work is the same on any thread."""
    workers = min(numba.get_num_threads(), count)
    if workers <= 1:
        return [work(k) for k in range(count)]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(work, range(count)))
