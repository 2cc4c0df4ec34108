"""A mesh decimated by quadric error: three numbers a vertex, connectivity free, in its favour."""

from __future__ import annotations

import fast_simplification
import numpy as np

from hhsr.baselines.distances import mesh_error
from hhsr.errors import FitError
from hhsr.model import FloatArray, IntArray

# How fast the collapse threshold grows from pass to pass: slow is better, too slow never gets there. The best is kept.
AGGRESSION = (4, 5, 6, 7)
SIZE = 100.0  # the library's thresholds are absolute: every surface is decimated at this size
ROUGH_SAMPLES = 4000


def fit_decimated_mesh(
    vertices: FloatArray, faces: IntArray, max_parameters: int, seed: int = 0
) -> tuple[FloatArray, IntArray, int]:
    """Return the best decimated mesh of at most max_parameters / 3 vertices, and its numbers."""
    most = max_parameters // 3
    if most < 4:
        raise FitError(f"max_parameters: got {max_parameters}, expected at least 12: a tetrahedron")
    meshes = [mesh for aggression in AGGRESSION if (mesh := decimate(vertices, faces, most, aggression)) is not None]
    if not meshes:
        raise FitError(f"max_parameters: got {max_parameters}, and no decimation of this surface is that small")
    errors = [mesh_error(*mesh, vertices, faces, ROUGH_SAMPLES, seed).mean_mm for mesh in meshes]
    points, triangles = meshes[int(np.argmin(errors))]
    return points, triangles, 3 * len(points)


def decimate(
    vertices: FloatArray, faces: IntArray, most_vertices: int, aggression: int = 7
) -> tuple[FloatArray, IntArray] | None:
    """Return a mesh of at most `most_vertices`, as near to that as the edge collapses allow; None if they do not."""
    if len(vertices) <= most_vertices:
        return np.asarray(vertices), np.asarray(faces)
    middle, scale = vertices.mean(axis=0), SIZE / float(np.ptp(vertices, axis=0).max())
    points_in, faces_in = (vertices - middle) * scale, np.array(faces, dtype=np.int64)  # the library wants to write
    target = 2 * most_vertices
    for _ in range(8):
        found = fast_simplification.simplify(points_in, faces_in, target_count=max(target, 4), agg=aggression)
        used, inverse = np.unique(found[1], return_inverse=True)
        if used.size <= most_vertices:
            points = np.asarray(found[0], dtype=np.float64)[used] / scale + middle
            return points, inverse.reshape(-1, 3).astype(np.int64)
        target -= max(2 * (used.size - most_vertices), 2)
        if target < 4:
            return None
    return None
