"""Refinement of a leaf on what it truly misses: half axes, centre and weights together (DESIGN §3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hhsr.fitting.rows import GRAZING, Rows
from hhsr.fitting.samples import turned_fibonacci
from hhsr.fitting.scale_field import RIDGE, ellipsoid_radii, leaf_of
from hhsr.fitting.solid import Region, Solid
from hhsr.kernels.refinement import chosen_rows, field_values, normal_equations
from hhsr.kernels.selection import solve_normal
from hhsr.model import MAX_SCALE, FloatArray, IntArray, ModelLeaf, ScaleField

RAYS = 2500
BOUND_RAYS = 8000
FARTHEST_HINT = 1.5
SLACK_OF_DEPTH = 0.3
SLACK_OF_REACH = 0.1
MOST_URGENT = 5.0
HINT = 0.3
HOLD = 0.1
AXES = 0.0


class Task(NamedTuple):
    """What one leaf has to tell: its region, its samples, and its rays as seen from its centre.

    points, normals: (n, 3) of its samples. directions: (r, 3) rays; through: (r,) bool, which of them leave the region
    inside the solid; reach: (r,) mm to the plane for those, bound: (r,) what ρ has to be at least, urgency: (r,) by how
    much a miss there counts more. sample_area: mm² of a sample.
    """

    region: Region
    points: FloatArray
    normals: FloatArray
    directions: FloatArray
    through: FloatArray
    bound: FloatArray
    urgency: FloatArray
    hint: FloatArray
    seen: FloatArray


class Misses(NamedTuple):
    """n rows of what a leaf misses: miss (n,) mm, its slopes by ρ and by the centre (n, 3), squared weight (n,) ≥ 0."""

    directions: FloatArray
    miss: FloatArray
    slope: FloatArray
    shift: FloatArray
    weight: FloatArray


def task_of(solid: Solid, region: Region, members: IntArray, centre: FloatArray, seed: int) -> Task:
    """Return a leaf's task as seen from its centre."""
    free = _rays(solid, region, centre, RAYS, seed)
    behind = _rays(solid, region, centre, BOUND_RAYS, seed + 1)
    directions, reach, cosine, hit, _ = (
        np.concatenate([a[~free.through], b[behind.through]]) for a, b in zip(free, behind, strict=True)
    )
    through = np.arange(reach.size) >= int((~free.through).sum())
    bound, urgency, hint = np.zeros(reach.size), np.zeros(reach.size), np.zeros(reach.size)
    if through.any():
        ends = centre + reach[through, None] * directions[through]
        depth = solid.triangles.closest(ends)[0]
        room = 0.5 * (hit - reach)[through]
        slack = np.minimum(np.minimum(SLACK_OF_DEPTH * depth, SLACK_OF_REACH * reach[through]), room)
        bound[through] = reach[through] + slack
        urgency[through] = np.minimum(depth / np.maximum(slack, 1e-9 * solid.size), MOST_URGENT)
        urgency[through] *= np.sqrt(np.maximum(cosine[through], GRAZING))
        hint[through] = np.minimum(hit[through], FARTHEST_HINT * reach[through])
    points, normals = solid.samples.points[members], solid.samples.normals[members]
    offset = points - centre
    radii = np.sqrt((offset**2).sum(axis=1))
    along = offset / np.maximum(radii, 1e-12)[:, None]
    first, _ = solid.triangles.first_hit(np.broadcast_to(centre, along.shape), along)
    seen = (np.einsum("ni,ni->n", along, normals) > 0.0) & ~(first < radii * (1.0 - 1e-6) - 1e-6 * solid.size)
    return Task(region, points, normals, directions, through, bound, urgency, hint, seen)


def hold_rows(task: Task, solid: Solid, half_axes: FloatArray) -> Rows:
    """Return rows, weak, that keep the leaf at its base, or at the bound, where nothing else tells it anything.

    Without them the centres chosen for the surface beside a cut swing freely behind the cut, and open voids there.
    """
    t = task.through
    wanted = np.maximum(ellipsoid_radii(half_axes, task.directions[t]), task.bound[t])
    weight = HOLD * np.sqrt(4.0 * np.pi / BOUND_RAYS / solid.sample_area) * task.bound[t]
    return Rows(task.directions[t], wanted, weight, np.zeros(int(t.sum()), dtype=bool))


class _Rays(NamedTuple):
    """Rays: (n, 3) directions, (n,) mm to the region's end, cosine there, mm to the first hit, whether through."""

    directions: FloatArray
    reach: FloatArray
    cosine: FloatArray
    hit: FloatArray
    through: FloatArray


def _rays(solid: Solid, region: Region, centre: FloatArray, count: int, seed: int) -> _Rays:
    """Cast rays; `through` tells which leave the region inside the solid."""
    directions = turned_fibonacci(count, seed)
    reach, cosine = region.exits(centre, directions)
    hit, _ = solid.triangles.first_hit(np.broadcast_to(centre, directions.shape), directions)
    return _Rays(directions, reach, cosine, hit, np.isfinite(reach) & (hit > reach))


def start_rows(task: Task, solid: Solid, centre: FloatArray) -> Rows:
    """Return the rows before anything is fitted: the samples in sight, the bounds."""
    offset = task.points[task.seen] - centre
    radii = np.sqrt((offset**2).sum(axis=1))
    along = offset / radii[:, None]
    weights = np.maximum(np.einsum("ni,ni->n", along, task.normals[task.seen]), GRAZING)
    share = np.sqrt(4.0 * np.pi / BOUND_RAYS / solid.sample_area)
    t = task.through
    return Rows(along, radii, weights, np.zeros(radii.size, dtype=bool)).joined(
        Rows(
            task.directions[t],
            task.bound[t],
            share * task.bound[t] * task.urgency[t],
            np.ones(int(t.sum()), dtype=bool),
        )
    )


def misses(task: Task, solid: Solid, leaf: ModelLeaf, radius: RadiusOf, power: float, held: bool = True) -> Misses:
    """Return what a leaf misses, both ways: samples that it should meet, its own points that should lie on the source.

    power: of the misses whose sum is to fall (2: least squares, 1: their mean). held: with the weak rows behind cuts.
    """
    share, behind = (4.0 * np.pi / count / solid.sample_area for count in (RAYS, BOUND_RAYS))
    offset = task.points[task.seen] - leaf.centre
    r = np.sqrt((offset**2).sum(axis=1))
    along = offset / r[:, None]
    slope = np.maximum(np.einsum("ni,ni->n", along, task.normals[task.seen]), GRAZING)
    rho = radius(along)
    own = slope * (rho - r)

    t = task.through
    fell = radius(task.directions[t]) - task.bound[t]
    fell_weight = np.where(fell < 0.0, behind * (task.bound[t] * task.urgency[t]) ** 2, 0.0)

    free = task.directions[~t]
    reach = radius(free)
    ends = leaf.centre + reach[:, None] * free
    within = task.region.holds(ends)
    free, reach, ends = free[within], reach[within], ends[within]
    distance, nearest, face = solid.triangles.closest(ends)
    corner = solid.vertices[solid.faces[face]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.sqrt((normal**2).sum(axis=1)), 1e-300)[:, None]
    side = np.sign(np.einsum("ni,ni->n", ends - nearest, normal))
    outward = np.where(
        (distance > 1e-6 * solid.size)[:, None],
        side[:, None] * (ends - nearest) / np.maximum(distance, 1e-300)[:, None],
        normal,
    )
    steep = np.einsum("ni,ni->n", outward, free)
    away = side * distance
    weight = share * reach**2 / np.maximum(np.abs(steep), GRAZING)
    steep = np.where(np.abs(steep) < GRAZING, np.copysign(GRAZING, steep), steep)

    base = np.maximum(ellipsoid_radii(leaf.superquadric.half_axes, task.directions[t]), task.bound[t])
    held_miss = fell + task.bound[t] - base
    held_weight = np.where(fell < 0.0, 0.0, behind * (HOLD * task.bound[t]) ** 2)
    fell = np.where(fell < 0.0, fell, held_miss)
    fell_weight = np.maximum(fell_weight, held_weight) if held else fell_weight
    miss = np.concatenate([own, away])
    typical = max(float(np.abs(miss).mean()), 1e-9 * solid.size)
    robust = np.maximum(np.abs(miss) / typical, 0.5) ** (power - 2.0)
    weights = np.concatenate([np.ones(own.size), weight]) * robust
    return Misses(
        np.concatenate([along, free, task.directions[t]]),
        np.concatenate([miss, fell]),
        np.concatenate([slope, steep, np.ones(fell.size)]),
        np.concatenate([task.normals[task.seen], outward, np.zeros((fell.size, 3))]),
        np.concatenate([weights, fell_weight]),
    )


def as_rows(found: Misses, rho: FloatArray) -> Rows:
    """Return the rows that ask a leaf of radii rho to mend its misses."""
    kept = found.weight > 0.0
    wanted = rho - found.miss / found.slope
    weights = np.sqrt(found.weight) * np.abs(found.slope)
    return Rows(found.directions[kept], wanted[kept], weights[kept], np.zeros(int(kept.sum()), dtype=bool))


class RadiusOf:
    """The radius of a leaf on its axes, with what its slopes are made of."""

    def __init__(self, leaf: ModelLeaf) -> None:
        self.leaf = leaf
        index = leaf.scale_field.index
        grid = leaf.scale_field.grid
        self.centres = np.ascontiguousarray(grid.centres[index]) if index.size else np.zeros((0, 3))
        self.extents = grid.extents[index] if index.size else np.zeros(0)

    def __call__(self, directions: FloatArray) -> FloatArray:
        """Return (n,) radii, mm."""
        rows = chosen_rows(np.ascontiguousarray(directions), self.centres, self.extents)
        s = np.minimum(field_values(*rows, np.asarray(self.leaf.scale_field.weights)), MAX_SCALE)
        return (1.0 - s) * ellipsoid_radii(self.leaf.superquadric.half_axes, directions)


def hint_rows(task: Task, solid: Solid) -> Rows:
    """Return where the rays that pass the plane leave the solid: a base that knows it passes without a kink."""
    t = task.through
    weight = HINT * np.sqrt(4.0 * np.pi / BOUND_RAYS / solid.sample_area) * task.hint[t]
    return Rows(task.directions[t], task.hint[t], weight, np.zeros(int(t.sum()), dtype=bool))


def mending_rows(solid: Solid, task: Task, leaf: ModelLeaf, power: float = 2.0) -> Rows:
    """Return the rows that ask for a leaf like this one without its misses."""
    radius = RadiusOf(leaf)
    found = misses(task, solid, leaf, radius, power)
    return as_rows(found, radius(found.directions))


class Figures(NamedTuple):
    """Sum of what a leaf misses, mm · samples, half of either way; the largest miss, mm; how many samples it hides."""

    total: float
    largest: float
    unseen: int


def figures(solid: Solid, task: Task, leaf: ModelLeaf) -> Figures:
    """Return how a leaf fits; samples that its centre does not see count by their distance along the ray."""
    radius = RadiusOf(leaf)
    found = misses(task, solid, leaf, radius, 2.0, held=False)
    unseen = task.points[~task.seen] - leaf.centre
    r = np.sqrt((unseen**2).sum(axis=1))
    hidden = np.abs(radius(unseen / np.maximum(r, 1e-12)[:, None]) - r)
    miss = np.abs(found.miss)
    total = 0.5 * (float((miss * found.weight).sum()) + float(hidden.sum()))
    largest = max(float(miss[found.weight > 0.0].max(initial=0.0)), float(hidden.max(initial=0.0)))
    return Figures(total, largest, r.size)


def improved(solid: Solid, task: Task, leaf: ModelLeaf, steps: int, power: float) -> ModelLeaf:
    """Return the leaf after some Gauss-Newton steps on its misses, its centre fixed."""
    found = misses(task, solid, leaf, RadiusOf(leaf), power)
    for _ in range(steps):
        tried = _step(found, leaf, RadiusOf(leaf), solid.size, False)
        after = misses(task, solid, tried, RadiusOf(tried), power)
        if cost(after) >= cost(found):
            break
        leaf, found = tried, after
    return leaf


def cost(found: Misses) -> float:
    """Return the weighted sum of squares."""
    return float((found.weight * found.miss**2).sum())


def _step(found: Misses, leaf: ModelLeaf, radius: RadiusOf, size: float, moving: bool) -> ModelLeaf:
    """Return the leaf after one damped Gauss-Newton step."""
    field = leaf.scale_field
    axes = np.asarray(leaf.superquadric.half_axes)
    u = np.ascontiguousarray(found.directions)
    pointer, index, value = chosen_rows(u, radius.centres, radius.extents)
    s = np.minimum(field_values(pointer, index, value, np.asarray(field.weights)), MAX_SCALE)
    q = ellipsoid_radii(axes, u)
    seen = np.where(u >= 0.0, axes[0::2], axes[1::2])
    by_axis = (found.slope * (1.0 - s) * q**3)[:, None] * (u / seen) ** 2 * AXES
    dense = np.zeros((u.shape[0], 9 if moving else 6))
    for axis in range(3):
        positive = u[:, axis] >= 0.0
        dense[positive, 2 * axis] = by_axis[positive, axis]
        dense[~positive, 2 * axis + 1] = by_axis[~positive, axis]
    if moving:
        dense[:, 6:] = found.shift
    count = field.weights.size
    slope = np.where(s < MAX_SCALE, -found.slope * q, 0.0)
    matrix, right = normal_equations(pointer, index, value, slope, dense, found.miss, found.weight, count)
    diagonal = np.diag(matrix)
    floor = RIDGE * float(diagonal[:count].mean()) if count else 0.0
    damping = np.concatenate([np.full(count, floor), 1e-3 * diagonal[count:] + 1e-12 * (1.0 + diagonal[count:].max())])
    right[:count] -= floor * np.asarray(field.weights)
    change = solve_normal(matrix + np.diag(damping), right)
    moved = np.asarray(field.weights) + change[:count]
    new_axes = axes * np.exp(np.clip(change[count : count + 6], -0.2, 0.2))
    centre = np.asarray(leaf.centre)
    if moving:
        centre = centre + np.clip(change[count + 6 :], -0.02 * size, 0.02 * size)
    return leaf_of(centre, new_axes, ScaleField(field.grid, field.index, moved))
