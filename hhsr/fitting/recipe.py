"""The default fit: cuts by look-ahead, centres by greed, one budget over everything (DESIGN §3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hhsr.errors import FitError
from hhsr.fitting.aim import aim_of
from hhsr.fitting.base import ANY, TURNED
from hhsr.fitting.goals import enough
from hhsr.fitting.keep import affordable
from hhsr.fitting.leaves import LEAF_NUMBERS, SCOUT, THOROUGH, Effort, Fitted, Workshop, fit_leaves
from hhsr.fitting.lookahead import WORST_POWER, Layout, Parting, Split, best_split
from hhsr.fitting.normalise import on_grid, scaled
from hhsr.fitting.options import FitOptions
from hhsr.fitting.planes import settled
from hhsr.fitting.quantise import quantised
from hhsr.fitting.solid import solid_of
from hhsr.fitting.threads import in_threads
from hhsr.model import FloatArray, IntArray, Node, RetainedPart

KINDS = {"ellipsoid": (), "turned": TURNED, "any": ANY}
POSE_NUMBERS = 6
CUT_NUMBERS = 3
USUAL_NUMBERS = 1000
SAMPLES_A_NUMBER = 12
SAMPLES = (6_000, 40_000)
NUMBERS_A_PIECE = 16
MOST_PIECES = 32
PATIENCE = 4
EACH_UP_TO = 6
HIDDEN = 0.03
SPIKE = 12.0
MENDED = 2
PRUNED = 2
FINALISTS = 2
NEARLY = 1.1
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
    aim = aim_of(options.max_error_weight)

    def fitted(budget: int) -> Node:
        samples = int(np.clip(SAMPLES_A_NUMBER * budget, *SAMPLES))
        solid = solid_of(unit, faces, samples, options.seed)
        return quantised(scaled(_spent(Workshop(solid, aim, KINDS[options.bases]), budget, size), size))

    if options.max_mean_error_mm is None and options.max_error_mm is None:
        return fitted(options.max_parameters if options.max_parameters is not None else USUAL_NUMBERS)
    return enough(fitted, vertices, faces, options)


def _spent(workshop: Workshop, budget: int, size_mm: float) -> Node:
    """Return the best tree within a budget of numbers. size_mm: of the solid's unit."""
    if budget < POSE_NUMBERS + LEAF_NUMBERS:
        raise FitError(
            f"max_parameters: got {budget}, expected at least {POSE_NUMBERS + LEAF_NUMBERS}: a pose and one ellipsoid"
        )
    parting = Parting(workshop.solid)
    if whole := affordable(workshop.solid, parting.pieces(1), budget - POSE_NUMBERS, size_mm):
        return whole[0]
    scouts = sorted(_scouts(workshop, parting, budget), key=lambda choice: choice.score)
    near = [choice for choice in scouts[:FINALISTS] if choice.score <= NEARLY * scouts[0].score]
    mended = [_mended(workshop, choice, budget) for choice in near]
    better = [
        _pruned(workshop, after, budget, len(before.layout.planes)) for before, after in zip(near, mended, strict=True)
    ]
    finalists = [Choice(choice.layout, _fit(workshop, choice.layout, budget, THOROUGH)) for choice in better]
    best = min(finalists, key=lambda choice: choice.score)
    return best.layout.tree(_kept(workshop, best, budget, size_mm))


def _kept(workshop: Workshop, best: Choice, budget: int, size_mm: float) -> list[Node]:
    """Return the leaves, those kept as triangles whose numbers, spent on others, make the whole better."""
    numbers, pieces = _numbers(best.layout, budget), best.layout.pieces
    parts = affordable(workshop.solid, pieces, numbers - LEAF_NUMBERS * (best.pieces - 1), size_mm)
    leaves: list[Node] = list(best.fitted.leaves)
    kept: dict[int, RetainedPart] = {}
    score = best.score
    for k in sorted(parts, key=lambda k: parts[k].parameters):
        tried = {**kept, k: parts[k]}
        rest = [i for i in range(best.pieces) if i not in tried]
        room = numbers - sum(part.parameters for part in tried.values())
        if not rest or room < LEAF_NUMBERS * len(rest):
            continue
        fitted = fit_leaves(workshop, [pieces[i] for i in rest], room, THOROUGH)
        share = sum(pieces[i].members.size for i in rest) / len(workshop.solid.samples.points)
        if (after := share * fitted.mean + workshop.aim.worst * fitted.largest) < score:
            kept, score = tried, after
            for i, leaf in zip(rest, fitted.leaves, strict=True):
                leaves[i] = leaf
            leaves[k] = parts[k]
    return leaves


def _mended(workshop: Workshop, best: Choice, budget: int) -> Choice:
    """Return the layout with cuts through the pieces of the largest misses, as long as that pays."""
    while best.fitted.largest > SPIKE * best.fitted.mean and best.pieces < budget // NUMBERS_A_PIECE:
        order = np.argsort(best.fitted.largests)[::-1][:MENDED]
        better = _best_of(workshop, _mends(workshop, best, order), budget, best)
        if better is None or better.score >= best.score:
            break
        best = better
    return best


def _mends(workshop: Workshop, choice: Choice, order: IntArray) -> list[Layout]:
    """Return layouts with a piece cut for its largest miss: by look-ahead on squares, and for the spot where it is."""
    layout, spots = choice.layout, choice.fitted.spots
    ways = [(int(k), power, spot) for k in order for power, spot in ((WORST_POWER, None), (1.0, spots[k]))]

    def cut(at: int) -> Split | None:
        piece, power, spot = ways[at]
        return best_split(workshop.solid, layout.pieces[piece], power, spot)

    splits = in_threads(cut, len(ways))
    return [layout.split(way[0], split) for way, split in zip(ways, splits, strict=True) if split is not None]


def _pruned(workshop: Workshop, best: Choice, budget: int, mended: int) -> Choice:
    """Return the layout without the lowest cuts that do not pay, as long as one is found.

    mended: the first cut that was made for a largest miss: it has just paid.
    """
    while best.layout.planes:
        lowest = [k for k in np.flatnonzero((best.layout.children < 0).all(axis=1)) if k < mended]
        layouts = [best.layout.merged(workshop.solid, int(k)) for k in lowest]
        layouts.sort(key=lambda layout: sum(piece.misfit for piece in layout.pieces))
        better = _best_of(workshop, layouts[:PRUNED], budget, best)
        if better is None or better.score >= PRUNING_PAYS * best.score:
            break
        best, mended = better, mended - 1
    return best


def _best_of(workshop: Workshop, layouts: list[Layout], budget: int, rival: Choice) -> Choice | None:
    """Return the layout whose quick fit is the best one; those far behind a rival are given up half way."""
    workshop.prepared([piece for layout in layouts for piece in layout.pieces], SCOUT.stride)
    fits = in_threads(lambda k: _fit(workshop, layouts[k], budget, SCOUT, rival.fitted), len(layouts))
    tried = [Choice(layout, fitted) for layout, fitted in zip(layouts, fits, strict=True)]
    return min(tried, key=lambda choice: choice.score, default=None)


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
        rival = min(found, key=lambda choice: choice.score).fitted if found else None
        found.append(Choice(layout, _fit(workshop, layout, budget, SCOUT, rival)))
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


def _fit(workshop: Workshop, layout: Layout, budget: int, effort: Effort, rival: Fitted | None = None) -> Fitted:
    """Return the fitted leaves of a layout's pieces."""
    return fit_leaves(workshop, layout.pieces, _numbers(layout, budget), effort, rival)


def _numbers(layout: Layout, budget: int) -> int:
    """Return how many numbers of a budget a layout leaves to its leaves."""
    return budget - POSE_NUMBERS - CUT_NUMBERS * len(layout.planes)
