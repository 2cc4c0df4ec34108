"""Two-sided true distances between two meshes, by the same rule as a fit's own figures."""

from __future__ import annotations

import numpy as np

from hhsr.errors import SurfaceError
from hhsr.fitting.report import figures_of
from hhsr.fitting.samples import area_samples
from hhsr.model import ErrorFigures, FloatArray, IntArray
from hhsr.triangle_tree import TriangleTree


def mesh_error(
    vertices: FloatArray,
    faces: IntArray,
    source_vertices: FloatArray,
    source_faces: IntArray,
    samples: int = 20_000,
    seed: int = 0,
) -> ErrorFigures:
    """Return mean, 95th percentile and maximum of the distance, mm: area-uniform samples each way, pooled.

    vertices, faces : of the fit; source_vertices, source_faces : of what it was fitted to. samples : on each side.
    A fit without surface is as far from its source as the source is large.
    """
    if not len(faces):
        nothing = float(np.linalg.norm(np.ptp(source_vertices, axis=0)))
        return ErrorFigures(nothing, nothing, nothing)
    try:
        on_fit = area_samples(vertices, faces, samples, seed + 1).points
    except SurfaceError:
        return mesh_error(vertices, faces[:0], source_vertices, source_faces)
    on_source = area_samples(source_vertices, source_faces, samples, seed).points
    there = TriangleTree(vertices, faces).closest(on_source)[0]
    back = TriangleTree(source_vertices, source_faces).closest(on_fit)[0]
    return figures_of(np.concatenate([there, back]))
