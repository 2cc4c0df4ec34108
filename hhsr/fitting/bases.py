"""Exponents, knots and a turn are bought for a leaf where they bring more than as many centres (DESIGN §3)."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np

from hhsr.fitting.base import base_radii, local, richer_bases
from hhsr.fitting.scale_field import Selection, atoms_of
from hhsr.fitting.solid import Solid
from hhsr.fitting.task import Task, first_rows
from hhsr.model import CentreGrid, ModelLeaf, ScaleField

NUMBERS_A_CENTRE = 1.3
PAYS = 0.97


def base_that_pays(solid: Solid, task: Task, leaf: ModelLeaf, kinds: tuple[tuple[bool, int], ...]) -> ModelLeaf:
    """Return a leaf without its field, on the base that leaves the least sum of squares at the same count of numbers.

    leaf: on its ellipsoid, with the centres that it can afford. A richer base, of some `kinds`, has fewer of them.
    """
    grid, count = leaf.scale_field.grid, leaf.scale_field.index.size
    bare = replace(leaf, scale_field=ScaleField.none())
    along, radii = np.concatenate([task.along, task.behind]), np.concatenate([task.radii, task.hint])
    best, least = bare, PAYS * squares_left(solid, task, bare, grid, count)
    for tried in richer_bases(bare, along, radii, kinds):
        fewer = count - math.ceil((tried.parameters - bare.parameters) / NUMBERS_A_CENTRE)
        if fewer >= 0 and (left := squares_left(solid, task, tried, grid, fewer)) < least:
            best, least = tried, left
    return best


def squares_left(solid: Solid, task: Task, bare: ModelLeaf, grid: CentreGrid, count: int) -> float:
    """Return the sum of squares, mm², that a base and a number of centres leave of the first rows."""
    rows = first_rows(task, solid, bare)
    atoms = atoms_of(grid, local(bare, task.directions))
    selection = Selection(atoms, rows, base_radii(bare, task.directions))
    selection.extend(count)
    return selection.left
