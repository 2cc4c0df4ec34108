"""The error of a fit where it is asked for: the sampled maximum of a leaf's cell of directions (DESIGN §3).

A file keeps one character a cell in its report, 24 cells a leaf: steps of √2 below the shape's largest error,
rounded up. A margin near one spot need not obey a spike elsewhere.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from hhsr.errors import InputError
from hhsr.model import Cut, ErrorFigures, FloatArray, IntArray, ModelLeaf, Node, Tree, leaves, rotation_matrix

EDGE = 2
CELLS = 6 * EDGE * EDGE
STEPS_A_HALVING = 2
LETTERS = "0123456789ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz"
KEY = "cells"


def owners(tree: Tree, points: FloatArray) -> IntArray:
    """Return (n,) the leaf whose region holds each of (n, 3) LPS points, a band counted to its nearer side."""
    out = np.zeros(points.shape[0], dtype=np.int64)
    _descend(tree.root, in_tree(tree, points), np.arange(points.shape[0]), out, 0)
    return out


def in_tree(tree: Tree, points: FloatArray) -> FloatArray:
    """Return (n, 3) LPS points in the tree's frame."""
    local: FloatArray = (points - tree.pose[3:]) @ rotation_matrix(tree.pose[:3])
    return local


def cells_of(tree: Tree, points: FloatArray) -> IntArray:
    """Return (n,) CELLS · leaf + cell of (n, 3) LPS points: which leaf holds a point, and where it is seen from there.

    A cell is a quarter of a face of the cube about the leaf's centre; a retained part is one cell.
    """
    owner = owners(tree, points)
    local = in_tree(tree, points)
    cell = np.zeros(points.shape[0], dtype=np.int64)
    for number, leaf in enumerate(leaves(tree.root)):
        own = np.flatnonzero(owner == number)
        if isinstance(leaf, ModelLeaf):
            cell[own] = _cube_cell(local[own] - leaf.centre)
    found: IntArray = CELLS * owner + cell
    return found


def encoded(largest: FloatArray, whole: ErrorFigures, leaf_errors: Sequence[ErrorFigures]) -> str:
    """Return the letters of the largest error (leaves · CELLS,) mm of each cell; NaN: no sample, its leaf's largest."""
    leaf = np.repeat([figures.max_mm for figures in leaf_errors], CELLS)
    known = np.where(np.isfinite(largest), largest, leaf)
    if not whole.max_mm > 0.0:
        return LETTERS[0] * known.size
    steps = np.floor(-np.log2(np.maximum(known, 1e-9 * whole.max_mm) / whole.max_mm) * STEPS_A_HALVING + 1e-9)
    return "".join(LETTERS[k] for k in np.clip(steps, 0, len(LETTERS) - 1).astype(int))


def errors_at(
    tree: Tree,
    whole: ErrorFigures | None,
    leaf_errors: Sequence[ErrorFigures],
    report: Mapping[str, Any],
    points: FloatArray,
) -> FloatArray:
    """Return (n,) mm at (n, 3) LPS points: the sampled maximum of the cell, else of the leaf, else of the shape.

    Raises
    ------
    InputError : the shape's error was never measured.
    """
    if whole is None:
        raise InputError("fit_error_at: this shape's error was not measured; expected one that hhsr.fit made")
    count = sum(1 for _ in leaves(tree.root))
    letters = report.get(KEY)
    if isinstance(letters, str) and len(letters) == count * CELLS and set(letters) <= set(LETTERS):
        steps = np.array([LETTERS.index(letter) for letter in letters])
        known = whole.max_mm * 2.0 ** (-steps / STEPS_A_HALVING)
    elif len(leaf_errors) == count:
        known = np.repeat([figures.max_mm for figures in leaf_errors], CELLS)
    else:
        known = np.full(count * CELLS, whole.max_mm)
    out: FloatArray = known[cells_of(tree, points)]
    return out


def _cube_cell(offsets: FloatArray) -> IntArray:
    """Return (n,) the cell of (n, 3) offsets from a centre."""
    axis = np.abs(offsets).argmax(axis=1)
    rows = np.arange(offsets.shape[0])
    face = 2 * axis + (offsets[rows, axis] < 0.0)
    first = offsets[rows, (axis + 1) % 3] >= 0.0
    second = offsets[rows, (axis + 2) % 3] >= 0.0
    cell: IntArray = (face * EDGE + first) * EDGE + second
    return cell


def _descend(node: Node, points: FloatArray, index: IntArray, out: IntArray, number: int) -> int:
    """Write the number of the leaf for the chosen points; return the number of the next leaf."""
    if not isinstance(node, Cut):
        out[index] = number
        return number + 1
    right = points[index] @ node.normal - node.offset >= 0.0
    number = _descend(node.left, points, index[~right], out, number)
    return _descend(node.right, points, index[right], out, number)
