"""The leaves of a parting, all together, within one budget (DESIGN §3)."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import NamedTuple, TypeVar

import numba
import numpy as np
from scipy.spatial import cKDTree

from hhsr.fitting.closing import WORST_SHARE, closed
from hhsr.fitting.lookahead import Piece
from hhsr.fitting.refine import Misses, figures, improved, mending_rows
from hhsr.fitting.rows import Rows
from hhsr.fitting.scale_field import NONE, costs_of_dropping, fit_ellipsoid, grid_for, leaf_of, select_centres
from hhsr.fitting.section import Section, section_of
from hhsr.fitting.solid import Solid
from hhsr.fitting.spend import counts_within
from hhsr.fitting.task import Task, hint_rows, hold_rows, start_rows, task_of
from hhsr.model import FloatArray, IntArray, ModelLeaf, ScaleField, frozen

T = TypeVar("T")

LEAF_NUMBERS = 9
FINEST = (60, 8_000)


class Effort(NamedTuple):
    """Centres of the finest grid for each number to spend, Gauss-Newton steps in a row, rounds of swaps at most.

    stride: of how many samples and rays one is looked at.
    """

    atoms: int
    steps: int
    swaps: int
    stride: int


SCOUT = Effort(5, 2, 1, 2)
THOROUGH = Effort(7, 3, 3, 1)
SWAPPED = 0.3
POWER = 1.5
SEED = 5


class Fitted(NamedTuple):
    """Leaves in the order of their pieces, and how they fit.

    mean: miss, mm. largests: of each leaf, mm. unseen: share of the samples that no centre sees.
    """

    leaves: list[ModelLeaf]
    mean: float
    largests: tuple[float, ...]
    unseen: float

    @property
    def largest(self) -> float:
        """The largest miss, mm."""
        return max(self.largests)

    @property
    def score(self) -> float:
        """What is to be as small as can be: the mean miss, and a hundredth of the largest."""
        return self.mean + WORST_SHARE * self.largest


class Prepared(NamedTuple):
    """A piece, what its leaf has to tell, where it is cut off, and its ellipsoid's (6,) half axes in mm."""

    piece: Piece
    task: Task
    section: Section
    half_axes: FloatArray


class Workshop:
    """What the leaves of a solid's pieces start from, kept: many partings share pieces."""

    def __init__(self, solid: Solid) -> None:
        self.solid = solid
        self._kept: dict[tuple[int, int], Prepared] = {}

    def prepared(self, pieces: Sequence[Piece], stride: int) -> list[Prepared]:
        """Return the pieces prepared with one of `stride` samples and rays, looking at those that are new."""
        new = [piece for piece in pieces if (id(piece), stride) not in self._kept]
        for piece, found in zip(new, in_threads(lambda k: self._look(new[k], stride), len(new)), strict=True):
            self._kept[id(piece), stride] = found
        return [self._kept[id(piece), stride] for piece in pieces]

    def _look(self, piece: Piece, stride: int) -> Prepared:
        task = task_of(self.solid, piece.region, piece.members, piece.centre, SEED, stride)
        half_axes = fit_ellipsoid(start_rows(task, self.solid).joined(hint_rows(task, self.solid)))
        return Prepared(piece, task, section_of(self.solid, piece.region, piece.centre), half_axes)


def fit_leaves(workshop: Workshop, pieces: Sequence[Piece], budget: int, effort: Effort) -> Fitted:
    """Return the leaves of the pieces within a budget of numbers.

    effort: a scout tells which parting is worth a thorough fit; without a round of swaps it tells the wrong one.
    """
    free = budget - LEAF_NUMBERS * len(pieces)
    if free < 0:
        raise ValueError(f"budget: got {budget} numbers for {len(pieces)} leaves, expected {LEAF_NUMBERS} for each")
    solid = workshop.solid
    ready = workshop.prepared(pieces, effort.stride)
    tasks = [r.task for r in ready]
    grid = grid_for(int(np.clip(effort.atoms * budget / len(pieces), *FINEST)))
    none = ScaleField(grid, NONE, frozen([]))
    bare = [leaf_of(r.piece.centre, r.half_axes, none) for r in ready]
    rows = [start_rows(r.task, solid).joined(hold_rows(r.task, solid, r.half_axes)) for r in ready]
    limits = [min(int(2.0 * free / len(pieces)) + 1, free)] * len(pieces)
    leaves = _chosen(bare, rows, [NONE] * len(pieces), limits, free)
    best, found = _refined(solid, ready, leaves, effort.steps)
    for _ in range(effort.swaps):
        tried = _swapped(tasks, best.leaves, found, free)
        swapped, after = _refined(solid, ready, tried, effort.steps)
        if swapped.mean >= best.mean:
            break
        best, found = swapped, after
    return _closed(solid, ready, best)


def _closed(solid: Solid, ready: list[Prepared], fitted: Fitted) -> Fitted:
    """Return the leaves with their voids behind cuts closed, where that does not cost more than it brings."""
    done = in_threads(
        lambda k: closed(solid, ready[k].task, ready[k].section, fitted.leaves[k], POWER), len(fitted.leaves)
    )
    return _judged(solid, ready, done)


def _swapped(tasks: list[Task], leaves: list[ModelLeaf], found: list[Misses], free: int) -> list[ModelLeaf]:
    """Return the leaves without the centres that all of them together miss least, and with better ones instead."""
    rows = in_threads(lambda k: mending_rows(tasks[k], found[k]), len(leaves))
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


def _refined(solid: Solid, ready: list[Prepared], leaves: list[ModelLeaf], steps: int) -> tuple[Fitted, list[Misses]]:
    """Return the leaves after some Gauss-Newton steps each, with what they miss."""
    done = in_threads(lambda k: improved(solid, ready[k].task, leaves[k], steps, POWER), len(leaves))
    return _judged(solid, ready, done), [misses for _, misses in done]


def _judged(solid: Solid, ready: list[Prepared], done: list[tuple[ModelLeaf, Misses]]) -> Fitted:
    """Return the leaves with what they miss."""
    found = [figures(solid, r.task, r.section, leaf, misses) for r, (leaf, misses) in zip(ready, done, strict=True)]
    surface = cKDTree(np.concatenate([f.surface for f in found]))
    count = sum(r.task.seen.size for r in ready)
    unseen = [r.task.points[~r.task.seen] for r in ready]
    hidden = [surface.query(points)[0] if len(points) else np.zeros(0) for points in unseen]
    return Fitted(
        [leaf for leaf, _ in done],
        (sum(f.total for f in found) + 0.5 * sum(float(h.sum()) for h in hidden)) / count,
        tuple(max(f.largest, float(h.max(initial=0.0))) for f, h in zip(found, hidden, strict=True)),
        sum(len(points) for points in unseen) / count,
    )


def in_threads(work: Callable[[int], T], count: int) -> list[T]:
    """Return [work(0), …], made on as many threads as numba may use; each piece of work is the same on any thread."""
    workers = min(numba.get_num_threads(), count)
    if workers <= 1:
        return [work(k) for k in range(count)]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(work, range(count)))
