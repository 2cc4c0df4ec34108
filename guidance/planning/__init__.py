"""From a scene to ranked safe paths: candidates → hard constraints, each rejection with its reason → costs."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from guidance.needle import Array
from guidance.planning.candidates import Candidates, aim_offsets, make_candidates
from guidance.planning.constraints import Clearances, Verdict, clearance_reason, judge
from guidance.planning.costs import WEIGHTS, cost_terms, pareto_front, total_cost, touch_probability
from guidance.planning.plans import PathClearance, Plan, Plans, Rejection
from guidance.scene import Scene
from guidance.trajectory import Trajectory

__all__ = ["PathClearance", "Plan", "Plans", "Rejection", "plan"]


def plan(scene: Scene) -> Plans:
    """Plan straight needles to the scene's target.

    Every entry is first aimed at the target point itself; only where none of these is safe are six other points
    within the target's tolerance tried too.

    Parameters
    ----------
    scene : Scene

    Returns
    -------
    Plans
        Ranked, best first; empty where no path is safe, and then `why_none` says which constraint forbids them.

    Raises
    ------
    SceneError
        If a structure to avoid, or the one to be entered, has no model.
    """
    candidates = make_candidates(scene, np.zeros((1, 3)))
    verdict = judge(scene, candidates) if len(candidates) else None
    if verdict is not None and not verdict.feasible.any() and scene.target.tolerance_mm > 0.0:
        candidates = make_candidates(scene, np.concatenate([np.zeros((1, 3)), aim_offsets(scene.target.tolerance_mm)]))
        verdict = judge(scene, candidates)
    if verdict is None:
        return _plans(scene, candidates, (), (), {}, {})
    return _account(scene, candidates, verdict)


def _account(scene: Scene, candidates: Candidates, verdict: Verdict) -> Plans:
    fails = {reason: mask for reason, mask in verdict.fails.items() if mask.any()}
    table = np.stack(list(fails.values())) if fails else np.zeros((0, len(candidates)), dtype=bool)
    counts = table.sum(axis=0)
    rejections = dict(sorted(((r, int(m.sum())) for r, m in fails.items()), key=lambda item: -item[1]))
    only = {r: int((m & (counts == 1)).sum()) for r, m in fails.items()}
    only = dict(sorted(((r, n) for r, n in only.items() if n), key=lambda item: -item[1]))
    ranked = _ranked(scene, candidates, verdict)
    return _plans(scene, candidates, ranked, _rejected(scene, candidates, verdict), rejections, only)


def _plans(
    scene: Scene,
    candidates: Candidates,
    ranked: tuple[Plan, ...],
    rejected: tuple[Rejection, ...],
    rejections: dict[str, int],
    only: dict[str, int],
) -> Plans:
    needed = {s.name: s.margin_mm + scene.errors.without_fit_mm for s in scene.avoid}
    return Plans(
        scene.name, scene.hash, scene.errors, needed, len(candidates), ranked, rejected, rejections, only, WEIGHTS
    )


def _ranked(scene: Scene, candidates: Candidates, verdict: Verdict) -> tuple[Plan, ...]:
    index = np.flatnonzero(verdict.feasible)
    if not len(index):
        return ()
    terms = cost_terms(scene, candidates, verdict, index)
    cost, front = total_cost(terms), pareto_front(terms)
    order = np.lexsort((index, cost))
    plans = []
    for rank, k in enumerate(order, start=1):
        i = int(index[k])
        clearances = {n: _path_clearance(scene, found, i) for n, found in verdict.clearances.items()}
        trajectory = Trajectory(candidates.entries[i], candidates.tips[i])
        miss = float(np.linalg.norm(trajectory.tip - scene.target.point))
        costs = {name: float(WEIGHTS[name] * values[k]) for name, values in terms.items()}
        plans.append(Plan(rank, trajectory, clearances, costs, float(cost[k]), bool(front[k]), miss))
    return tuple(plans)


def _path_clearance(scene: Scene, found: Clearances, i: int) -> PathClearance:
    clearance, fit_error = float(found.measured[i]), float(found.fit_error[i])
    probability = touch_probability(clearance, fit_error, scene.errors)
    return PathClearance(clearance, float(found.needed[i]), fit_error, float(found.at_depth[i]), probability)


def _rejected(scene: Scene, candidates: Candidates, verdict: Verdict) -> tuple[Rejection, ...]:
    """The refused paths, those that came closest to being safe first."""
    index = np.flatnonzero(~verdict.feasible)
    order = np.lexsort((index, _shortfall(verdict, index)))
    return tuple(_rejection(scene, candidates, verdict, int(index[k])) for k in order)


def _shortfall(verdict: Verdict, index: NDArray[np.intp]) -> Array:
    """The largest missing clearance (m,), mm; inf where something else is wrong."""
    worst = np.zeros(len(index))
    for reason, mask in verdict.fails.items():
        if not reason.startswith(clearance_reason("")):
            worst = np.where(mask[index], np.inf, worst)
    for found in verdict.clearances.values():
        worst = np.fmax(worst, (found.needed - found.measured)[index])
    return worst


def _rejection(scene: Scene, candidates: Candidates, verdict: Verdict, i: int) -> Rejection:
    reasons = tuple(reason for reason, mask in verdict.fails.items() if mask[i])
    details = []
    for name, found in verdict.clearances.items():
        if clearance_reason(name) in reasons:
            sign = "" if found.exact[i] else "at most "
            details.append(f"{name}: {sign}{found.measured[i]:.2f} mm of the {found.needed[i]:.2f} mm needed")
    if candidates.depths[i] > scene.needle.length_mm:
        details.append(f"depth {candidates.depths[i]:.1f} mm, the needle has {scene.needle.length_mm:.1f} mm")
    path = Trajectory(candidates.entries[i], candidates.tips[i]) if candidates.depths[i] > 1e-6 else None
    return Rejection(path, reasons, tuple(details))
