"""A decimated mesh compressed by Draco: vertices quantised, connectivity by Edgebreaker; the best for a file's size."""

from __future__ import annotations

import DracoPy
import numpy as np

from hhsr.baselines.decimated_mesh import decimate
from hhsr.baselines.distances import mesh_error
from hhsr.errors import FitError
from hhsr.model import FloatArray, IntArray

BITS = (8, 9, 10, 11, 12)
ROUGH_SAMPLES = 4000
STEPS = 9


def fit_draco(
    vertices: FloatArray, faces: IntArray, max_bytes: int, seed: int = 0
) -> tuple[FloatArray, IntArray, int, int]:
    """Return the mesh that a Draco file of at most `max_bytes` gives back, three numbers a vertex, and the file's size.

    For every quantisation the most vertices that fit are sought; the one whose mesh is nearest to the source is kept.
    """
    best: tuple[float, FloatArray, IntArray, int] | None = None
    for bits in BITS:
        found = _largest(vertices, faces, max_bytes, bits)
        if found is None:
            continue
        points, triangles = _decoded(found)
        error = mesh_error(points, triangles, vertices, faces, ROUGH_SAMPLES, seed).mean_mm
        if best is None or error < best[0]:
            best = (error, points, triangles, len(found))
    if best is None:
        raise FitError(f"max_bytes: got {max_bytes}, too few for any Draco file of this surface")
    return best[1], best[2], 3 * len(best[1]), best[3]


def _largest(vertices: FloatArray, faces: IntArray, max_bytes: int, bits: int) -> bytes | None:
    """Return the file of the finest decimation that fits, by bisection on the number of vertices."""
    low, high = 4, min(len(vertices), max_bytes)
    found = None
    for _ in range(STEPS):
        middle = (low + high) // 2
        mesh = decimate(vertices, faces, middle)
        if mesh is None:
            low = middle
            continue
        points, triangles = mesh[0].astype(np.float32), mesh[1].astype(np.uint32)
        data = DracoPy.encode(points, triangles, quantization_bits=bits, compression_level=10)
        if len(data) <= max_bytes:
            found, low = data, middle
        else:
            high = middle
    return found


def _decoded(data: bytes) -> tuple[FloatArray, IntArray]:
    mesh = DracoPy.decode(data)
    return np.asarray(mesh.points, dtype=np.float64), np.asarray(mesh.faces, dtype=np.int64)
