"""The default fit: cuts by look-ahead, centres by greed, one budget over everything (DESIGN §3)."""

from __future__ import annotations

from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

import numba
import numpy as np

from hhsr.fitting.lookahead import Piece, Step, parting
from hhsr.fitting.options import FitOptions
from hhsr.fitting.quantise import quantised
from hhsr.fitting.refine import hint_rows, hold_rows, improved, loss, mending_rows, start_rows, task_of
from hhsr.fitting.scale_field import fit_ellipsoid, grid_for, leaf_of, select_centres
from hhsr.fitting.solid import Solid, solid_of
from hhsr.fitting.spend import counts_within
from hhsr.model import Cut, FloatArray, IntArray, ModelLeaf, Node, ScaleField, normal_angles_of

T = TypeVar("T")

POSE_NUMBERS = 6
CUT_NUMBERS = 3
LEAF_NUMBERS = 9
USUAL_NUMBERS = 1000
SAMPLES = 12_000
ATOMS_PER_NUMBER = 14
ROUNDS = 3


def fit_default(vertices: FloatArray, faces: IntArray, options: FitOptions) -> Node:
    """Return the tree's root for a closed surface in its normalised frame (mm)."""
    budget = options.max_parameters if options.max_parameters is not None else USUAL_NUMBERS
    solid = solid_of(vertices, faces, SAMPLES, options.seed)
    first, steps = parting(solid, _most_pieces(budget))
    best: tuple[float, Node] | None = None
    for count in _worth_trying(solid, first, steps):
        node, miss = fit_parting(solid, first, steps[: count - 1], budget - POSE_NUMBERS)
        if best is None or miss < best[0]:
            best = (miss, node)
        elif miss > 1.3 * best[0]:
            break
    assert best is not None
    return quantised(best[1])


def _worth_trying(solid: Solid, first: Piece, steps: list[Step]) -> list[int]:
    """Return the numbers of leaves to be tried: not those whose centres miss far more of the surface than the next's."""
    unseen = []
    for count in range(1, len(steps) + 2):
        tasks = [task_of(solid, p.region, p.members, p.centre, SEED) for p in pieces_after(first, steps[: count - 1])]
        unseen.append(sum(int((~t.seen).sum()) for t in tasks) / solid.samples.points.shape[0])
    least = min(unseen)
    return [k + 1 for k, share in enumerate(unseen) if share <= 3.0 * least + 0.02]


def _most_pieces(budget: int) -> int:
    """Return how many leaves a budget could carry: with fewer than 40 numbers each, cuts cost more than they bring."""
    return int(np.clip((budget - POSE_NUMBERS) // 40, 1, 8))


def fit_parting(solid: Solid, first: Piece, steps: list[Step], budget: int) -> tuple[Node, float]:
    """Return the fitted tree of a parting, within a budget of numbers, and what its rows miss."""
    pieces = pieces_after(first, steps)
    leaves, miss = fit_leaves(solid, pieces, budget - CUT_NUMBERS * len(steps))
    return tree_of(first, steps, leaves), miss


def fit_leaves(solid: Solid, pieces: list[Piece], budget: int) -> tuple[list[ModelLeaf], float]:
    """Return the leaves within a budget: selection repeated with the bounds that the last one broke."""
    grid = grid_for(int(np.clip(ATOMS_PER_NUMBER * budget / len(pieces), 300, 8_000)))
    tasks = in_threads(
        lambda k: task_of(solid, pieces[k].region, pieces[k].members, pieces[k].centre, SEED), len(pieces)
    )
    rows = [start_rows(t, solid, p.centre) for t, p in zip(tasks, pieces, strict=True)]
    hints = [hint_rows(t, solid) for t in tasks]
    axes = [fit_ellipsoid(r.joined(h)) for r, h in zip(rows, hints, strict=True)]
    free = budget - LEAF_NUMBERS * len(pieces)
    limits = [int(2.0 * free / len(pieces)) + 1] * len(pieces)
    rows = [r.joined(hold_rows(t, solid, a)) for r, t, a in zip(rows, tasks, axes, strict=True)]
    leaves = [
        leaf_of(p.centre, a, ScaleField(grid, np.zeros(0, np.int64), np.zeros(0)))
        for p, a in zip(pieces, axes, strict=True)
    ]
    for turn in range(ROUNDS):
        if turn:
            rows = in_threads(lambda k: mending_rows(solid, tasks[k], leaves[k]), len(pieces))  # noqa: B023
            axes = [np.asarray(leaf.superquadric.half_axes) for leaf in leaves]
        selections = in_threads(
            lambda k: select_centres(rows[k], axes[k], grid, limits[k]),
            len(pieces),  # noqa: B023
        )
        counts = counts_within([s.gains for s in selections], grid.size, free)
        limits = [min(int(1.3 * c) + 8, free) for c in counts]
        leaves = [leaf_of(p.centre, a, s.field(k)) for p, a, s, k in zip(pieces, axes, selections, counts, strict=True)]
        leaves = in_threads(
            lambda k: improved(solid, tasks[k], leaves[k], STEPS, POWER),
            len(pieces),  # noqa: B023
        )
        if VERBOSE:
            print(turn, counts, [round(loss(solid, t, l) / 12000, 4) for t, l in zip(tasks, leaves)])
    return leaves, sum(loss(solid, t, leaf) for t, leaf in zip(tasks, leaves, strict=True))


VERBOSE = False
SEED = 5
STEPS = 3
POWER = 1.5


def in_threads(work: Callable[[int], T], count: int) -> list[T]:
    """Return [work(0), …], made on as many threads as numba may use; each piece of work is the same on any thread."""
    workers = min(numba.get_num_threads(), count)
    if workers <= 1:
        return [work(k) for k in range(count)]
    with ThreadPoolExecutor(workers) as pool:
        return list(pool.map(work, range(count)))


def pieces_after(first: Piece, steps: list[Step]) -> list[Piece]:
    """Return the pieces after some steps: a cut piece is replaced by its left, its right is appended."""
    pieces = [first]
    for step in steps:
        pieces[step.piece] = step.split.left
        pieces.append(step.split.right)
    return pieces


def tree_of(first: Piece, steps: list[Step], leaves: list[ModelLeaf]) -> Node:
    """Return the tree of a parting with its leaves, given in the order of `pieces_after`."""
    slots: list[Node] = list(leaves)
    for k in range(len(steps) - 1, -1, -1):
        step = steps[k]
        right = slots.pop()
        split = step.split
        slots[step.piece] = Cut(normal_angles_of(split.normal), split.offset, 0.0, (), slots[step.piece], right)
    return slots[0]
