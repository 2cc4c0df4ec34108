"""The default fit: cuts by look-ahead, centres by greed, one budget over everything (DESIGN §3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hhsr.errors import FitError
from hhsr.fitting.leaves import LEAF_NUMBERS, SCOUT, THOROUGH, Effort, Fitted, Workshop, fit_leaves
from hhsr.fitting.lookahead import WORST_POWER, Layout, Parting, best_split
from hhsr.fitting.normalise import on_grid, scaled
from hhsr.fitting.options import FitOptions
from hhsr.fitting.planes import settled
from hhsr.fitting.quantise import quantised
from hhsr.fitting.solid import solid_of
from hhsr.model import FloatArray, IntArray, Node

POSE_NUMBERS = 6
CUT_NUMBERS = 3
USUAL_NUMBERS = 1000
MOST_NUMBERS = 20_000
SAMPLES_A_NUMBER = 12
SAMPLES = (6_000, 40_000)
NUMBERS_A_PIECE = 16
MOST_PIECES = 32
PATIENCE = 4
EACH_UP_TO = 6
HIDDEN = 0.03
SPIKE = 10.0
MENDED = 2
PRUNED = 2
PRUNING_PAYS = 0.98


class Choice(NamedTuple):
    """A layout of planes, and the leaves fitted to its pieces."""

    layout: Layout
    fitted: Fitted

    @property
    def pieces(self) -> int:
        """How many there are."""
        return len(self.layout.pieces)

    @property
    def score(self) -> float:
        """What is to be as small as can be."""
        return self.fitted.score


def fit_default(vertices: FloatArray, faces: IntArray, options: FitOptions) -> Node:
    """Return the tree's root for a closed surface in its normalised frame.

    Parameters
    ----------
    vertices, faces : (n, 3) mm, (m, 3) closed outward triangles.
    options : `max_parameters` is kept; with `max_mean_error_mm` or `max_error_mm` no more is spent than they ask for;
        with neither, 1,000 numbers.

    Raises
    ------
    FitError : the budget cannot hold a pose and one leaf.
    """
    unit, size = on_grid(vertices, np.unique(faces))
    return quantised(scaled(_fit_unit(unit, faces, options, size), size))


def _fit_unit(vertices: FloatArray, faces: IntArray, options: FitOptions, size_mm: float) -> Node:
    """Return the tree's root for a surface whose longest side is 1, of a size in mm."""
    expected = options.max_parameters if options.max_parameters is not None else USUAL_NUMBERS
    samples = int(np.clip(SAMPLES_A_NUMBER * expected, *SAMPLES))
    solid = solid_of(vertices, faces, samples, options.seed)
    parting, workshop = Parting(solid), Workshop(solid)
    goals = options.max_mean_error_mm, options.max_error_mm
    mean, largest = (goal / size_mm if goal is not None else np.inf for goal in goals)
    if goals == (None, None):
        return _spent(workshop, parting, expected)[0]
    most = options.max_parameters if options.max_parameters is not None else MOST_NUMBERS
    budget = min(64, most)
    while True:
        node, fitted = _spent(workshop, parting, budget)
        if (fitted.mean <= mean and fitted.largest <= largest) or budget >= most:
            return node
        budget = min(budget + budget // 2, most)


def _spent(workshop: Workshop, parting: Parting, budget: int) -> tuple[Node, Fitted]:
    """Return the best tree within a budget of numbers, and how it fits."""
    if budget < POSE_NUMBERS + LEAF_NUMBERS:
        raise FitError(
            f"max_parameters: got {budget}, expected at least {POSE_NUMBERS + LEAF_NUMBERS}: a pose and one ellipsoid"
        )
    scouts = _scouts(workshop, parting, budget)
    best = _mended(workshop, min(scouts, key=lambda choice: choice.score), budget)
    best = _pruned(workshop, best, budget)
    fitted = _fit(workshop, best.layout, budget, THOROUGH)
    return best.layout.tree(fitted.leaves), fitted


def _mended(workshop: Workshop, best: Choice, budget: int) -> Choice:
    """Return the layout with cuts through the pieces of the largest misses, as long as that pays."""
    while best.fitted.largest > SPIKE * best.fitted.mean and best.pieces < budget // NUMBERS_A_PIECE:
        order = np.argsort(best.fitted.largests)[::-1][:MENDED]
        splits = [(int(k), best_split(workshop.solid, best.layout.pieces[k], WORST_POWER)) for k in order]
        layouts = [best.layout.split(k, split) for k, split in splits if split is not None]
        tried = [Choice(layout, _fit(workshop, layout, budget, SCOUT)) for layout in layouts]
        paying = [choice for choice in tried if choice.score < best.score]
        if not paying:
            break
        best = min(paying, key=lambda choice: choice.score)
    return best


def _pruned(workshop: Workshop, best: Choice, budget: int) -> Choice:
    """Return the layout without the lowest cuts that do not pay, as long as one is found."""
    while best.layout.planes:
        lowest = np.flatnonzero((best.layout.children < 0).all(axis=1))
        layouts = [best.layout.merged(workshop.solid, int(k)) for k in lowest]
        layouts.sort(key=lambda layout: sum(piece.misfit for piece in layout.pieces))
        tried = [Choice(layout, _fit(workshop, layout, budget, SCOUT)) for layout in layouts[:PRUNED]]
        better = min(tried, key=lambda choice: choice.score)
        if better.score >= PRUNING_PAYS * best.score:
            break
        best = better
    return best


def _scouts(workshop: Workshop, parting: Parting, budget: int) -> list[Choice]:
    """Return quick fits with one piece, two, … until more pieces stop to pay."""
    most = int(np.clip(budget // NUMBERS_A_PIECE, 1, MOST_PIECES))
    found: list[Choice] = []
    for count in range(1, most + 1):
        if not parting.grown(count):
            break
        if count < most and (_hopeless(parting, count) or (count > EACH_UP_TO and count % 2)):
            continue
        layout = settled(workshop.solid, parting.layout(count))
        found.append(Choice(layout, _fit(workshop, layout, budget, SCOUT)))
        best = min(found, key=lambda choice: choice.score)
        last = found[-1]
        if last.pieces - best.pieces >= PATIENCE or last.score > 1.5 * best.score:
            break
        if best is not last and best.fitted.unseen < 1e-3 and last.score > 1.05 * best.score:
            break
    return found


def _hopeless(parting: Parting, count: int) -> bool:
    """Return whether too much stays hidden that the next cut would show."""
    return (
        parting.hidden(count) > HIDDEN
        and parting.grown(count + 1)
        and parting.hidden(count + 1) < parting.hidden(count)
    )


def _fit(workshop: Workshop, layout: Layout, budget: int, effort: Effort) -> Fitted:
    """Return the fitted leaves of a layout's pieces."""
    numbers = budget - POSE_NUMBERS - CUT_NUMBERS * len(layout.planes)
    return fit_leaves(workshop, layout.pieces, numbers, effort)
