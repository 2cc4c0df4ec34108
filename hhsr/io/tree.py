"""A tree of records to bytes and back: first its structure, then its numbers, one column per kind of number.

Columns (all leaves' weights together, all half axes together, …) share one block's scale where that is shorter than a
block for each array, so a few numbers per leaf do not each pay for a head.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from hhsr.errors import FileFormatError
from hhsr.io.blocks import FloatArray, IntArray, Reader, Writer, float_block
from hhsr.io.subset import rank_of_subset, subset_bytes, subset_of_rank
from hhsr.model import (
    MAX_DEPTH,
    CentreGrid,
    Contour,
    Cut,
    ModelLeaf,
    Node,
    RetainedPart,
    ScaleField,
    Superquadric,
    Tree,
    cuts,
    frozen,
    leaves,
)

_MODEL, _MODEL_ROTATED, _RETAINED, _CUT = range(4)
MAX_GRID = 65536
_TOGETHER, _EACH = range(2)


class _Model(NamedTuple):
    rotated: int
    azimuth: int
    elevation: int
    grid: int
    chosen: int


class _Retained(NamedTuple):
    vertices: int
    faces: int


class _Inner(NamedTuple):
    contours: tuple[tuple[int, int], ...]  # knots, weights of each
    left: _Shape
    right: _Shape


_Shape = _Model | _Retained | _Inner


def write_tree(writer: Writer, tree: Tree) -> None:
    """Append a valid tree."""
    models = [leaf for leaf in leaves(tree.root) if isinstance(leaf, ModelLeaf)]
    parts = [leaf for leaf in leaves(tree.root) if isinstance(leaf, RetainedPart)]
    inner = list(cuts(tree.root))
    contours = [contour for cut in inner for contour in cut.contours]
    fields = [model.scale_field for model in models]
    grids = list(dict.fromkeys(field.grid for field in fields))
    writer.varint(len(grids))
    for grid in grids:
        writer.varint(len(grid.sizes))
        for size in grid.sizes:
            writer.varint(size)
    _write_structure(writer, tree.root, grids)
    for column in (
        [[grid.support for grid in grids]],
        [tree.pose[:3]],
        [tree.pose[3:]],
        [cut.normal_angles for cut in inner],
        [[cut.offset] for cut in inner],
        [[cut.half_width] for cut in inner],
        [contour.centre for contour in contours],
        [contour.half_axes for contour in contours],
        [contour.logits for contour in contours],
        [contour.weights for contour in contours],
        [model.centre for model in models],
        [model.rotation for model in models],
        [model.superquadric.half_axes for model in models],
        [model.superquadric.azimuth_logits for model in models],
        [model.superquadric.elevation_logits for model in models],
        [field.weights for field in fields],
        [part.vertices for part in parts],
    ):
        _write_column(writer, column)
    for field in fields:
        writer.raw(min(_whole_choice(field), _choice_by_level(field), key=len))
    for part in parts:
        writer.integers(part.faces.ravel(), len(part.vertices))


def _write_structure(writer: Writer, node: Node, grids: list[CentreGrid]) -> None:
    if isinstance(node, Cut):
        writer.varint(_CUT)
        writer.varint(len(node.contours))
        for contour in node.contours:
            writer.varint(contour.logits.size)
            writer.varint(contour.weights.size)
        _write_structure(writer, node.left, grids)
        _write_structure(writer, node.right, grids)
    elif isinstance(node, RetainedPart):
        writer.varint(_RETAINED)
        writer.varint(len(node.vertices))
        writer.varint(len(node.faces))
    else:
        writer.varint(_MODEL_ROTATED if node.rotation.size else _MODEL)
        writer.varint(node.superquadric.azimuth_logits.size)
        writer.varint(node.superquadric.elevation_logits.size)
        writer.varint(grids.index(node.scale_field.grid))
        writer.varint(node.scale_field.index.size)


def _write_column(writer: Writer, arrays: Sequence[ArrayLike]) -> None:
    columns = [np.asarray(array, dtype=np.float64).ravel() for array in arrays]
    if not sum(column.size for column in columns):
        return
    together = float_block(np.concatenate(columns))
    each = b"".join(float_block(column) for column in columns)
    writer.varint(_EACH if len(each) < len(together) else _TOGETHER)
    writer.raw(min(together, each, key=len))


def _read_column(reader: Reader, sizes: list[int]) -> Iterator[FloatArray]:
    if not sum(sizes):
        return iter([np.zeros(0) for _ in sizes])
    layout = reader.varint()
    if layout == _EACH:
        return iter([frozen(reader.floats(size)) for size in sizes])
    if layout != _TOGETHER:
        raise FileFormatError(f"a column's layout is {layout}, expected {_TOGETHER} or {_EACH}")
    ends = np.cumsum(sizes)[:-1]
    return iter([frozen(column) for column in np.split(reader.floats(sum(sizes)), ends)])


def read_tree(reader: Reader) -> Tree:
    """Return the tree that `write_tree` wrote; FileFormatError where the bytes make none. Values: see `validity`."""
    sizes = [tuple(reader.varint() for _ in range(_count(reader))) for _ in range(_count(reader))]
    for grid in sizes:
        if sum(grid) > MAX_GRID:
            raise FileFormatError(f"a grid of {sum(grid)} scale-field centres, expected at most {MAX_GRID}")
    shape = _read_structure(reader, len(sizes), 0)
    models = [node for node in _flat(shape) if isinstance(node, _Model)]
    parts = [node for node in _flat(shape) if isinstance(node, _Retained)]
    inner = [node for node in _flat(shape) if isinstance(node, _Inner)]
    lobes = [lobe for cut in inner for lobe in cut.contours]
    support = _read_column(reader, [len(sizes)])
    grids = [CentreGrid(grid, float(s)) for grid, s in zip(sizes, next(support), strict=True)]
    rotation, translation = next(_read_column(reader, [3])), next(_read_column(reader, [3]))
    cut_columns = [_read_column(reader, [size] * len(inner)) for size in (2, 1, 1)]
    contour_columns = [_read_column(reader, [size] * len(lobes)) for size in (2, 4)]
    contour_columns += [_read_column(reader, [lobe[i] for lobe in lobes]) for i in (0, 1)]
    contours = iter([Contour(*arrays) for arrays in zip(*contour_columns, strict=True)])
    centres = _read_column(reader, [3] * len(models))
    rotations = _read_column(reader, [3 * model.rotated for model in models])
    bases = [_read_column(reader, [6] * len(models))]
    bases += [_read_column(reader, [model[i] for model in models]) for i in (1, 2)]
    weights = _read_column(reader, [model.chosen for model in models])
    vertices = _read_column(reader, [3 * part.vertices for part in parts])
    fields = iter([_read_field(reader, grids[model.grid], next(weights)) for model in models])
    superquadrics = iter([Superquadric(*arrays) for arrays in zip(*bases, strict=True)])
    retained = iter([_read_part(reader, part, next(vertices)) for part in parts])

    def assemble(node: _Shape) -> Node:
        if isinstance(node, _Retained):
            return next(retained)
        if isinstance(node, _Model):
            return ModelLeaf(next(centres), next(rotations), next(superquadrics), next(fields))
        angles, offset, half_width = (next(column) for column in cut_columns)
        own = tuple(next(contours) for _ in node.contours)
        left = assemble(node.left)
        return Cut(angles, float(offset[0]), float(half_width[0]), own, left, assemble(node.right))

    return Tree(assemble(shape), frozen(np.concatenate([rotation, translation])))


def _whole_choice(field: ScaleField) -> bytes:
    """Return a layout byte and which centres are used as one number below C(all centres, used)."""
    return bytes([_TOGETHER]) + _rank(field.index, field.grid.size)


def _choice_by_level(field: ScaleField) -> bytes:
    """Return a layout byte, and how many and which centres of each level: shorter, as coarse levels are used more."""
    writer = Writer()
    writer.varint(_EACH)
    first = 0
    for size in field.grid.sizes:
        inside = field.index[(field.index >= first) & (field.index < first + size)] - first
        writer.varint(inside.size)
        writer.raw(_rank(inside, size))
        first += size
    return writer.written()


def _rank(index: IntArray, total: int) -> bytes:
    return rank_of_subset(index, total).to_bytes(subset_bytes(total, index.size), "big")


def _count(reader: Reader) -> int:
    """Return a count of things of which each takes a byte at least."""
    count = reader.varint()
    if count > reader.left:
        raise FileFormatError(f"{count} things are announced, and {reader.left} bytes are left")
    return count


def _read_structure(reader: Reader, grids: int, depth: int) -> _Shape:
    kind = reader.varint()
    if kind == _CUT:
        if depth == MAX_DEPTH:
            raise FileFormatError(f"the tree is deeper than {MAX_DEPTH} cuts")
        contours = tuple((reader.varint(), reader.varint()) for _ in range(_count(reader)))
        left = _read_structure(reader, grids, depth + 1)
        return _Inner(contours, left, _read_structure(reader, grids, depth + 1))
    if kind == _RETAINED:
        return _Retained(reader.varint(), reader.varint())
    if kind not in (_MODEL, _MODEL_ROTATED):
        raise FileFormatError(f"a node is of kind {kind}, expected 0 to {_CUT}")
    model = _Model(int(kind == _MODEL_ROTATED), reader.varint(), reader.varint(), reader.varint(), reader.varint())
    if model.grid >= grids:
        raise FileFormatError(f"a leaf uses grid {model.grid} of {grids}")
    return model


def _flat(node: _Shape) -> Iterator[_Shape]:
    yield node
    if isinstance(node, _Inner):
        yield from _flat(node.left)
        yield from _flat(node.right)


def _read_field(reader: Reader, grid: CentreGrid, weights: FloatArray) -> ScaleField:
    layout = reader.varint()
    if layout == _TOGETHER:
        index = _read_choice(reader, grid.size, weights.size)
    elif layout == _EACH:
        levels, first = [np.zeros(0, dtype=np.int64)], 0
        for size in grid.sizes:
            levels.append(_read_choice(reader, size, reader.varint()) + first)
            first += size
        index = np.concatenate(levels)
    else:
        raise FileFormatError(f"a choice of centres has layout {layout}, expected {_TOGETHER} or {_EACH}")
    if index.size != weights.size:
        raise FileFormatError(f"a leaf has {index.size} scale-field centres and {weights.size} weights")
    return ScaleField(grid, frozen(index, np.int64), weights)


def _read_choice(reader: Reader, total: int, chosen: int) -> IntArray:
    if chosen > total:
        raise FileFormatError(f"a leaf has {chosen} scale-field centres out of {total}")
    rank = int.from_bytes(reader.raw(subset_bytes(total, chosen)), "big")
    if rank >= math.comb(total, chosen):
        raise FileFormatError(f"a leaf's choice of {chosen} centres out of {total} has a rank out of range")
    return subset_of_rank(rank, total, chosen)


def _read_part(reader: Reader, part: _Retained, vertices: FloatArray) -> RetainedPart:
    faces = reader.integers(3 * part.faces, part.vertices)
    return RetainedPart(frozen(vertices.reshape(-1, 3)), frozen(faces.reshape(-1, 3), np.int64))
