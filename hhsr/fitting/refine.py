"""Refinement of a leaf on what it truly misses, both ways: its half axes and all its weights together (DESIGN §3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hhsr.fitting.rows import GRAZING, Rows
from hhsr.fitting.scale_field import ellipsoid_radii, leaf_of, ridge_of
from hhsr.fitting.section import Section
from hhsr.fitting.solid import Solid
from hhsr.fitting.task import BOUND_RAYS, HOLD, RAYS, Task, ray_share
from hhsr.kernels.refinement import chosen_rows, field_values, normal_equations
from hhsr.kernels.selection import solve_normal
from hhsr.model import MAX_SCALE, FloatArray, IntArray, ModelLeaf, ScaleField

AXES_DAMPING = 1e-3
LONGEST_STEP = 0.2


class View(NamedTuple):
    """A leaf's centres as seen in all directions of its task: compressed rows of λ, made once while they stay."""

    starts: IntArray
    atoms: IntArray
    values: FloatArray

    def scales(self, leaf: ModelLeaf) -> FloatArray:
        """Return (n,) the scale field s of a leaf with these centres, at most 0.95."""
        s: FloatArray = field_values(*self, np.asarray(leaf.scale_field.weights))
        return np.minimum(s, MAX_SCALE)


class Misses(NamedTuple):
    """n rows of what a leaf misses, in the order of its task's directions: samples, own points, behind, sections.

    radius: (n,) mm of the leaf. miss: (n,) signed, mm. slope: (n,) of the miss by ρ. share: (n,) ≥ 0, of how many
    samples a row stands for; 0: it tells nothing. near: rows before this one are distances to the source, the others
    say by how much the leaf falls short of a bound, or how far it strays from its base.
    """

    radius: FloatArray
    miss: FloatArray
    slope: FloatArray
    share: FloatArray
    near: int


class Figures(NamedTuple):
    """How a leaf fits, but for samples that its centre does not see.

    total: sum of its misses, mm · samples, half of either way. largest: mm. surface: (n, 3) points of its own surface,
    and of its planes where it leaves voids.
    """

    total: float
    largest: float
    surface: FloatArray


def view_of(task: Task, field: ScaleField) -> View:
    """Return a field's centres as seen in the directions of a task."""
    grid, index = field.grid, field.index
    centres = np.ascontiguousarray(grid.centres[index]) if index.size else np.zeros((0, 3))
    extents = grid.extents[index] if index.size else np.zeros(0)
    return View(*chosen_rows(task.directions, centres, extents))


def improved(solid: Solid, task: Task, leaf: ModelLeaf, steps: int, power: float) -> tuple[ModelLeaf, Misses]:
    """Return the leaf after some Gauss-Newton steps on its misses, as long as they fall, and its misses.

    power: of the misses whose sum is to fall (2: least squares, 1: their mean).
    """
    view = view_of(task, leaf.scale_field)
    found = misses(task, solid, leaf, view)
    weight = weights_of(found, solid, power)
    for _ in range(steps):
        tried = _step(task, found, weight, leaf, view)
        after = misses(task, solid, tried, view)
        other = weights_of(after, solid, power)
        if (other * after.miss**2).sum() >= (weight * found.miss**2).sum():
            break
        leaf, found, weight = tried, after, other
    return leaf, found


def mending_rows(task: Task, found: Misses) -> Rows:
    """Return the rows that ask for a leaf like the one with these misses, without them."""
    kept = found.share > 0.0
    wanted = found.radius - found.miss / found.slope
    weights = np.sqrt(found.share) * np.abs(found.slope)
    return Rows(task.directions[kept], wanted[kept], weights[kept], np.zeros(int(kept.sum()), dtype=bool))


def figures(solid: Solid, task: Task, section: Section, leaf: ModelLeaf, found: Misses) -> Figures:
    """Return how a leaf fits, voids behind cuts by their depth."""
    told = found.share[: found.near] > 0.0
    miss = np.abs(found.miss[: found.near])[told]
    void = radii_of(leaf, section.along) < section.reach
    lost = float(section.depth[void].sum()) * section.cell / (solid.sample_area * task.stride)
    total = 0.5 * (float((miss * found.share[: found.near][told]).sum()) + lost)
    own = np.arange(task.along.shape[0], found.near)[told[task.along.shape[0] :]]
    surface = leaf.centre + np.concatenate(
        [found.radius[own, None] * task.directions[own], section.reach[void, None] * section.along[void]]
    )
    return Figures(total, max(float(a.max(initial=0.0)) for a in (miss, section.depth[void])), surface)


def radii_of(leaf: ModelLeaf, directions: FloatArray) -> FloatArray:
    """Return (n,) radii, mm, of a leaf on the tree's axes."""
    field = leaf.scale_field
    centres = np.ascontiguousarray(field.grid.centres[field.index]) if field.index.size else np.zeros((0, 3))
    extents = field.grid.extents[field.index] if field.index.size else np.zeros(0)
    view = View(*chosen_rows(np.ascontiguousarray(directions), centres, extents))
    radii: FloatArray = (1.0 - view.scales(leaf)) * ellipsoid_radii(np.asarray(leaf.superquadric.half_axes), directions)
    return radii


def misses(task: Task, solid: Solid, leaf: ModelLeaf, view: View) -> Misses:
    """Return what a leaf misses, both ways: samples that it should meet, its own points that should lie on the source.

    And behind cuts: where it falls short of its bounds, and (weak) how far it strays from its base.
    """
    base = ellipsoid_radii(np.asarray(leaf.superquadric.half_axes), task.directions)
    radius = (1.0 - view.scales(leaf)) * base
    miss, slope, share = np.zeros(radius.size), np.ones(radius.size), np.zeros(radius.size)
    first, second = task.along.shape[0], task.along.shape[0] + task.free.shape[0]
    slope[:first] = np.maximum(task.cosine, GRAZING)
    miss[:first] = slope[:first] * (radius[:first] - task.radii)
    share[:first] = 1.0
    _own_misses(task, solid, leaf, *(a[first:second] for a in (radius, miss, slope, share)))
    short = radius[second:] < task.bound
    miss[second:] = radius[second:] - np.where(short, task.bound, np.maximum(base[second:], task.bound))
    share[second:] = ray_share(solid, BOUND_RAYS) * (task.bound * np.where(short, task.urgency, HOLD)) ** 2
    return Misses(radius, miss, slope, share, second)


def weights_of(found: Misses, solid: Solid, power: float) -> FloatArray:
    """Return (n,) by what a squared miss counts so that the sum is one of |miss|^power (bounds always squared)."""
    size = np.abs(found.miss[: found.near])
    told = found.share[: found.near] > 0.0
    typical = max(float(size[told].mean()) if told.any() else 0.0, 1e-9 * solid.size)
    weight = found.share.copy()
    weight[: found.near] *= np.maximum(size / typical, 0.5) ** (power - 2.0)
    return weight


def _own_misses(
    task: Task,
    solid: Solid,
    leaf: ModelLeaf,
    radius: FloatArray,
    miss: FloatArray,
    slope: FloatArray,
    share: FloatArray,
) -> None:
    """Fill in the true signed distances of the leaf's own points, within its region, to the source."""
    ends = leaf.centre + radius[:, None] * task.free
    within = np.flatnonzero(task.region.holds(ends))
    ends, free = ends[within], task.free[within]
    distance, nearest, face = solid.triangles.closest(ends)
    corner = solid.vertices[solid.faces[face]]
    normal = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    normal /= np.maximum(np.sqrt((normal**2).sum(axis=1)), 1e-300)[:, None]
    side = np.where(np.einsum("ni,ni->n", ends - nearest, normal) < 0.0, -1.0, 1.0)
    apart = distance > 1e-6 * solid.size
    outward = np.where(apart[:, None], side[:, None] * (ends - nearest) / np.maximum(distance, 1e-300)[:, None], normal)
    steep = np.einsum("ni,ni->n", outward, free)
    steep = np.where(np.abs(steep) < GRAZING, np.copysign(GRAZING, steep), steep)
    miss[within] = side * distance
    slope[within] = steep
    share[within] = ray_share(solid, RAYS) * radius[within] ** 2 / np.abs(steep)


def _step(task: Task, found: Misses, weight: FloatArray, leaf: ModelLeaf, view: View) -> ModelLeaf:
    """Return the leaf after one Gauss-Newton step: ridge on the weights, damping on the half axes' logarithms."""
    field, axes = leaf.scale_field, np.asarray(leaf.superquadric.half_axes)
    u = task.directions
    s = view.scales(leaf)
    q = ellipsoid_radii(axes, u)
    seen = np.where(u >= 0.0, axes[0::2], axes[1::2])
    by_axis = (found.slope * (1.0 - s) * q**3)[:, None] * (u / seen) ** 2
    by_half = np.stack([by_axis * (u >= 0.0), by_axis * (u < 0.0)], axis=2).reshape(-1, 6)
    slope = np.where(s < MAX_SCALE, -found.slope * q, 0.0)
    count = field.weights.size
    matrix, right = normal_equations(*view, slope, by_half, found.miss, weight, count)
    diagonal = np.diag(matrix)
    mean = float(diagonal[:count].mean()) if count else 0.0
    floor = ridge_of(field.grid.extents[field.index]) * mean if count else np.zeros(0)
    damping = np.concatenate([floor, AXES_DAMPING * diagonal[count:] + 1e-12 * (1.0 + diagonal.max())])
    right[:count] -= floor * field.weights
    change = solve_normal(matrix + np.diag(damping), right)
    half_axes = axes * np.exp(np.clip(change[count:], -LONGEST_STEP, LONGEST_STEP))
    return leaf_of(leaf.centre, half_axes, ScaleField(field.grid, field.index, field.weights + change[:count]))
