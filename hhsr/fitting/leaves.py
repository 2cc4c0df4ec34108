"""The leaves of a parting, all together, within one budget (DESIGN §3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.spatial import cKDTree

from hhsr.fitting.aim import Aim
from hhsr.fitting.base import base_radii, local
from hhsr.fitting.bases import base_that_pays
from hhsr.fitting.closing import closed
from hhsr.fitting.lookahead import Piece
from hhsr.fitting.refine import Figures, Misses, figures, improved, mending_rows, radii_of, view_of
from hhsr.fitting.rows import Rows
from hhsr.fitting.scale_field import (
    NONE,
    Atoms,
    Selection,
    atoms_of,
    costs_of_dropping,
    fit_ellipsoid,
    grid_for,
    leaf_of,
)
from hhsr.fitting.section import Section, near_voids, section_of
from hhsr.fitting.solid import Solid
from hhsr.fitting.spend import counts_within
from hhsr.fitting.task import Task, first_rows, hint_rows, start_rows, task_of
from hhsr.fitting.threads import in_threads
from hhsr.model import FloatArray, IntArray, ModelLeaf, ScaleField

LEAF_NUMBERS = 9
FINEST = (60, 8_000)


class Effort(NamedTuple):
    """Centres of the finest grid for each number to spend, Gauss-Newton steps in a row, rounds of swaps at most.

    stride: of how many samples and rays one is looked at. bases: whether richer ones may be bought, if at all.
    voids: whether such as are too small for a section's points are looked for.
    """

    atoms: int
    steps: int
    swaps: int
    stride: int
    bases: bool
    voids: bool


SCOUT = Effort(5, 2, 1, 2, bases=False, voids=False)
THOROUGH = Effort(7, 3, 3, 1, bases=True, voids=True)
SWAPPED = 0.3
FURTHER = 1.3
SEED = 5
BEHIND = 1.3


class Fitted(NamedTuple):
    """Leaves in the order of their pieces, and how they fit.

    mean: miss, mm. largests: of each leaf, mm; spots: (leaves, 3) where. unseen: share of the samples that no centre
    sees. worst: what the largest miss weighs beside the mean. first: mean before any swap, mm. score: what is to be as
    small as can be: the mean, and a little of the largest; of a fit that was given up, what it would have come to.
    """

    leaves: list[ModelLeaf]
    mean: float
    largests: tuple[float, ...]
    spots: FloatArray
    unseen: float
    first: float
    score: float

    @property
    def largest(self) -> float:
        """The largest miss, mm."""
        return max(self.largests)


class Prepared(NamedTuple):
    """A piece, what its leaf has to tell, where it is cut off, and the leaf without a field: an ellipsoid."""

    piece: Piece
    task: Task
    section: Section
    bare: ModelLeaf


class Workshop:
    """What the leaves of a solid's pieces start from, kept: many partings share pieces."""

    def __init__(self, solid: Solid, aim: Aim, bases: tuple[tuple[bool, int], ...] = ()) -> None:
        self.solid, self.aim, self.bases = solid, aim, bases
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
        bare = leaf_of(piece.centre, half_axes, ScaleField.none())
        return Prepared(piece, task, section_of(self.solid, piece.region, piece.centre), bare)


def fit_leaves(
    workshop: Workshop, pieces: Sequence[Piece], budget: int, effort: Effort, rival: Fitted | None = None
) -> Fitted:
    """Return the leaves of the pieces within a budget of numbers.

    effort: a scout tells which parting is worth a thorough fit; without a round of swaps it tells the wrong one.
    rival: a fit of the same effort; this one is given up where its mean before any swap is 30 % above the rival's.
    """
    free = budget - LEAF_NUMBERS * len(pieces)
    if free < 0:
        raise ValueError(f"budget: got {budget} numbers for {len(pieces)} leaves, expected {LEAF_NUMBERS} for each")
    solid = workshop.solid
    ready = workshop.prepared(pieces, effort.stride)
    tasks = [r.task for r in ready]
    grid = grid_for(int(np.clip(effort.atoms * budget / len(pieces), *FINEST)))
    bare = [r.bare for r in ready]
    atoms = in_threads(lambda k: atoms_of(grid, ready[k].task.directions), len(ready))
    rows = [first_rows(r.task, solid, r.bare) for r in ready]
    leaves = _chosen(atoms, bare, rows, [NONE] * len(pieces), [free // len(pieces) + 1] * len(pieces), free)
    if workshop.bases and effort.bases:
        bare = in_threads(lambda k: base_that_pays(solid, ready[k].task, leaves[k], workshop.bases), len(leaves))
        free -= sum(leaf.parameters for leaf in bare) - LEAF_NUMBERS * len(bare)
        atoms = in_threads(lambda k: atoms_of(grid, local(bare[k], ready[k].task.directions)), len(bare))
        rows = [first_rows(r.task, solid, leaf) for r, leaf in zip(ready, bare, strict=True)]
        leaves = _chosen(atoms, bare, rows, [NONE] * len(bare), [leaf.scale_field.index.size for leaf in leaves], free)
    best, found = _refined(workshop, ready, leaves, [None] * len(leaves), effort.steps)
    if rival is not None and best.first > BEHIND * rival.first:
        return best._replace(score=rival.score * best.first / rival.first)
    first = best.first
    for _ in range(effort.swaps):
        tried = _swapped(atoms, tasks, best.leaves, found, free)
        swapped, after = _refined(workshop, ready, tried, found, effort.steps)
        if swapped.mean >= best.mean:
            break
        best, found = swapped, after
    if effort.voids:
        ready = _searched(workshop, ready, best, found)
    return _closed(workshop, ready, best, found)._replace(first=first)


def _searched(workshop: Workshop, ready: list[Prepared], fitted: Fitted, found: list[Misses]) -> list[Prepared]:
    """Return the pieces with more points of their planes where a void may hide that is worse than any other miss."""
    missed = [np.abs(misses.miss[: misses.near][misses.share[: misses.near] > 0.0]) for misses in found]
    least = max((float(miss.max(initial=0.0)) for miss in missed), default=0.0)

    def search(k: int) -> Prepared:
        piece, leaf = ready[k].piece, fitted.leaves[k]
        near = near_voids(workshop.solid, piece.region, leaf.centre, lambda along: radii_of(leaf, along), least)
        return ready[k]._replace(section=ready[k].section.joined(near))

    return in_threads(search, len(ready))


def _closed(workshop: Workshop, ready: list[Prepared], fitted: Fitted, found: list[Misses]) -> Fitted:
    """Return the leaves with their voids behind cuts closed, where that does not cost more than it brings."""
    solid, aim = workshop.solid, workshop.aim
    done = in_threads(
        lambda k: closed(solid, ready[k].task, ready[k].section, fitted.leaves[k], found[k], aim), len(found)
    )
    return _judged(workshop, ready, done)


def _swapped(
    atoms: list[Atoms], tasks: list[Task], leaves: list[ModelLeaf], found: list[Misses], free: int
) -> list[ModelLeaf]:
    """Return the leaves without the centres that all of them together miss least, and with better ones instead."""
    rows = in_threads(lambda k: mending_rows(tasks[k], found[k]), len(leaves))
    costs = in_threads(lambda k: costs_of_dropping(rows[k], leaves[k]), len(leaves))
    limit = float(np.quantile(np.concatenate(costs), SWAPPED)) if sum(c.size for c in costs) else 0.0
    held = [leaf.scale_field.index[c > limit] for leaf, c in zip(leaves, costs, strict=True)]
    return _chosen(atoms, leaves, rows, held, [leaf.scale_field.index.size + 8 for leaf in leaves], free)


def _chosen(
    atoms: list[Atoms],
    leaves: list[ModelLeaf],
    rows: list[Rows],
    held: list[IntArray],
    likely: list[int],
    free: int,
) -> list[ModelLeaf]:
    """Return the leaves with centres chosen for the rows: those held, and the best others within the free numbers.

    atoms: of the rows' directions. likely: how many each leaf chooses at first; those whose last one still pays go on.
    """
    selections = in_threads(
        lambda k: Selection(atoms[k], rows[k], base_radii(leaves[k], rows[k].directions), held[k]), len(leaves)
    )
    wanted = [min(count, free) for count in likely]
    while True:
        in_threads(lambda k: selections[k].extend(wanted[k]), len(leaves))
        counts = counts_within([s.gains for s in selections], atoms[0].grid.size, free, [s.held for s in selections])
        short = [k for k, s in enumerate(selections) if counts[k] == wanted[k] < free and not s.complete]
        if not short:
            break
        for k in short:
            wanted[k] = min(int(FURTHER * wanted[k]) + 8, free)
    return [replace(leaf, scale_field=s.field(k)) for leaf, s, k in zip(leaves, selections, counts, strict=True)]


def _refined(
    workshop: Workshop, ready: list[Prepared], leaves: list[ModelLeaf], before: Sequence[Misses | None], steps: int
) -> tuple[Fitted, list[Misses]]:
    """Return the leaves after some Gauss-Newton steps each, with what they miss.

    before: of each, what a leaf like it missed.
    """

    solid, aim = workshop.solid, workshop.aim

    def work(k: int) -> tuple[ModelLeaf, Misses]:
        view = view_of(ready[k].task.directions, leaves[k])
        return improved(solid, ready[k].task, leaves[k], view, steps, aim.power, before[k])

    done = in_threads(work, len(leaves))
    return _judged(workshop, ready, done), [misses for _, misses in done]


def _judged(workshop: Workshop, ready: list[Prepared], done: list[tuple[ModelLeaf, Misses]]) -> Fitted:
    """Return the leaves with what they miss."""
    solid = workshop.solid
    found = [figures(solid, r.task, r.section, leaf, misses) for r, (leaf, misses) in zip(ready, done, strict=True)]
    count = sum(r.task.seen.size for r in ready)
    unseen = [r.task.points[~r.task.seen] for r in ready]
    gaps = _gaps(found, np.concatenate(unseen), np.sqrt(solid.sample_area * ready[0].task.stride))
    hidden = np.split(gaps, np.cumsum([len(points) for points in unseen])[:-1])
    largests = [max(f.largest, float(h.max(initial=0.0))) for f, h in zip(found, hidden, strict=True)]
    spots = [
        points[h.argmax()] if h.max(initial=0.0) > f.largest else f.spot
        for f, h, points in zip(found, hidden, unseen, strict=True)
    ]
    mean = (sum(f.total for f in found) + 0.5 * float(gaps.sum())) / count
    score = mean + workshop.aim.worst * max(largests)
    return Fitted([leaf for leaf, _ in done], mean, tuple(largests), np.array(spots), len(gaps) / count, mean, score)


def _gaps(found: list[Figures], points: FloatArray, spacing: float) -> FloatArray:
    """Return how far (n,) points lie from the leaves' surface, which is known in points about `spacing` apart.

    Along the nearest point's normal the distance counts in full, across it only what is more than the spacing: nearest
    points alone were 5 mm off where the surface was met.
    """
    surface, normals = np.concatenate([f.surface for f in found]), np.concatenate([f.normals for f in found])
    if not len(points):
        return np.zeros(0)
    nearest = cKDTree(surface).query(points)[1]
    offset = points - surface[nearest]
    height = np.einsum("ni,ni->n", offset, normals[nearest])
    across = np.sqrt(np.maximum((offset**2).sum(axis=1) - height**2, 0.0))
    gaps: FloatArray = np.hypot(height, np.maximum(across - spacing, 0.0))
    return gaps
