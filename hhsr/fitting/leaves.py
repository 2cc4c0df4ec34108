"""The leaves of a parting, all together, within one budget (DESIGN §3)."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numba
import numpy as np

from hhsr.fitting.lookahead import Piece
from hhsr.fitting.refine import figures, improved, mending_rows
from hhsr.fitting.rows import Rows
from hhsr.fitting.scale_field import NONE, costs_of_dropping, fit_ellipsoid, grid_for, leaf_of, select_centres
from hhsr.fitting.solid import Solid
from hhsr.fitting.spend import counts_within
from hhsr.fitting.task import Task, hint_rows, hold_rows, start_rows, task_of
from hhsr.model import IntArray, ModelLeaf, ScaleField, frozen

T = TypeVar("T")

LEAF_NUMBERS = 9
FINEST = (60, 8_000)


class Effort(NamedTuple):
    """Centres of the finest grid for each number to spend, Gauss-Newton steps in a row, rounds of swaps at most."""

    atoms: int
    steps: int
    swaps: int


SCOUT = Effort(5, 2, 1)
THOROUGH = Effort(7, 3, 3)
SWAPPED = 0.3
POWER = 1.5
SEED = 5


class Fitted(NamedTuple):
    """Leaves in the order of their pieces, and how they fit.

    mean, largest: miss, mm. unseen: share of the samples that no centre sees. worst: the leaf with the largest miss.
    """

    leaves: list[ModelLeaf]
    mean: float
    largest: float
    unseen: float
    worst: int


def fit_leaves(solid: Solid, pieces: list[Piece], budget: int, effort: Effort) -> Fitted:
    """Return the leaves of the pieces within a budget of numbers.

    effort: a scout tells which parting is worth a thorough fit; without a round of swaps it tells the wrong one.
    """
    free = budget - LEAF_NUMBERS * len(pieces)
    if free < 0:
        raise ValueError(f"budget: got {budget} numbers for {len(pieces)} leaves, expected {LEAF_NUMBERS} for each")
    grid = grid_for(int(np.clip(effort.atoms * budget / len(pieces), *FINEST)))
    tasks = in_threads(
        lambda k: task_of(solid, pieces[k].region, pieces[k].members, pieces[k].centre, SEED), len(pieces)
    )
    axes = in_threads(
        lambda k: fit_ellipsoid(start_rows(tasks[k], solid, pieces[k].centre).joined(hint_rows(tasks[k], solid))),
        len(pieces),
    )
    bare = [leaf_of(p.centre, a, ScaleField(grid, NONE, frozen([]))) for p, a in zip(pieces, axes, strict=True)]
    rows = [_first_rows(solid, t, leaf) for t, leaf in zip(tasks, bare, strict=True)]
    limits = [int(2.0 * free / len(pieces)) + 1] * len(pieces)
    leaves = _chosen(bare, rows, [NONE] * len(pieces), limits, free)
    best = _judged(solid, tasks, _refined(solid, tasks, leaves, effort.steps))
    for _ in range(effort.swaps):
        swapped = _judged(solid, tasks, _refined(solid, tasks, _swapped(solid, tasks, best.leaves, free), effort.steps))
        if swapped.mean >= best.mean:
            break
        best = swapped
    return best


def _first_rows(solid: Solid, task: Task, leaf: ModelLeaf) -> Rows:
    """Return the rows of a leaf that is still bare."""
    half_axes = np.asarray(leaf.superquadric.half_axes)
    return start_rows(task, solid, leaf.centre).joined(hold_rows(task, solid, half_axes))


def _swapped(solid: Solid, tasks: list[Task], leaves: list[ModelLeaf], free: int) -> list[ModelLeaf]:
    """Return the leaves without the centres that all of them together miss least, and with better ones instead."""
    rows = in_threads(lambda k: mending_rows(solid, tasks[k], leaves[k]), len(leaves))
    costs = in_threads(lambda k: costs_of_dropping(rows[k], leaves[k]), len(leaves))
    limit = float(np.quantile(np.concatenate(costs), SWAPPED)) if sum(c.size for c in costs) else 0.0
    held = [leaf.scale_field.index[c > limit] for leaf, c in zip(leaves, costs, strict=True)]
    limits = [min(int(1.5 * leaf.scale_field.index.size) + 8, free) for leaf in leaves]
    return _chosen(leaves, rows, held, limits, free)


def _chosen(
    leaves: list[ModelLeaf], rows: list[Rows], held: list[IntArray], limits: list[int], free: int
) -> list[ModelLeaf]:
    """Return the leaves with centres chosen for the rows: those held, and the best others within the free numbers."""
    grid = leaves[0].scale_field.grid
    selections = in_threads(
        lambda k: select_centres(rows[k], np.asarray(leaves[k].superquadric.half_axes), grid, limits[k], held[k]),
        len(leaves),
    )
    counts = counts_within([s.gains for s in selections], grid.size, free, [s.held for s in selections])
    return [
        leaf_of(leaf.centre, leaf.superquadric.half_axes, s.field(k))
        for leaf, s, k in zip(leaves, selections, counts, strict=True)
    ]


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
        int(np.argmax([f.largest for f in found])),
    )


def in_threads(work: Callable[[int], T], count: int) -> list[T]:
    """Return [work(0), …], made on as many threads as numba may use; each piece of work is the same on any thread."""
    workers = min(numba.get_num_threads(), count)
    if workers <= 1:
        return [work(k) for k in range(count)]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(work, range(count)))
