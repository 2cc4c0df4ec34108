"""A leaf of the paper's kind: a superquadric, a scale field on uniform centres by linear least squares (PAPER §2.2)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve

from hhsr.evaluate import leaf_radius
from hhsr.fitting.source import Source
from hhsr.fitting.split import Part
from hhsr.fitting.superquadric import Start, SuperquadricFit, fit_superquadric
from hhsr.kernels.field_rows import add_normal_equations, column_squares, row_products, sparse_rows
from hhsr.kernels.leaf import MAX_SCALE
from hhsr.model import (
    CentreGrid,
    FloatArray,
    IntArray,
    ModelLeaf,
    ScaleField,
    Superquadric,
    fibonacci_sphere,
    frozen,
    rotation_matrix,
)

SUPPORT = 2.5
LADDER = (8, 12, 16, 24, 32, 48, 64, 96, 128, 192, 256, 384, 512, 768, 1024)
RIDGE = 1e-5
LEAST_COSINE = 0.2
ROUNDS = 3
SLACK_SHARE = 0.01
EMPTY_SHARE = 0.3
NEARLY = 0.01


class LeafRows(NamedTuple):
    """What a leaf has to follow, in its own frame.

    directions: (n, 3) unit. radii: (n,) mm of the surface. cosines: (n,) of the angle between direction and normal.
    areas: (n,) mm² that each stands for. empty: (m, 3) unit directions with no surface of the part, reach: (m,) mm how
    far the solid runs there at least, empty_areas: (m,). hidden, hidden_radii, hidden_areas: (h, 3), (h,), (h,) surface
    of the shape, and section of the solid on the region's planes, that lies behind other surface; no row follows it,
    but what is missed there is counted.
    """

    directions: FloatArray
    radii: FloatArray
    cosines: FloatArray
    areas: FloatArray
    empty: FloatArray
    reach: FloatArray
    empty_areas: FloatArray
    hidden: FloatArray
    hidden_radii: FloatArray
    hidden_areas: FloatArray


def leaf_rows(
    part: Part, source: Source, centre: FloatArray, rotation: FloatArray, most: int = 4000, rays: int = 1000
) -> LeafRows:
    """Return the rows of a part about a centre inside it: its surface samples, and rays where they meet it or do not.

    A sample that looks back at the centre lies behind another piece of the surface: no radius can follow both; it is
    left out. Leaving out all that is behind other surface made livers and the bunny worse.
    """
    turn = rotation_matrix(rotation)
    index = source.inside(part)
    index = index[np.linspace(0, index.size - 1, min(most, index.size)).astype(np.int64)] if index.size else index
    away = source.samples.points[index] - centre
    radii = np.sqrt((away**2).sum(axis=1))
    unit = away / np.maximum(radii, 1e-12)[:, None]
    cosines = (unit * source.samples.normals[index]).sum(axis=1)
    kept = (cosines > 0.0) & (radii > 1e-9)
    share = source.area_mm2 * source.inside(part).size / source.samples.points.shape[0] / max(index.size, 1)
    directions = fibonacci_sphere(rays)
    reach = part.exits(np.broadcast_to(centre, directions.shape), directions)
    behind_unit, behind_radii, behind_area = _caps_behind(part, source, centre)
    hit, face = source.tree.first_hit(np.broadcast_to(centre, directions.shape), directions)
    met = np.flatnonzero(hit <= reach)
    corners = source.vertices[source.faces[face[met]]]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    slopes = (directions[met] * normals).sum(axis=1) / np.maximum(np.sqrt((normals**2).sum(axis=1)), 1e-300)
    empty = np.flatnonzero(~(hit <= reach) & (reach < 4.0 * source.extent_mm))
    most_area = 10.0 * share * max(index.size, 1) / rays
    ray_areas = EMPTY_SHARE * np.minimum(np.where(hit <= reach, hit, reach) ** 2 * 4.0 * math.pi / rays, most_area)
    return LeafRows(
        np.ascontiguousarray(np.concatenate([unit[kept], directions[met]]) @ turn),
        np.concatenate([radii[kept], hit[met]]),
        np.concatenate([cosines[kept], np.maximum(slopes, 0.0)]),
        np.concatenate([np.full(int(kept.sum()), share), ray_areas[met]]),
        np.ascontiguousarray(directions[empty] @ turn),
        reach[empty],
        ray_areas[empty],
        np.ascontiguousarray(np.concatenate([unit[~kept], behind_unit]) @ turn),
        np.concatenate([radii[~kept], behind_radii]),
        np.concatenate([np.full(int((~kept).sum()), share), np.full(behind_radii.size, behind_area)]),
    )


def _caps_behind(part: Part, source: Source, centre: FloatArray) -> tuple[FloatArray, FloatArray, float]:
    """Return unit directions and radii of points of the region's sections that lie behind surface, and the mm² of each.

    What a leaf cannot see of its own section becomes a step face deep inside the solid.
    """
    points, area = source.cap_samples(part)
    away = points - centre
    radii = np.sqrt((away**2).sum(axis=1))
    seen, _ = source.tree.first_hit(np.broadcast_to(centre, away.shape), away)
    behind = (seen < 1.0 - NEARLY) & (radii > 1e-9)
    return away[behind] / radii[behind, None], radii[behind], area


def _bases(leaf: ModelLeaf, rows: LeafRows) -> tuple[FloatArray, FloatArray]:
    """Return the superquadric's radii (mm) in the directions of the data and of the empty rays."""
    bare = ModelLeaf(leaf.centre, leaf.rotation, leaf.superquadric, ScaleField.none())
    return leaf_radius(bare, rows.directions), leaf_radius(bare, rows.empty)


def covered_centres(grid: CentreGrid, rows: LeafRows) -> IntArray:
    """Return the indices of the centres that data, not only empty directions, can tell apart from 0."""
    seen = np.ascontiguousarray(rows.directions[:: max(1, rows.radii.size // 1500)])
    offsets, index, value = sparse_rows(seen, grid.centres, 1.0 / grid.extents)
    weight = column_squares(offsets, index, value, grid.size)
    return np.flatnonzero(weight > 0.02 * float(weight.max(initial=0.0)))


class FieldFit(NamedTuple):
    """leaf: with its field. mean_mm, max_mm: miss of its surface, hidden or not. area_error: Σ area · miss, mm³."""

    leaf: ModelLeaf
    mean_mm: float
    max_mm: float
    area_error: float


def fit_field(leaf: ModelLeaf, rows: LeafRows, count: int) -> FieldFit:
    """Return the leaf with a scale field on those of `count` uniform centres that its data cover.

    Linear least squares (PAPER §2.2) on Λ w = 1 − β, each row in mm of true distance (|cos γ| of the radial miss) by
    the area it stands for; three rounds, reweighted towards the mean of absolute misses; an empty direction is a row
    only while the leaf ends there before the region does.
    """
    base, base_empty = _bases(leaf, rows)
    slope = base * np.maximum(rows.cosines, LEAST_COSINE)
    target = np.minimum(1.0 - rows.radii / base, MAX_SCALE)
    grid = CentreGrid((count,), SUPPORT) if count else CentreGrid((), SUPPORT)
    index = covered_centres(grid, rows) if count else np.zeros(0, np.int64)
    if index.size == 0:
        miss = np.abs(slope * target)
        return _figures(ScaleField.none(), leaf, miss, rows)
    centres, inverse = np.ascontiguousarray(grid.centres[index]), 1.0 / grid.extents[index]
    data, data_index, data_value = sparse_rows(rows.directions, centres, inverse)
    full, full_index, full_value = sparse_rows(rows.empty, centres, inverse)
    bound = 1.0 - (1.0 + SLACK_SHARE) * rows.reach / base_empty
    weights = np.zeros(index.size)
    robust = np.ones(base.size)
    for _ in range(ROUNDS):
        short = row_products(full, full_index, full_value, weights) > bound
        gram, right = np.zeros((index.size, index.size)), np.zeros(index.size)
        row, row_full = rows.areas * robust * slope**2, short * rows.empty_areas * (0.5 * base_empty) ** 2
        add_normal_equations(data, data_index, data_value, row, target, gram, right)
        add_normal_equations(full, full_index, full_value, row_full, bound, gram, right)
        gram[np.diag_indices_from(gram)] += RIDGE * np.trace(gram) / index.size + 1e-30
        weights = cho_solve(cho_factor(gram, lower=True, check_finite=False), right)
        miss = np.abs(slope * (target - row_products(data, data_index, data_value, weights)))
        typical = float(np.average(miss, weights=rows.areas)) + 1e-12
        robust = 1.0 / np.maximum(miss / typical, 0.5)
    field = ScaleField(grid, frozen(index, np.int64), frozen(weights))
    return _figures(field, leaf, miss, rows)


def _figures(field: ScaleField, leaf: ModelLeaf, miss: FloatArray, rows: LeafRows) -> FieldFit:
    """Return the leaf with the field and what it misses: seen and hidden surface, dents where the region is full."""
    fitted = ModelLeaf(leaf.centre, leaf.rotation, leaf.superquadric, field)
    total = float((miss * rows.areas).sum())
    hidden = np.abs(leaf_radius(fitted, rows.hidden) - rows.hidden_radii)
    total += float((rows.hidden_areas * hidden).sum())
    largest = max(float(miss.max(initial=0.0)), float(hidden.max(initial=0.0)))
    area = float(rows.areas.sum() + rows.hidden_areas.sum())
    total += float((rows.empty_areas * np.maximum(rows.reach - leaf_radius(fitted, rows.empty), 0.0)).sum())
    return FieldFit(fitted, total / max(area, 1e-300), largest, total)


def best_centre(part: Part, source: Source, seed: int, candidates: int = 12) -> FloatArray | None:
    """Return the point inside the part and the solid about which a cheap radial fit misses least; None: none is inside.

    Candidates are far from each other and from the surface; each is judged by a sphere and 24 centres.
    """
    inner, depth = interior_points(part, source, seed)
    if inner.shape[0] == 0:
        return None
    chosen = _spread(inner, depth, candidates)
    errors = []
    for centre in inner[chosen]:
        rows = leaf_rows(part, source, centre, np.zeros(3), most=600, rays=300)
        errors.append(_cheap_error(centre, rows))
    return np.asarray(inner[chosen[int(np.argmin(errors))]])


def interior_points(part: Part, source: Source, seed: int, count: int = 3000) -> tuple[FloatArray, FloatArray]:
    """Return points (n, 3) inside both part and solid, and their distance (n,) to surface and planes, mm."""
    random = np.random.default_rng(seed)
    low, high = part.vertices.min(axis=0), part.vertices.max(axis=0)
    points = low + (high - low) * random.random((count, 3))
    # Thin parts fill little of their box: points just below the surface always find some of them.
    index = source.inside(part)
    index = index[random.permutation(index.size)[:600]]
    below = source.samples.points[index]
    steps = source.extent_mm * 0.05 * random.random((index.size, 1))
    points = np.concatenate([points, below - steps * source.samples.normals[index]])
    points = points[part.holds(points)]
    if points.shape[0]:
        points = points[source.tree.contains(points)]
    if points.shape[0] == 0:
        return points, np.zeros(0)
    depth = source.tree.closest(points)[0]
    for plane, side in part.planes:
        depth = np.minimum(depth, side * plane.heights(points))
    return points, depth


def _spread(points: FloatArray, depth: FloatArray, count: int) -> IntArray:
    """Return indices of up to `count` deep points, each far from those before it."""
    first = int(np.argmax(depth))
    chosen = [first]
    apart = np.sqrt(((points - points[first]) ** 2).sum(axis=1))
    while len(chosen) < min(count, points.shape[0]):
        best = int(np.argmax(np.minimum(apart, 3.0 * depth) * depth))
        if best in chosen:
            break
        chosen.append(best)
        apart = np.minimum(apart, np.sqrt(((points - points[best]) ** 2).sum(axis=1)))
    return np.array(chosen)


def _cheap_error(centre: FloatArray, rows: LeafRows) -> float:
    """Return what a sphere of the rows' size with 24 centres misses, mm."""
    if rows.radii.size < 12:
        return math.inf
    leaf = ModelLeaf(centre, np.zeros(0), _ball(rows), ScaleField.none())
    return fit_field(leaf, rows, 24).mean_mm


def _ball(rows: LeafRows) -> Superquadric:
    """Return a sphere as a superquadric: the median radius of the rows."""
    return Superquadric(frozen(np.full(6, float(np.median(rows.radii)))))


def base_leaf(part: Part, source: Source, centre: FloatArray, points: int, most_numbers: int) -> ModelLeaf:
    """Return the part's superquadric as a leaf without a field, about a centre inside part and solid.

    The superquadric's own centre is kept if it stays inside and a small field about it misses less than about `centre`.
    """
    rows = leaf_rows(part, source, centre, np.zeros(3), most=points, rays=50)
    surface = centre + rows.directions * rows.radii[:, None]
    best: tuple[float, ModelLeaf] | None = None
    for leash, rotate in ((0.05, True), (1e3, True)):
        fit = fit_superquadric(
            surface, Start(centre, np.zeros(3)), rotate=rotate, most_numbers=most_numbers, leash=leash
        )
        if not _is_inside(fit.centre, part, source):
            continue
        leaf = as_leaf(fit)
        error = fit_field(leaf, leaf_rows(part, source, fit.centre, fit.rotation, most=1000, rays=300), 32).mean_mm
        if best is None or error < 0.98 * best[0]:
            best = error, leaf
    if best is None:
        return ModelLeaf(frozen(centre), frozen([]), _ball(rows), ScaleField.none())
    return best[1]


def as_leaf(fit: SuperquadricFit) -> ModelLeaf:
    """Return a superquadric as a leaf without a field."""
    return ModelLeaf(frozen(fit.centre), frozen(fit.rotation), fit.superquadric, ScaleField.none())


def _is_inside(centre: FloatArray, part: Part, source: Source) -> bool:
    """Return whether a centre lies inside the part's region and the solid."""
    inside: NDArray[np.bool_] = source.tree.contains(centre[None])
    return bool(inside[0]) and bool(part.holds(centre[None])[0])
