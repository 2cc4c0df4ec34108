"""Hard constraints: what rules a path out, each with its reason.

Cheap ones first; the clearances are asked only of what is left. A path that ends here never comes back by being
good at something else.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from guidance.budget import fit_error_range_mm, fit_errors_mm
from guidance.errors import SceneError
from guidance.needle import Array, Needle
from guidance.planning.candidates import Candidates
from guidance.scene import Scene, Structure

if TYPE_CHECKING:
    from hhsr import Shape

LENGTH, REGION, ANGLE, ENTERED_ONCE, TARGET = (
    "needle too short",
    "outside the entry region",
    "entry angle",
    "not entered exactly once",
    "target missed",
)
_LOOK_BEFORE_MM = 1.0  # entries lie on a mesh of the surface: start the check this far before them


def clearance_reason(name: str) -> str:
    """The name under which a structure's violated clearance is counted."""
    return f"clearance: {name}"


@dataclass(frozen=True, eq=False)
class Clearances:
    """Of the candidates that were asked: capsule clearance, what was needed, the fit error in it, where (n,), all mm.

    `measured` is exact only where `exact`; elsewhere it is an upper bound that already rules the path out.
    """

    measured: Array
    needed: Array
    fit_error: Array
    at_depth: Array
    exact: NDArray[np.bool_]


@dataclass(frozen=True, eq=False)
class Verdict:
    """What the constraints said: per reason the candidates (n,) it rules out, and the clearances per structure."""

    fails: dict[str, NDArray[np.bool_]]
    clearances: dict[str, Clearances] = field(default_factory=dict)

    @property
    def feasible(self) -> NDArray[np.bool_]:
        """Candidates that no constraint rules out."""
        return np.asarray(~np.any(np.stack(list(self.fails.values())), axis=0))


def judge(scene: Scene, candidates: Candidates) -> Verdict:
    """Test every candidate against every hard constraint.

    Raises
    ------
    SceneError
        If a structure to avoid has no model: no path can be called safe then.
    """
    missing = [s.name for s in scene.avoid if s.shape is None]
    if missing:
        raise SceneError(f"no path can be called safe: no model of {', '.join(missing)}")
    fails = _shape_free(scene, candidates)
    left = ~np.any(np.stack(list(fails.values())), axis=0)
    fails[ENTERED_ONCE] = np.zeros(len(candidates), dtype=bool)
    fails[ENTERED_ONCE][left] = ~_entered_once(scene, candidates, left)
    left &= ~fails[ENTERED_ONCE]
    clearances: dict[str, Clearances] = {}
    for s in scene.avoid:
        result = _clearances(scene, s, candidates, left)
        clearances[s.name] = result
        fails[clearance_reason(s.name)] = left & ~(result.measured >= result.needed)
    return Verdict(fails, clearances)


def _shape_free(scene: Scene, candidates: Candidates) -> dict[str, NDArray[np.bool_]]:
    """The constraints that need no shape: length, target, entry region, entry angle."""
    entry, depths = scene.entry, candidates.depths
    region = np.zeros(len(candidates), dtype=bool)
    if entry.near is not None:
        region = np.linalg.norm(candidates.entries - entry.near, axis=1) > entry.within_mm
    cosine = np.einsum("ij,ij->i", candidates.directions, candidates.inward)
    on_surface = np.isfinite(candidates.inward).all(axis=1)
    miss = np.linalg.norm(candidates.tips - scene.target.point, axis=1)
    return {
        LENGTH: ~((depths <= scene.needle.length_mm) & (depths > 1e-6)),
        TARGET: miss > scene.target.tolerance_mm + 1e-9,
        REGION: region,
        ANGLE: on_surface & ~(cosine >= np.cos(np.radians(entry.max_angle_deg))),
    }


def _entered_once(scene: Scene, candidates: Candidates, which: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Whether the whole needle, hub to tip, crosses the entered structure's surface once, inwards."""
    count = int(which.sum())
    if scene.entry.structure is None or count == 0:
        return np.ones(count, dtype=bool)
    shape = scene.structure(scene.entry.structure).shape
    if shape is None:
        raise SceneError(f"structure {scene.entry.structure!r} has no model, so it cannot be entered")
    directions, tips = candidates.directions[which], candidates.tips[which]
    outside = np.maximum(scene.needle.length_mm, candidates.depths[which] + _LOOK_BEFORE_MM)
    crossings = shape.crossings(tips - outside[:, None] * directions, tips)
    number = np.diff(crossings.offsets)
    first = np.minimum(crossings.offsets[:-1], max(len(crossings.entering) - 1, 0))
    inwards = crossings.entering[first] if len(crossings.entering) else np.zeros(count, dtype=bool)
    return np.asarray((number == 1) & inwards)


def _clearances(scene: Scene, structure: Structure, candidates: Candidates, which: NDArray[np.bool_]) -> Clearances:
    shape, needle, n = structure.shape, scene.needle, len(candidates)
    assert shape is not None  # judged before
    fixed = structure.margin_mm + scene.errors.without_fit_mm
    measured, fit_error, depth = np.full(n, np.nan), np.full(n, np.nan), np.full(n, np.nan)
    exact = np.zeros(n, dtype=bool)
    index = np.flatnonzero(which)
    tips, directions = candidates.tips[index], candidates.directions[index]
    hubs = needle.hub(tips, directions)
    least = fit_error_range_mm(shape, scene.errors.fit)[0]
    bound = _upper_bound(shape, hubs, tips, fixed + least, needle)
    measured[index], fit_error[index] = bound, least
    keep = bound >= fixed + least
    index, hubs, tips = index[keep], hubs[keep], tips[keep]
    if len(index):
        near = shape.closest_approach(hubs, tips, needle.radius_mm)
        measured[index], exact[index] = near.clearance, True
        fit_error[index] = fit_errors_mm(shape, near.on_surface, scene.errors.fit)
        depth[index] = (near.t - 1.0) * needle.length_mm + candidates.depths[index]
    return Clearances(measured, fixed + fit_error, fit_error, depth, exact)


def _upper_bound(shape: Shape, hubs: Array, tips: Array, needed: float, needle: Needle) -> Array:
    """Upper bounds (n,) of the capsule clearance, mm, good enough to rule out most of what must be ruled out.

    The distance at any point of the axis is an upper bound, so a few points per needle (1, then 2, 4, 8 between
    them) settle most without one search for the true minimum. What stays undecided comes back as a bound ≥ needed.
    """
    bound = np.full(len(hubs), np.inf)
    for level in range(4):
        open_ = np.flatnonzero(bound >= needed)
        if not len(open_):
            break
        shares = 1.0 - (np.arange(2**level) + 0.5) / 2**level * 0.8  # the fifth at the hub is hardly ever the nearest
        points = hubs[open_, None] + shares[:, None] * (tips - hubs)[open_, None]
        nearest = shape.signed_distance(points).min(axis=1) - needle.radius_mm
        bound[open_] = np.minimum(bound[open_], nearest)
    return bound
