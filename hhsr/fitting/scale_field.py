"""A leaf from its rows: the ellipsoid of six half axes, and scale-field centres chosen greedily (DESIGN §1, §3)."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import lru_cache
from typing import NamedTuple

import numpy as np

from hhsr.fitting.rows import Rows
from hhsr.kernels.greedy import orthogonal_selection
from hhsr.kernels.refinement import chosen_rows
from hhsr.kernels.selection import atoms_of_cells, back_substituted, dictionary_rows, drop_costs, solve_normal
from hhsr.model import CentreGrid, FloatArray, IntArray, ModelLeaf, ScaleField, Superquadric

RATIO = 1.5
SUPPORT = 3.3
COARSEST = 20
RIDGE = 4e-5
CELL_EDGE = 16
NO_ROTATION = np.zeros(0)
NONE = np.zeros(0, np.int64)


class Selection(NamedTuple):
    """Centres of one leaf in the order in which they pay, the first `held` of them kept from before.

    atoms: (k,) indices into the grid. gains: (k,) fall of the rows' sum of squares, mm². triangle, right: see
    `hhsr.kernels.selection.orthogonal_selection`.
    """

    grid: CentreGrid
    atoms: IntArray
    gains: FloatArray
    triangle: FloatArray
    right: FloatArray
    held: int

    def field(self, count: int) -> ScaleField:
        """Return the scale field of the first `count` centres."""
        weights = back_substituted(self.triangle, self.right, count)
        order = np.argsort(self.atoms[:count], kind="stable")
        return ScaleField(self.grid, self.atoms[:count][order], weights[order])


def grid_for(finest: int) -> CentreGrid:
    """Return the dictionary whose finest grid has about `finest` centres; each coarser one is 1.5 times wider."""
    sizes = [max(finest, COARSEST)]
    while sizes[-1] / RATIO**2 >= COARSEST:
        sizes.append(round(sizes[-1] / RATIO**2))
    return CentreGrid(tuple(sorted(sizes)), SUPPORT)


def dictionary(grid: CentreGrid, directions: FloatArray) -> tuple[IntArray, IntArray, FloatArray]:
    """Return the compressed rows of λ over the whole grid, for (n, 3) unit directions."""
    cell_pointer, cell_atoms = _atoms_of_cells(grid)
    pointer, index, value = dictionary_rows(
        np.ascontiguousarray(directions), grid.centres, 1.0 / grid.extents, CELL_EDGE, cell_pointer, cell_atoms
    )
    return pointer, index, value


@lru_cache(maxsize=4)
def _atoms_of_cells(grid: CentreGrid) -> tuple[IntArray, IntArray]:
    """Return which of the grid's centres each cell of directions has to ask."""
    starts = np.concatenate([[0], np.cumsum(grid.sizes)]).astype(np.int64)
    pointer, atoms = atoms_of_cells(grid.centres, starts, grid.extents[starts[:-1]].copy(), CELL_EDGE)
    return pointer, atoms


def ridge_of(extents: FloatArray) -> FloatArray:
    """Return the ridge of centres by their extents, in units of the normal matrix's mean diagonal.

    Narrow centres pay more: they are steep, and swing where samples are thin (liver B: Σ|w|/σ² 1569 → 900 at the same
    mean; a tenth of that where all pay alike).
    """
    ridge: FloatArray = RIDGE / extents
    return ridge


def ellipsoid_radii(half_axes: FloatArray, directions: FloatArray) -> FloatArray:
    """Return (n,) radii q of the ellipsoid of six half axes in (n, 3) unit directions."""
    radii: FloatArray = 1.0 / np.sqrt(((directions / _axes_seen(half_axes, directions)) ** 2).sum(axis=1))
    return radii


def _axes_seen(half_axes: FloatArray, directions: FloatArray) -> FloatArray:
    """Return (n, 3) the half axes of each direction's octant."""
    return np.where(directions >= 0.0, half_axes[0::2], half_axes[1::2])


def fit_ellipsoid(rows: Rows, iterations: int = 12) -> FloatArray:
    """Return the (6,) half axes whose ellipsoid lies nearest to the rows: Gauss-Newton on their logarithms.

    A bound counts only while it is broken; an axis that no row tells stays near the mean radius (ridge 10⁻³).
    """
    told = ~rows.bound if (~rows.bound).any() else rows.bound
    mean = float((rows.weights * rows.radii)[told].sum() / max(rows.weights[told].sum(), 1e-300))
    logs = np.full(6, math.log(mean))
    ridge = 1e-3 * float((rows.weights**2).sum()) * mean**2 / 6.0
    for _ in range(iterations):
        axes = np.exp(logs)
        q = ellipsoid_radii(axes, rows.directions)
        miss = rows.radii - q
        weight = np.where(rows.bound & (miss <= 0.0), 0.0, rows.weights**2)
        slopes = q[:, None] ** 3 * (rows.directions / _axes_seen(axes, rows.directions)) ** 2
        jacobian = np.concatenate([slopes * (rows.directions >= 0.0), slopes * (rows.directions < 0.0)], axis=1)
        order = [0, 3, 1, 4, 2, 5]
        jacobian = jacobian[:, order]
        normal = np.einsum("n,ni,nj->ij", weight, jacobian, jacobian) + ridge * np.eye(6)
        right = np.einsum("n,ni,n->i", weight, jacobian, miss) + ridge * (math.log(mean) - logs)
        logs = logs + np.clip(solve_normal(normal, right), -0.5, 0.5)
    half_axes: FloatArray = np.exp(np.clip(logs, math.log(0.05 * mean), math.log(20.0 * mean)))
    return half_axes


def select_centres(rows: Rows, half_axes: FloatArray, grid: CentreGrid, count: int, held: IntArray = NONE) -> Selection:
    """Return up to `count` centres that bring the leaf nearest to the rows, the `held` ones among them.

    Bounds count where the bare ellipsoid breaks them.
    """
    pointer, index, value, scale, target = _system(rows, half_axes, lambda u: dictionary(grid, u))
    chosen, gains, triangle, right = orthogonal_selection(
        pointer, index, value, scale, target, grid.size, count, ridge_of(grid.extents), held
    )
    return Selection(grid, chosen, gains, triangle, right, held.size)


def costs_of_dropping(rows: Rows, leaf: ModelLeaf) -> FloatArray:
    """Return (k,) by how much the rows' sum of squares (mm²) rises when a leaf loses one of its centres."""
    field = leaf.scale_field
    centres, extents = np.ascontiguousarray(field.grid.centres[field.index]), field.grid.extents[field.index]
    system = _system(rows, np.asarray(leaf.superquadric.half_axes), lambda u: chosen_rows(u, centres, extents))
    k = field.index.size
    _, _, triangle, right = orthogonal_selection(*system, k, k, ridge_of(extents), np.arange(k))
    costs: FloatArray = drop_costs(triangle, right)
    return costs


def _system(
    rows: Rows, half_axes: FloatArray, atoms: Callable[[FloatArray], tuple[IntArray, IntArray, FloatArray]]
) -> tuple[IntArray, IntArray, FloatArray, FloatArray, FloatArray]:
    """Return the linear system that rows ask of the scale field: compressed λ, scale and target of each row."""
    q = ellipsoid_radii(half_axes, rows.directions)
    weights = np.where(rows.bound & (q >= rows.radii), 0.0, rows.weights)
    kept = np.flatnonzero(weights > 0.0)
    pointer, index, value = atoms(np.ascontiguousarray(rows.directions[kept]))
    return pointer, index, value, (weights * q)[kept], (weights * (q - rows.radii))[kept]


def leaf_of(centre: FloatArray, half_axes: FloatArray, field: ScaleField) -> ModelLeaf:
    """Return the leaf: an ellipsoid on the tree's axes with a scale field."""
    return ModelLeaf(centre, NO_ROTATION, Superquadric(half_axes), field)
