"""What makes one safe path better than another: a few numbers, all "less is better", summed by stated weights."""

from __future__ import annotations

from collections.abc import Mapping
from math import erfc, sqrt

import numpy as np
from numpy.typing import NDArray

from guidance.budget import ErrorBudget
from guidance.needle import Array
from guidance.planning.candidates import Candidates
from guidance.planning.constraints import Verdict
from guidance.scene import Scene

SURPLUS_SCALE_MM = 3.0  # a surplus of 3 mm over what is needed is worth e times less worry than none
WEIGHTS: Mapping[str, float] = {"clearance": 1.0, "depth": 0.5, "angle": 0.25}


def cost_terms(scene: Scene, candidates: Candidates, verdict: Verdict, index: NDArray[np.intp]) -> dict[str, Array]:
    """The unweighted cost terms (m,) of the candidates in `index`.

    clearance: Σ over structures of exp(−surplus / 3 mm); depth: share of the needle's length; angle: 1 − cosine of
    the angle to the entered surface's inward normal (0 where the entry is not on a surface).
    """
    clearance = np.zeros(len(index))
    for found in verdict.clearances.values():
        clearance += np.exp(-(found.measured - found.needed)[index] / SURPLUS_SCALE_MM)
    cosine = np.einsum("ij,ij->i", candidates.directions[index], candidates.inward[index])
    return {
        "clearance": clearance,
        "depth": candidates.depths[index] / scene.needle.length_mm,
        "angle": np.nan_to_num(1.0 - cosine, nan=0.0),
    }


def total_cost(terms: Mapping[str, Array]) -> Array:
    """The weighted sum (m,)."""
    return np.asarray(sum(WEIGHTS[name] * values for name, values in terms.items()))


def pareto_front(terms: Mapping[str, Array]) -> NDArray[np.bool_]:
    """Which candidates (m,) no other one beats in every term."""
    table = np.stack(list(terms.values()), axis=1)
    front = np.ones(len(table), dtype=bool)
    for i, row in enumerate(table):
        front[i] = not np.any(np.all(table <= row, axis=1) & np.any(table < row, axis=1))
    return front


def touch_probability(clearance_mm: float, fit_error_mm: float, errors: ErrorBudget) -> float:
    """Chance that the true gap is gone: the budget's parts as independent standard deviations along the gap."""
    spread = sqrt(fit_error_mm**2 + errors.registration_mm**2 + errors.tracker_mm**2 + errors.bending_mm**2)
    if spread == 0.0:
        return float(clearance_mm <= 0.0)
    return 0.5 * erfc(clearance_mm / spread / sqrt(2.0))
