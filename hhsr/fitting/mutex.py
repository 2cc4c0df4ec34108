"""Mutex pairs: points that no convex part can hold, and how much each weighs (PAPER §3.1, DESIGN §1 and §3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hhsr.kernels.section import pair_weights, stack_pairs
from hhsr.model import FloatArray, IntArray, fibonacci_sphere, plane_frame

# A vessel tree has 10⁵ pairs that say the same thing; an even share of them finds the same planes.
MOST_FOUND = 400_000
MOST_WEIGHED = 3_000
MOST_PLANES = 96


class MutexPairs(NamedTuple):
    """points: (k, 2, 3) mm, the two points of each pair. weights: (k,) 1/mm."""

    points: FloatArray
    weights: FloatArray

    @property
    def total(self) -> float:
        return float(self.weights.sum())


def hemisphere(count: int) -> FloatArray:
    """Return (count, 3) unit normals spread evenly over a hemisphere (z > 0)."""
    return fibonacci_sphere(2 * count)[:count]


def mutex_pairs(
    vertices: FloatArray, faces: IntArray, capped: np.ndarray, threshold_mm: float, directions: int
) -> MutexPairs:
    """Return the mutex pairs of a closed part, each once, with the largest weight that any plane gave it.

    Contour maps are exact sections by planes one threshold apart (farther on a shape of more than 96 thresholds), with
    points at most a third of the threshold apart.

    Parameters
    ----------
    vertices, faces : (n, 3) mm, (m, 3) closed triangles.
    capped : (m,) bool, triangles that a cut has made: they connect what they connect, but are no surface of the shape.
    threshold_mm : t: contour points farther apart than this are not neighbours.
    directions : number of normals on the hemisphere.
    """
    normals = hemisphere(directions)
    frames = np.stack([plane_frame(n) for n in normals])
    extent = float(np.ptp(vertices, axis=0).max()) if vertices.size else 0.0
    if extent <= threshold_mm:
        return MutexPairs(np.zeros((0, 2, 3)), np.zeros(0))
    spacing = max(threshold_mm, extent / MOST_PLANES)
    triangles = np.ascontiguousarray(faces, dtype=np.int64)
    points, direction, _ = stack_pairs(
        np.ascontiguousarray(vertices),
        triangles,
        np.ascontiguousarray(capped),
        normals,
        np.ascontiguousarray(frames[:, 0]),
        np.ascontiguousarray(frames[:, 1]),
        spacing,
        threshold_mm,
        MOST_FOUND,
    )
    if points.shape[0] > MOST_WEIGHED:
        chosen = np.linspace(0, points.shape[0] - 1, MOST_WEIGHED).astype(np.int64)
        points, direction = points[chosen], direction[chosen]
    weights = pair_weights(
        np.ascontiguousarray(vertices),
        triangles,
        np.ascontiguousarray(capped),
        np.ascontiguousarray(points),
        np.ascontiguousarray(normals[direction]),
        threshold_mm,
    )
    return _without_repeats(points, weights, threshold_mm)


def _without_repeats(points: FloatArray, weights: FloatArray, threshold_mm: float) -> MutexPairs:
    """Keep of pairs that join the same two cells of half a threshold the heaviest; (X, Y) is the same as (Y, X)."""
    if points.shape[0] == 0:
        return MutexPairs(points, weights)
    cells = np.floor(points / (0.5 * threshold_mm)).astype(np.int64)
    swap = [tuple(a) > tuple(b) for a, b in cells]
    cells[swap] = cells[swap][:, ::-1]
    order = np.argsort(-weights, kind="stable")
    _, first = np.unique(cells[order].reshape(-1, 6), axis=0, return_index=True)
    kept = np.sort(order[first])
    return MutexPairs(points[kept], weights[kept])
