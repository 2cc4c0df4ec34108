"""Refinement of a leaf on what it truly misses, both ways: its half axes and all its weights together (DESIGN §3)."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

import numpy as np

from hhsr.fitting.base import base_radii, base_slopes, local
from hhsr.fitting.rows import GRAZING, Rows
from hhsr.fitting.scale_field import ridge_of
from hhsr.fitting.section import Section
from hhsr.fitting.solid import Solid
from hhsr.fitting.task import BOUND_RAYS, HOLD, RAYS, Task, ray_share
from hhsr.kernels.refinement import (
    chosen_rows,
    field_values,
    normal_equations,
    own_misses,
)
from hhsr.kernels.selection import solve_normal
from hhsr.model import MAX_SCALE, FloatArray, IntArray, ModelLeaf, ScaleField, Superquadric

AXES_DAMPING = 1e-3
LONGEST_STEP = 0.2
FARTHEST_LOGIT = 6.0
SHARES = (1.0, 0.5, 0.25)


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
    nearest: IntArray


class Figures(NamedTuple):
    """How a leaf fits, but for samples that its centre does not see.

    total: sum of its misses, mm · samples, half of either way. largest: mm. surface: (n, 3) points of its own surface,
    and of its planes where it leaves voids. normals: (n, 3) of the source where it stands for samples, elsewhere 0.
    spot: (3,) where the largest is.
    """

    total: float
    largest: float
    surface: FloatArray
    normals: FloatArray
    spot: FloatArray


def view_of(directions: FloatArray, leaf: ModelLeaf) -> View:
    """Return a leaf's centres as seen in (n, 3) unit directions of the tree's frame."""
    grid, index = leaf.scale_field.grid, leaf.scale_field.index
    centres = np.ascontiguousarray(grid.centres[index]) if index.size else np.zeros((0, 3))
    extents = grid.extents[index] if index.size else np.zeros(0)
    return View(*chosen_rows(np.ascontiguousarray(local(leaf, directions)), centres, extents))


def improved(
    solid: Solid, task: Task, leaf: ModelLeaf, view: View, steps: int, power: float, before: Misses | None = None
) -> tuple[ModelLeaf, Misses]:
    """Return the leaf after some Gauss-Newton steps on its misses, as long as they fall, and its misses.

    view: of the task's directions. power: of the misses whose sum is to fall (2: least squares, 1: their mean). A step
    that does not help is halved, twice at most. before: what a leaf like it missed, near the same triangles.
    """
    found = misses(task, solid, leaf, view, before)
    weight = weights_of(found, solid, power)
    for _ in range(steps):
        change = _change(task, found, weight, leaf, view)
        cost = (weight * found.miss**2).sum()
        for share in SHARES:
            tried = _changed(leaf, share * change)
            after = misses(task, solid, tried, view, found)
            other = weights_of(after, solid, power)
            if better := bool((other * after.miss**2).sum() < cost):
                break
        if not better:
            break
        leaf, found, weight = tried, after, other
    return leaf, found


def mending_rows(task: Task, found: Misses) -> Rows:
    """Return the rows that ask for a leaf like the one with these misses, without them."""
    wanted = found.radius - found.miss / found.slope
    weights = np.sqrt(found.share) * np.abs(found.slope)
    return Rows(task.directions, wanted, weights, np.zeros(weights.size, dtype=bool))


def figures(
    solid: Solid, task: Task, section: Section, leaf: ModelLeaf, found: Misses, view: View | None = None
) -> Figures:
    """Return how a leaf fits, voids behind cuts by their depth. view: of the section's directions, if there is one."""
    own = np.flatnonzero(found.share[: found.near] > 0.0)
    miss = np.abs(found.miss[own])
    void = radii_of(leaf, section.along, view) < section.reach
    lost = float((section.depth * section.cell)[void].sum()) / (solid.sample_area * task.stride)
    total = 0.5 * (float((miss * found.share[own]).sum()) + lost)
    surface = leaf.centre + np.concatenate(
        [found.radius[own, None] * task.directions[own], section.reach[void, None] * section.along[void]]
    )
    normals = np.zeros(surface.shape)
    normals[: task.along.shape[0]] = task.normals[task.seen]
    missed = np.concatenate([miss, section.depth[void]])
    if missed.size == 0:
        return Figures(total, 0.0, surface, normals, leaf.centre)
    worst = int(missed.argmax())
    return Figures(total, float(missed[worst]), surface, normals, surface[worst])


def radii_of(leaf: ModelLeaf, directions: FloatArray, view: View | None = None) -> FloatArray:
    """Return (n,) radii, mm, of a leaf on the tree's axes. view: of these directions, where there is one."""
    seen = view_of(directions, leaf) if view is None else view
    radii: FloatArray = (1.0 - seen.scales(leaf)) * base_radii(leaf, directions)
    return radii


def misses(
    task: Task, solid: Solid, leaf: ModelLeaf, view: View, before: Misses | None = None, own: Misses | None = None
) -> Misses:
    """Return what a leaf misses, both ways: samples that it should meet, its own points that should lie on the source.

    And behind cuts: where it falls short of its bounds, and (weak) how far it strays from its base.
    before: what a leaf like it missed, for a task that may differ in its bounds.
    own: the leaf's misses for a task that differs in its bounds only: what they say of samples and own points stays.
    """
    base = base_radii(leaf, task.directions)
    radius = (1.0 - view.scales(leaf)) * base
    miss, slope, share = np.zeros(radius.size), np.ones(radius.size), np.zeros(radius.size)
    first, second = task.along.shape[0], task.along.shape[0] + task.free.shape[0]
    if own is None:
        slope[:first] = np.maximum(task.cosine, GRAZING)
        miss[:first] = slope[:first] * (radius[:first] - task.radii)
        share[:first] = 1.0
        nearest = np.full(second - first, -1) if before is None else before.nearest.copy()
        mine = [a[first:second] for a in (radius, miss, slope, share)]
        _own_misses(task, solid, leaf, mine[0], mine[1], mine[2], mine[3], nearest)
    else:
        nearest = own.nearest
        miss[:second], slope[:second], share[:second] = own.miss[:second], own.slope[:second], own.share[:second]
    short = radius[second:] < task.bound
    miss[second:] = radius[second:] - np.where(short, task.bound, np.maximum(base[second:], task.bound))
    share[second:] = ray_share(solid, BOUND_RAYS) * (task.bound * np.where(short, task.urgency, HOLD)) ** 2
    return Misses(radius, miss, slope, share, second, nearest)


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
    nearest: IntArray,
) -> None:
    """Fill in the true signed distances of the leaf's own points, within its region, to the source."""
    boxes, links, corners, _ = solid.triangles.arrays
    normals, offsets = task.region
    least, area = 1e-6 * solid.size, ray_share(solid, RAYS)
    own_misses(
        boxes, links, corners, normals, offsets, leaf.centre, task.free, radius, GRAZING, least, area, miss, slope,
        share, nearest,
    )  # fmt: skip


def _change(task: Task, found: Misses, weight: FloatArray, leaf: ModelLeaf, view: View) -> FloatArray:
    """Return a Gauss-Newton step of weights (with a ridge), half axes' logarithms and logits (with a damping)."""
    field = leaf.scale_field
    s = view.scales(leaf)
    q = base_radii(leaf, task.directions)
    by_base = (found.slope * (1.0 - s))[:, None] * base_slopes(leaf, task.directions, q)
    slope = np.where(s < MAX_SCALE, -found.slope * q, 0.0)
    count = field.weights.size
    matrix, right = normal_equations(*view, slope, by_base, found.miss, weight, count)
    diagonal = np.diag(matrix)
    mean = float(diagonal[:count].mean()) if count else 0.0
    floor = ridge_of(field.grid.extents[field.index]) * mean if count else np.zeros(0)
    damping = np.concatenate([floor, AXES_DAMPING * diagonal[count:] + 1e-12 * (1.0 + diagonal.max())])
    right[:count] -= floor * field.weights
    change: FloatArray = solve_normal(matrix + np.diag(damping), right)
    return change


def _changed(leaf: ModelLeaf, change: FloatArray) -> ModelLeaf:
    """Return the leaf with its weights, the logarithms of its half axes and its logits changed."""
    field, base, count = leaf.scale_field, leaf.superquadric, leaf.scale_field.weights.size
    moved = np.clip(change[count:], -LONGEST_STEP, LONGEST_STEP)
    logits = np.concatenate([base.azimuth_logits, base.elevation_logits]) + moved[6:]
    azimuth, elevation = np.split(np.clip(logits, -FARTHEST_LOGIT, FARTHEST_LOGIT), [base.azimuth_logits.size])
    return replace(
        leaf,
        superquadric=Superquadric(np.asarray(base.half_axes) * np.exp(moved[:6]), azimuth, elevation),
        scale_field=ScaleField(field.grid, field.index, field.weights + change[:count]),
    )
