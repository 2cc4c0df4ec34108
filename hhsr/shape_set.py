"""Many shapes asked at once: a scene's structures, each asked only where its box says that it may matter."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hhsr.answers import Crossings, broadcast_segments
from hhsr.check import as_float, as_points, require_finite
from hhsr.errors import InputError
from hhsr.model import FloatArray, IntArray
from hhsr.shape import Shape


class Nearest(NamedTuple):
    """The shape that each capsule comes closest to. which: (...) index into `names`. clearance: (...) mm to it."""

    which: IntArray
    clearance: FloatArray


class ShapeSet:
    """Named shapes in one frame, asked together.

    Parameters
    ----------
    shapes : name → shape, at least one

    The order of `names` is the order of the mapping, and of the first axis of every answer.
    """

    def __init__(self, shapes: Mapping[str, Shape]) -> None:
        if not shapes:
            raise InputError("shapes: got none, expected at least one shape by name")
        self.shapes = dict(shapes)
        self.names = tuple(self.shapes)
        boxes = np.array([shape.bounds for shape in self.shapes.values()])
        self._low, self._high = boxes[:, 0], boxes[:, 1]

    def __len__(self) -> int:
        return len(self.names)

    def contains(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return (shapes, ...) bool, which solids hold points (..., 3) mm."""
        array = as_points(points)
        require_finite(array, "points")
        flat = array.reshape(-1, 3)
        inside = np.zeros((len(self), len(flat)), dtype=bool)
        for k, shape in enumerate(self.shapes.values()):
            near = np.flatnonzero(((flat >= self._low[k]) & (flat <= self._high[k])).all(axis=1))
            if near.size:
                inside[k, near] = shape.contains(flat[near])
        return inside.reshape(len(self), *array.shape[:-1])

    def crossings(self, starts: ArrayLike, ends: ArrayLike) -> dict[str, Crossings]:
        """Return each shape's crossings with all segments (n, 3) → (n, 3)."""
        first, last, _ = broadcast_segments(starts, ends)
        require_finite(first, "starts")
        require_finite(last, "ends")
        found = {}
        for k, (name, shape) in enumerate(self.shapes.items()):
            near = np.flatnonzero(self._gap(k, first, last) <= 0.0)
            part = shape.crossings(first[near], last[near])
            counts = np.zeros(len(first), dtype=np.int64)
            counts[near] = np.diff(part.offsets)
            offsets = np.concatenate([[0], np.cumsum(counts)])
            found[name] = Crossings(offsets, part.t, part.points, part.entering, np.ones(len(first), dtype=bool))
        return found

    def clearance(self, starts: ArrayLike, ends: ArrayLike, radius: float = 0.0) -> FloatArray:
        """Return (shapes, ...) mm, every shape's clearance of capsules (`Shape.clearance`)."""
        first, last, shape_of = broadcast_segments(starts, ends)
        rows = [np.asarray(shape.clearance(first, last, radius)) for shape in self.shapes.values()]
        return np.array(rows).reshape(len(self), *shape_of)

    def nearest(self, starts: ArrayLike, ends: ArrayLike, radius: float = 0.0) -> Nearest:
        """Return which shape each capsule (..., 3) → (..., 3) comes closest to, and how close, mm.

        A shape is asked only where its box lies nearer than what others have shown.
        """
        first, last, shape_of = broadcast_segments(starts, ends)
        require_finite(first, "starts")
        require_finite(last, "ends")
        thick = as_float(radius, "radius", 0.0)
        gaps = np.array([self._gap(k, first, last) for k in range(len(self))])
        gaps = np.where(gaps > 0.0, gaps - thick, -np.inf)  # where boxes meet, nothing bounds the depth
        best, index = np.full(len(first), np.inf), np.full(len(first), -1)
        for k in np.argsort(np.maximum(gaps, -thick).mean(axis=1)) if len(first) else range(0):
            ask = np.flatnonzero((gaps[k] < best) | (index < 0))
            if ask.size:
                value = np.asarray(self.shapes[self.names[k]].clearance(first[ask], last[ask], thick))
                nearer = value < best[ask]
                best[ask[nearer]], index[ask[nearer]] = value[nearer], k
        return Nearest(_shaped(index, shape_of), _shaped(best, shape_of))

    def _gap(self, k: int, first: FloatArray, last: FloatArray) -> FloatArray:
        """Return (n,) a lower bound of the distance between segments and a shape's box; 0 where their boxes meet."""
        low, high = np.minimum(first, last), np.maximum(first, last)
        apart = np.maximum(0.0, np.maximum(self._low[k] - high, low - self._high[k]))
        return np.asarray(np.sqrt((np.nan_to_num(apart, nan=np.inf) ** 2).sum(axis=1)))


def _shaped(array: NDArray[Any], shape: tuple[int, ...]) -> Any:
    return array.reshape(shape) if shape else array.item()
