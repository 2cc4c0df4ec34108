"""A leaf from its rows: the ellipsoid of six half axes, and scale-field centres chosen greedily (DESIGN §1, §3)."""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np

from hhsr.fitting.base import base_radii, local
from hhsr.fitting.rows import Rows
from hhsr.kernels.greedy import begin, extend, triangle_of
from hhsr.kernels.refinement import chosen_rows, ellipsoid_radii, normal_equations
from hhsr.kernels.selection import (
    atoms_of_cells,
    back_substituted,
    dictionary_rows,
    drop_costs,
    solve_normal,
    transposed,
)
from hhsr.model import CentreGrid, FloatArray, IntArray, ModelLeaf, ScaleField, Superquadric

RATIO = 1.5
SUPPORT = 3.3
COARSEST = 20
RIDGE = 4e-5
CELL_EDGE = 16
NO_ROTATION = np.zeros(0)
NONE = np.zeros(0, np.int64)


class Atoms(NamedTuple):
    """Which centres of a grid see which of (n, 3) directions: λ as compressed rows and as compressed columns."""

    grid: CentreGrid
    row_starts: IntArray
    row_atoms: IntArray
    row_values: FloatArray
    column_starts: IntArray
    column_rows: IntArray
    column_values: FloatArray


def atoms_of(grid: CentreGrid, directions: FloatArray) -> Atoms:
    """Return which centres of a grid see which of (n, 3) unit directions."""
    found = dictionary(grid, directions)
    return Atoms(grid, *found, *transposed(*found, grid.size))


class Selection:
    """Centres of one leaf in the order in which they pay, `held` of them kept from before; more are chosen when asked.

    atoms: of the rows' directions. base: (n,) mm, the bare superquadric's radii there; bounds count if it breaks them.
    """

    def __init__(self, atoms: Atoms, rows: Rows, base: FloatArray, held: IntArray = NONE) -> None:
        self.grid = atoms.grid
        self.held = held.size
        self.done = 0
        self.complete = False
        self._held = held
        scale, target = _scale_and_target(rows, base)
        self._start = float((target**2).sum())
        diagonal, full, pull, usable = begin(*atoms[4:], scale, target, ridge_of(self.grid.extents))
        self._system: tuple[Any, ...] = (*atoms[1:], scale, diagonal, full, usable, full.copy(), pull)
        self._basis = np.zeros((0, self.grid.size), np.float32)
        self._chosen, self._gains, self._right = np.zeros(0, np.int64), np.zeros(0), np.zeros(0)

    def extend(self, count: int) -> None:
        """Choose up to `count` centres in all; `complete` says that there were no more."""
        more = count - self._chosen.size
        if more <= 0 or self.complete:
            return
        self._basis = np.concatenate([self._basis, np.zeros((more, self.grid.size), np.float32)])
        self._chosen = np.concatenate([self._chosen, np.zeros(more, np.int64)])
        self._gains = np.concatenate([self._gains, np.zeros(more)])
        self._right = np.concatenate([self._right, np.zeros(more)])
        found = (self._basis, self._chosen, self._gains, self._right)
        arguments = (*self._system, *found, self.done, self._held)
        self.done = int(extend(*arguments))
        self.complete = self.done < count

    @property
    def atoms(self) -> IntArray:
        """(k,) indices into the grid."""
        return self._chosen[: self.done]

    @property
    def gains(self) -> FloatArray:
        """(k,) falls of the rows' sum of squares, mm²."""
        return self._gains[: self.done]

    @property
    def left(self) -> float:
        """What the rows' sum of squares still is, mm²."""
        return self._start - float(self.gains.sum())

    def field(self, count: int) -> ScaleField:
        """Return the scale field of the first `count` centres."""
        atoms = self._chosen[:count]
        weights = back_substituted(triangle_of(self._basis, atoms), self._right, count)
        order = np.argsort(atoms, kind="stable")
        return ScaleField(self.grid, atoms[order], weights[order])


@lru_cache(maxsize=8)
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
    """Return up to `count` centres that bring the leaf nearest to the rows, the `held` ones among them."""
    base = ellipsoid_radii(half_axes, rows.directions)
    selection = Selection(atoms_of(grid, rows.directions), rows, base, held)
    selection.extend(count)
    return selection


def costs_of_dropping(rows: Rows, leaf: ModelLeaf) -> FloatArray:
    """Return (k,) by how much the rows' sum of squares (mm²) rises when a leaf loses one of its centres."""
    field = leaf.scale_field
    centres, extents = np.ascontiguousarray(field.grid.centres[field.index]), field.grid.extents[field.index]
    scale, target = _scale_and_target(rows, base_radii(leaf, rows.directions))
    seen = chosen_rows(np.ascontiguousarray(local(leaf, rows.directions)), centres, extents)
    told = (scale > 0.0).astype(np.float64)
    nothing = np.zeros((scale.size, 0))
    pointer, index, value = seen
    matrix, right = normal_equations(pointer, index, value, scale, nothing, -target, told, field.index.size)
    diagonal = np.diag(matrix)
    ridge = ridge_of(extents) * diagonal.sum() / max((diagonal > 0.0).sum(), 1)
    costs: FloatArray = drop_costs(matrix + np.diag(ridge), right)
    return costs


def _scale_and_target(rows: Rows, q: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (n,) scale and target of the linear system that rows ask of the scale field; scale 0: nothing."""
    weights = np.where(rows.bound & (q >= rows.radii), 0.0, rows.weights)
    return weights * q, weights * (q - rows.radii)


def leaf_of(centre: FloatArray, half_axes: FloatArray, field: ScaleField) -> ModelLeaf:
    """Return the leaf: an ellipsoid on the tree's axes with a scale field."""
    return ModelLeaf(centre, NO_ROTATION, Superquadric(half_axes), field)
