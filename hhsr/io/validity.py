"""What a tree must be before it is written, and after it is read: shapes, ranges and counts of every stored number."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from numpy.typing import ArrayLike

from hhsr.errors import HhsrError
from hhsr.io.tree import MAX_GRID
from hhsr.model import MAX_DEPTH, Contour, Cut, ModelLeaf, Node, RetainedPart, Tree


class _Invalid(Exception):
    pass


def require_valid(tree: Tree, error: type[HhsrError]) -> None:
    """Raise `error`, saying which record breaks which rule, unless the tree is one that can be asked."""
    try:
        _finite(tree.pose, (6,), "the tree's pose")
        _node(tree.root, "root", 0)
    except _Invalid as problem:
        raise error(f"not a valid HHSR tree: {problem}") from None


def _node(node: Node, where: str, depth: int) -> None:
    if isinstance(node, Cut):
        if depth == MAX_DEPTH:
            raise _Invalid(f"deeper than {MAX_DEPTH} cuts at {where}")
        _cut(node, where)
        _node(node.left, f"{where}.left", depth + 1)
        _node(node.right, f"{where}.right", depth + 1)
    elif isinstance(node, ModelLeaf):
        _model(node, where)
    elif isinstance(node, RetainedPart):
        _retained(node, where)
    else:
        raise _Invalid(f"{where} is a {type(node).__name__}, expected Cut, ModelLeaf or RetainedPart")


def _cut(cut: Cut, where: str) -> None:
    _finite(cut.normal_angles, (2,), f"{where}.normal_angles")
    _finite(cut.offset, (), f"{where}.offset")
    _finite(cut.half_width, (), f"{where}.half_width")
    if cut.half_width < 0:
        raise _Invalid(f"{where}.half_width is {cut.half_width} mm, expected ≥ 0")
    if cut.half_width == 0 and cut.contours:
        raise _Invalid(f"{where} has no band and {len(cut.contours)} contours, expected none")
    for i, contour in enumerate(cut.contours):
        _contour(contour, f"{where}.contours[{i}]")


def _contour(contour: Contour, where: str) -> None:
    _finite(contour.centre, (2,), f"{where}.centre")
    _positive(contour.half_axes, 4, f"{where}.half_axes")
    _knots(contour.logits, (2,), f"{where}.logits")
    _finite(contour.weights, (np.size(contour.weights),), f"{where}.weights")


def _model(leaf: ModelLeaf, where: str) -> None:
    _finite(leaf.centre, (3,), f"{where}.centre")
    if np.size(leaf.rotation):
        _finite(leaf.rotation, (3,), f"{where}.rotation")
    base, scale = leaf.superquadric, leaf.scale_field
    _positive(base.half_axes, 6, f"{where}.half_axes")
    _knots(base.azimuth_logits, (2,), f"{where}.azimuth_logits")
    _knots(base.elevation_logits, (), f"{where}.elevation_logits")
    grid = scale.grid
    if not (np.isfinite(grid.support) and grid.support > 0 and all(size > 0 for size in grid.sizes)):
        raise _Invalid(f"{where}: a centre grid of sizes {grid.sizes} and support {grid.support}, expected all > 0")
    if grid.size > MAX_GRID:
        raise _Invalid(f"{where}: a grid of {grid.size} centres, expected at most {MAX_GRID}")
    index = np.asarray(scale.index)
    _finite(scale.weights, (index.size,), f"{where}.weights")
    if index.size and (index.min() < 0 or index.max() >= grid.size or (np.diff(index) <= 0).any()):
        raise _Invalid(f"{where}: centre indices must ascend within [0, {grid.size})")


def _retained(part: RetainedPart, where: str) -> None:
    faces = np.asarray(part.faces)
    _finite(part.vertices, (len(part.vertices), 3), f"{where}.vertices")
    if faces.ndim != 2 or faces.shape[1] != 3:
        raise _Invalid(f"{where}.faces has shape {faces.shape}, expected (m, 3)")
    if faces.size and (faces.min() < 0 or faces.max() >= len(part.vertices)):
        raise _Invalid(f"{where}.faces names vertices outside [0, {len(part.vertices)})")
    edges = np.sort(np.concatenate([faces[:, [i, j]] for i, j in pairwise((0, 1, 2, 0))]), axis=1)
    if edges.size and (np.unique(edges @ np.array([len(part.vertices), 1]), return_counts=True)[1] % 2).any():
        raise _Invalid(f"{where} is not closed: an edge has an odd number of triangles")


def _finite(value: ArrayLike, shape: tuple[int, ...], name: str) -> None:
    array = np.asarray(value)
    if array.shape != shape:
        raise _Invalid(f"{name} has shape {array.shape}, expected {shape}")
    if not np.isfinite(array).all():
        raise _Invalid(f"{name} is not finite")


def _positive(value: ArrayLike, size: int, name: str) -> None:
    _finite(value, (size,), name)
    if (np.asarray(value) <= 0).any():
        raise _Invalid(f"{name} must be > 0, got {np.asarray(value).min()}")


def _knots(value: ArrayLike, refused: tuple[int, ...], name: str) -> None:
    _finite(value, (np.size(value),), name)
    if np.size(value) in refused:
        raise _Invalid(f"{name} has {np.size(value)} knots, which makes no spline: expected 0, 1 or at least 3")
