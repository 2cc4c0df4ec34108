"""Refinement of a leaf on what it truly misses, both ways: its half axes and all its weights together (DESIGN §3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hhsr.fitting.rows import GRAZING, Rows
from hhsr.fitting.scale_field import RIDGE, ellipsoid_radii, leaf_of
from hhsr.fitting.solid import Solid
from hhsr.fitting.task import BOUND_RAYS, HOLD, RAYS, Task, polar, ray_share
from hhsr.kernels.refinement import chosen_rows, field_values, normal_equations
from hhsr.kernels.selection import solve_normal
from hhsr.model import MAX_SCALE, FloatArray, ModelLeaf, ScaleField

AXES_DAMPING = 1e-3
LONGEST_STEP = 0.2


class Misses(NamedTuple):
    """n rows of what a leaf misses: (n, 3) directions, signed miss (n,) mm, its slope by ρ, squared weight (n,) ≥ 0."""

    directions: FloatArray
    miss: FloatArray
    slope: FloatArray
    weight: FloatArray

    @property
    def cost(self) -> float:
        """The weighted sum of squares, mm²."""
        return float((self.weight * self.miss**2).sum())


class Figures(NamedTuple):
    """Sum of what a leaf misses, mm · samples, half of either way; the largest miss, mm; how many samples it hides."""

    total: float
    largest: float
    unseen: int


class Leaf:
    """A leaf on the tree's axes, with the arrays that its radii and their slopes are made of."""

    def __init__(self, leaf: ModelLeaf) -> None:
        self.model = leaf
        self.half_axes = np.asarray(leaf.superquadric.half_axes)
        self.weights = np.asarray(leaf.scale_field.weights)
        grid, index = leaf.scale_field.grid, leaf.scale_field.index
        self.centres = np.ascontiguousarray(grid.centres[index]) if index.size else np.zeros((0, 3))
        self.extents = grid.extents[index] if index.size else np.zeros(0)

    def radius(self, directions: FloatArray) -> FloatArray:
        """Return (n,) radii, mm."""
        pointer, index, value = chosen_rows(np.ascontiguousarray(directions), self.centres, self.extents)
        s = np.minimum(field_values(pointer, index, value, self.weights), MAX_SCALE)
        radii: FloatArray = (1.0 - s) * ellipsoid_radii(self.half_axes, directions)
        return radii


def improved(solid: Solid, task: Task, leaf: ModelLeaf, steps: int, power: float) -> ModelLeaf:
    """Return the leaf after some Gauss-Newton steps on its misses, as long as they fall.

    power: of the misses whose sum is to fall (2: least squares, 1: their mean).
    """
    found = misses(task, solid, Leaf(leaf), power)
    for _ in range(steps):
        tried = _step(found, Leaf(leaf))
        after = misses(task, solid, Leaf(tried), power)
        if after.cost >= found.cost:
            break
        leaf, found = tried, after
    return leaf


def mending_rows(solid: Solid, task: Task, leaf: ModelLeaf) -> Rows:
    """Return the rows that ask for a leaf like this one without its misses."""
    state = Leaf(leaf)
    found = misses(task, solid, state, 2.0)
    kept = found.weight > 0.0
    wanted = state.radius(found.directions) - found.miss / found.slope
    weights = np.sqrt(found.weight) * np.abs(found.slope)
    return Rows(found.directions[kept], wanted[kept], weights[kept], np.zeros(int(kept.sum()), dtype=bool))


def figures(solid: Solid, task: Task, leaf: ModelLeaf) -> Figures:
    """Return how a leaf fits; samples that its centre does not see count by their distance along the ray."""
    state = Leaf(leaf)
    found = misses(task, solid, state, 2.0, held=False)
    r, along = polar(task.points[~task.seen], leaf.centre)
    hidden = np.abs(state.radius(along) - r)
    miss = np.abs(found.miss)
    total = 0.5 * (float((miss * found.weight).sum()) + float(hidden.sum()))
    largest = max(float(miss[found.weight > 0.0].max(initial=0.0)), float(hidden.max(initial=0.0)))
    return Figures(total, largest, r.size)


def misses(task: Task, solid: Solid, leaf: Leaf, power: float, held: bool = True) -> Misses:
    """Return what a leaf misses, both ways: samples that it should meet, its own points that should lie on the source.

    power: as for `improved`. held: with the weak rows behind cuts.
    """
    samples = _sample_misses(task, leaf)
    own = _own_misses(task, solid, leaf)
    near = Misses(*(np.concatenate([a, b]) for a, b in zip(samples, own, strict=True)))
    size = np.abs(near.miss)
    typical = max(float(size.mean()) if size.size else 0.0, 1e-9 * solid.size)
    near = near._replace(weight=near.weight * np.maximum(size / typical, 0.5) ** (power - 2.0))
    behind = _misses_behind(task, solid, leaf, held)
    return Misses(*(np.concatenate([a, b]) for a, b in zip(near, behind, strict=True)))


def _sample_misses(task: Task, leaf: Leaf) -> Misses:
    """Return how far the surface passes from the samples in sight: to first order, the radial gap times cos γ."""
    r, along = polar(task.points[task.seen], leaf.model.centre)
    slope = np.maximum(np.einsum("ni,ni->n", along, task.normals[task.seen]), GRAZING)
    return Misses(along, slope * (leaf.radius(along) - r), slope, np.ones(r.size))


def _own_misses(task: Task, solid: Solid, leaf: Leaf) -> Misses:
    """Return the true signed distances of the leaf's own points, within its region, to the source."""
    reach = leaf.radius(task.free)
    ends = leaf.model.centre + reach[:, None] * task.free
    within = task.region.holds(ends)
    free, reach, ends = task.free[within], reach[within], ends[within]
    distance, nearest, face = solid.triangles.closest(ends)
    corner = solid.vertices[solid.faces[face]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.sqrt((normal**2).sum(axis=1)), 1e-300)[:, None]
    side = np.where(np.einsum("ni,ni->n", ends - nearest, normal) < 0.0, -1.0, 1.0)
    apart = distance > 1e-6 * solid.size
    outward = np.where(apart[:, None], side[:, None] * (ends - nearest) / np.maximum(distance, 1e-300)[:, None], normal)
    steep = np.einsum("ni,ni->n", outward, free)
    steep = np.where(np.abs(steep) < GRAZING, np.copysign(GRAZING, steep), steep)
    return Misses(free, side * distance, steep, ray_share(solid, RAYS) * reach**2 / np.abs(steep))


def _misses_behind(task: Task, solid: Solid, leaf: Leaf, held: bool) -> Misses:
    """Return by how much the leaf falls short of its bounds, and (weak, where held) how far it strays from its base."""
    radius = leaf.radius(task.behind)
    base = np.maximum(ellipsoid_radii(leaf.half_axes, task.behind), task.bound)
    short = radius < task.bound
    miss = radius - np.where(short, task.bound, base)
    pull = np.where(short, task.urgency, HOLD if held else 0.0)
    weight = ray_share(solid, BOUND_RAYS) * (task.bound * pull) ** 2
    return Misses(task.behind, miss, np.ones(miss.size), weight)


def _step(found: Misses, leaf: Leaf) -> ModelLeaf:
    """Return the leaf after one Gauss-Newton step: ridge on the weights, damping on the half axes' logarithms."""
    field = leaf.model.scale_field
    u = np.ascontiguousarray(found.directions)
    pointer, index, value = chosen_rows(u, leaf.centres, leaf.extents)
    s = np.minimum(field_values(pointer, index, value, leaf.weights), MAX_SCALE)
    q = ellipsoid_radii(leaf.half_axes, u)
    seen = np.where(u >= 0.0, leaf.half_axes[0::2], leaf.half_axes[1::2])
    by_axis = (found.slope * (1.0 - s) * q**3)[:, None] * (u / seen) ** 2
    by_half = np.stack([by_axis * (u >= 0.0), by_axis * (u < 0.0)], axis=2).reshape(-1, 6)
    slope = np.where(s < MAX_SCALE, -found.slope * q, 0.0)
    count = field.weights.size
    matrix, right = normal_equations(pointer, index, value, slope, by_half, found.miss, found.weight, count)
    diagonal = np.diag(matrix)
    floor = RIDGE * float(diagonal[:count].mean()) if count else 0.0
    damping = np.concatenate([np.full(count, floor), AXES_DAMPING * diagonal[count:] + 1e-12 * (1.0 + diagonal.max())])
    right[:count] -= floor * leaf.weights
    change = solve_normal(matrix + np.diag(damping), right)
    half_axes = leaf.half_axes * np.exp(np.clip(change[count:], -LONGEST_STEP, LONGEST_STEP))
    return leaf_of(leaf.model.centre, half_axes, ScaleField(field.grid, field.index, leaf.weights + change[:count]))
