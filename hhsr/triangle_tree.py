"""Triangles that answer: nearest point, inside or not, every crossing of a segment, all exact."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hhsr.batches import in_parts
from hhsr.check import as_points, require_finite
from hhsr.errors import InputError
from hhsr.kernels import triangles as kernels
from hhsr.kernels.triangle_build import build

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

PARALLEL_ABOVE = 4096


class TriangleArrays(NamedTuple):
    """The tree as the kernels of `hhsr.kernels.triangles` take it; read-only.

    boxes: (k, 6) mm. links: (k, 2) int64, first and count. corners: (n, 3, 3) mm, in tree order. order: (n,) int64, the
    caller's face index.
    """

    boxes: FloatArray
    links: IntArray
    corners: FloatArray
    order: IntArray


class TriangleCrossings(NamedTuple):
    """Crossings of n segments; those of segment i are rows offsets[i] … offsets[i + 1], in order of t.

    offsets: (n + 1,). t: (m,) share of the segment, in [0, 1]. face: (m,). entering: (m,) bool, against the normal.
    """

    offsets: IntArray
    t: FloatArray
    face: IntArray
    entering: NDArray[np.bool_]


class TriangleTree:
    """A bounding-volume hierarchy over triangles.

    Parameters
    ----------
    vertices : (n, 3) mm, finite
    faces : (m, 3) indices of vertices; m may be 0. Closed, where `contains` and parity are to mean something.

    Raises
    ------
    InputError
        where shapes or indices do not fit, or a vertex is not finite.
    """

    def __init__(self, vertices: ArrayLike, faces: ArrayLike) -> None:
        points = as_points(vertices, "vertices").reshape(-1, 3)
        require_finite(points, "vertices")
        triangles = np.ascontiguousarray(faces, dtype=np.int64)
        if triangles.ndim != 2 or triangles.shape[1] != 3:
            raise InputError(f"faces: got shape {triangles.shape}, expected (m, 3)")
        if len(triangles) and (triangles.min() < 0 or triangles.max() >= len(points)):
            raise InputError(
                f"faces: indices {triangles.min()} … {triangles.max()}, expected 0 … {len(points) - 1}: one per vertex"
            )
        self.arrays = TriangleArrays(*build(points, triangles))
        for array in self.arrays:
            array.setflags(write=False)

    @property
    def bounds(self) -> FloatArray:
        """(2, 3) mm, lowest and highest corner; NaN where there is no triangle."""
        if len(self.arrays.order) == 0:
            return np.full((2, 3), np.nan)
        return np.array(self.arrays.boxes[0].reshape(2, 3))

    def closest(self, points: ArrayLike) -> tuple[FloatArray, FloatArray, IntArray]:
        """Return distance (...) mm ≥ 0, nearest point (..., 3) and its face (...) for points (..., 3).

        Without triangles: inf, NaN, −1.
        """
        shape, flat = _flat(points, "points")
        distance, nearest, face = np.empty(len(flat)), np.empty((len(flat), 3)), np.empty(len(flat), dtype=np.int64)
        if len(self.arrays.order) == 0:
            distance[:], nearest[:], face[:] = np.inf, np.nan, -1
        else:
            _fill(kernels.nearest_points, len(flat), self.arrays, (flat, distance, nearest, face))
        return distance.reshape(shape), nearest.reshape(*shape, 3), face.reshape(shape)

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return (...) whether the closed triangles hold each of points (..., 3); on a triangle is inside."""
        shape, flat = _flat(points, "points")
        inside = np.empty(len(flat), dtype=np.bool_)
        boxes, links, corners, _ = self.arrays
        _fill(kernels.inside_points, len(flat), (boxes, links, corners), (flat, inside))
        return inside.reshape(shape)

    def crossings(self, starts: ArrayLike, ends: ArrayLike) -> TriangleCrossings:
        """Return all crossings of segments (n, 3) → (n, 3); for closed triangles an even number between outside points.

        A segment that meets a vertex, an edge or a face's plane is taken as if moved by (ε, ε², ε³), ε → 0.
        """
        first, last = _pair(starts, ends)
        offsets, t, face, out = kernels.all_crossings(*self.arrays, first, last)
        return TriangleCrossings(offsets, t, face, out < 0)

    def first_hit(
        self, origins: ArrayLike, directions: ArrayLike, max_t: float = np.inf
    ) -> tuple[FloatArray, IntArray]:
        """Return t (n,) and face (n,) of the first triangle on origin + t · direction, 0 ≤ t ≤ max_t; NaN, −1: none.

        t is in units of the direction's length: mm for unit directions.
        """
        first, along = _pair(origins, directions)
        if not max_t > 0:
            raise InputError(f"max_t: got {max_t}, expected a number > 0")
        if len(self.arrays.order) == 0:
            return np.full(len(first), np.nan), np.full(len(first), -1)
        length = np.sqrt((along * along).sum(axis=1))
        reach = np.sqrt((np.maximum(np.abs(first - self.bounds[0]), np.abs(first - self.bounds[1])) ** 2).sum(axis=1))
        with np.errstate(divide="ignore", invalid="ignore"):
            limit = np.where(length > 0, np.minimum(max_t, 1.01 * reach / length + 1e-6), 0.0)
        t, face = np.empty(len(first)), np.empty(len(first), dtype=np.int64)
        _fill(kernels.first_crossings, len(first), self.arrays, (first, first + limit[:, None] * along, t, face))
        return t * limit, face


def _flat(points: ArrayLike, name: str) -> tuple[tuple[int, ...], FloatArray]:
    array = as_points(points, name)
    require_finite(array, name)
    return array.shape[:-1], array.reshape(-1, 3)


def _pair(starts: ArrayLike, ends: ArrayLike) -> tuple[FloatArray, FloatArray]:
    first, last = _flat(starts, "starts")[1], _flat(ends, "ends")[1]
    if first.shape != last.shape:
        raise InputError(f"starts and ends: got {first.shape} and {last.shape}, expected one end for each start")
    return first, last


def _fill(kernel: Callable[..., None], count: int, tree: tuple[Any, ...], columns: tuple[NDArray[Any], ...]) -> None:
    """Run a kernel that fills its last arguments row by row; on several threads where there are many rows."""
    in_parts(count, PARALLEL_ABOVE // 2, lambda i, j: kernel(*tree, *(column[i:j] for column in columns)))
