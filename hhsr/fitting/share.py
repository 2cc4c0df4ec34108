"""One budget over all leaves: uniform centres go where the next of them saves most (DESIGN §3)."""

from __future__ import annotations

import math

from hhsr.errors import FitError
from hhsr.fitting.options import FitOptions
from hhsr.fitting.source import Source
from hhsr.fitting.split import Part
from hhsr.fitting.uniform_field import LADDER, FieldFit, LeafRows, fit_field, leaf_rows
from hhsr.model import ModelLeaf

LEAST_FALL = 0.05
GOAL_SHARE = 0.8
ROWS_PER_CENTRE = 8
FILLING_STEPS = 7


class Ladder:
    """Fits of one leaf with ever more centres; each is made when it is asked for, and kept."""

    def __init__(self, leaf: ModelLeaf, part: Part, source: Source) -> None:
        self._leaf, self._part, self._source = leaf, part, source
        self._rows: dict[int, LeafRows] = {}
        self._fits: dict[int, FieldFit] = {}

    def fit(self, count: int) -> FieldFit:
        """Return the fit with `count` uniform centres on the sphere (those without data left out)."""
        if count not in self._fits:
            most = 4000 if ROWS_PER_CENTRE * count <= 4000 else 12_000
            if most not in self._rows:
                leaf = self._leaf
                self._rows[most] = leaf_rows(self._part, self._source, leaf.centre, leaf.rotation, most)
            self._fits[count] = fit_field(self._leaf, self._rows[most], count)
        return self._fits[count]


def shared_out(ladders: list[Ladder], options: FitOptions, fixed: int, fill: bool = True) -> list[FieldFit]:
    """Return a fit for each ladder, `fixed` numbers of the budget being spent elsewhere.

    With a budget: the step up some leaf's ladder that saves most mm³ per number is taken while it fits; what is left
    then makes all counts grow alike. Without one: each leaf climbs while a step lowers its error by 5 %, or until
    max_mean_error_mm and max_error_mm are met, or at 1,024 centres.

    Raises
    ------
    FitError : not even the bare superquadrics go into the budget.
    """
    if options.max_parameters is None:
        return [ladder.fit(_climbed(ladder, options)) for ladder in ladders]
    room = options.max_parameters - fixed - sum(ladder.fit(0).leaf.parameters for ladder in ladders)
    if room < 0:
        raise FitError(
            f"cuts and superquadrics take {options.max_parameters - room} numbers, max_parameters is "
            f"{options.max_parameters}; allow more, or cut less (a larger t1)"
        )
    counts = _bought(ladders, room)
    counts = _filled(ladders, counts, room) if fill else counts
    return [ladder.fit(count) for ladder, count in zip(ladders, counts, strict=True)]


def _climbed(ladder: Ladder, options: FitOptions) -> int:
    """Return the count at which further centres no longer pay, or the goals are met."""
    goals = options.max_mean_error_mm, options.max_error_mm
    mean, largest = (GOAL_SHARE * goal if goal is not None else math.inf for goal in goals)
    count = 0
    for step in LADDER:
        now = ladder.fit(count)
        if goals != (None, None):
            if now.mean_mm <= mean and now.max_mm <= largest:
                break
        elif count >= 32 and ladder.fit(step).mean_mm > (1.0 - LEAST_FALL) * now.mean_mm:
            break
        count = step
    return count


def _bought(ladders: list[Ladder], room: int) -> list[int]:
    """Return a count per ladder by steps of most saving per number."""
    counts = [0] * len(ladders)
    while True:
        best: tuple[float, int, int, int] | None = None
        for i, ladder in enumerate(ladders):
            now = ladder.fit(counts[i])
            # Two steps ahead: a small step that saves nothing must not hide a larger one that does.
            for step in [s for s in LADDER if s > counts[i]][:2]:
                if step > 4 * (room + 8):
                    break
                then = ladder.fit(step)
                cost = then.leaf.parameters - now.leaf.parameters
                saving = (now.area_error - then.area_error) / max(cost, 1)
                if cost <= room and saving > 0.0 and (best is None or saving > best[0]):
                    best = saving, i, step, cost
        if best is None:
            return counts
        _, i, counts[i], cost = best
        room -= cost


def _filled(ladders: list[Ladder], counts: list[int], room: int) -> list[int]:
    """Return the counts, all grown by the largest common factor that goes into the room."""
    base = sum(ladder.fit(0).leaf.parameters for ladder in ladders)
    best, low, high = counts, 1.0, 1.6
    for _ in range(FILLING_STEPS):
        factor = 0.5 * (low + high)
        grown = [int(c * factor) for c in counts]
        used = sum(ladder.fit(c).leaf.parameters for ladder, c in zip(ladders, grown, strict=True)) - base
        if used <= room:
            best, low = grown, factor
        else:
            high = factor
    return best
