"""How well a fit fits, measured on what is stored: two-sided true distances, per leaf, per cut (DESIGN §3)."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import trimesh

from hhsr.fitting.samples import area_samples, face_areas
from hhsr.local_error import CELLS, KEY, cells_of, encoded, owners
from hhsr.model import ErrorFigures, FloatArray, IntArray, ModelLeaf, Tree, cuts, leaves
from hhsr.read.quality import measure_quality
from hhsr.surface import Step
from hhsr.triangle_tree import TriangleTree

if TYPE_CHECKING:
    from hhsr.shape import Shape

SIGNIFICANT = 5


class Measured(NamedTuple):
    """error: over all samples of both sides. leaf_errors: in the order of `hhsr.model.leaves`. report: JSON values."""

    error: ErrorFigures
    leaf_errors: tuple[ErrorFigures, ...]
    report: Mapping[str, Any]


def measure(
    shape: Shape, source_vertices: FloatArray, source_faces: IntArray, samples: int = 20_000, seed: int = 0
) -> Measured:
    """Return how far a shape and its source are apart, mm, and what its cuts and its topology are like.

    Area-uniform samples of the source against `shape.mesh()` and of the mesh against the source, each to its exact
    nearest point, pooled. A sample counts for every leaf (and cell: `hhsr.local_error`) that holds it or its nearest
    point.

    Parameters
    ----------
    shape : what was fitted, as stored.
    source_vertices, source_faces : (n, 3) mm, LPS, and (m, 3): closed triangles.
    samples : on each side.
    seed : of the samples.

    An empty solid is as far from its source as the source is large: every sample counts the source's extent.
    """
    mesh = shape.mesh()
    tree: Tree = shape.tree
    count = sum(1 for _ in leaves(tree.root))
    report: dict[str, Any] = {
        "cuts": cut_figures(tree, mesh),
        "topology": topology(source_vertices, source_faces, mesh),
    }
    if len(mesh.faces) == 0:
        nothing = float(np.linalg.norm(np.ptp(source_vertices, axis=0)))
        figures = ErrorFigures(nothing, nothing, nothing)
        return Measured(figures, (figures,) * count, report)
    distance, points, feet = _distances(mesh, source_vertices, source_faces, samples, seed)
    owner, other = owners(tree, points), owners(tree, feet)
    whole = figures_of(distance)
    per_leaf = tuple(figures_of(distance[(owner == i) | (other == i)]) for i in range(count))
    spacing = float(np.sqrt(face_areas(source_vertices, source_faces).sum() / samples))
    report[KEY] = encoded(
        _largest_of_cells(tree, np.concatenate([points, feet]), np.tile(distance, 2), spacing), whole, per_leaf
    )
    return Measured(whole, per_leaf, report)


def error_of(
    shape: Shape, source_vertices: FloatArray, source_faces: IntArray, samples: int = 20_000, seed: int = 0
) -> ErrorFigures:
    """Return how far a shape and its source are apart, mm, as `measure` has it."""
    mesh = shape.mesh()
    if len(mesh.faces) == 0:
        return ErrorFigures(*[float(np.linalg.norm(np.ptp(source_vertices, axis=0)))] * 3)
    return figures_of(_distances(mesh, source_vertices, source_faces, samples, seed)[0])


def _distances(
    mesh: trimesh.Trimesh, vertices: FloatArray, faces: IntArray, samples: int, seed: int
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return distances (2n,) mm, points (2n, 3) on source and mesh, and the point of the other nearest to each."""
    on_source = area_samples(vertices, faces, samples, seed).points
    on_mesh = area_samples(np.asarray(mesh.vertices), np.asarray(mesh.faces), samples, seed + 1).points
    there, foot, _ = TriangleTree(mesh.vertices, mesh.faces).closest(on_source)
    back, root_foot, _ = TriangleTree(vertices, faces).closest(on_mesh)
    points, feet = np.concatenate([on_source, on_mesh]), np.concatenate([foot, root_foot])
    return np.concatenate([there, back]), points, feet


def _largest_of_cells(tree: Tree, points: FloatArray, distance: FloatArray, spacing: float) -> FloatArray:
    """Return the largest error (leaves · CELLS,) mm of the samples in or beside each cell; −inf: none.

    A sample counts in every cell less than two spacings away along an axis: a peak between two samples may lie in
    another cell than they do.
    """
    largest = np.full(CELLS * sum(1 for _ in leaves(tree.root)), -np.inf)
    for step in (np.zeros((1, 3)), 2.0 * spacing * np.eye(3), -2.0 * spacing * np.eye(3)):
        for shift in step:
            np.maximum.at(largest, cells_of(tree, points + shift), distance)
    return largest


def figures_of(distance: FloatArray) -> ErrorFigures:
    """Return mean, 95th percentile and maximum of distances (n,) mm; 0 where a leaf has no surface at all."""
    if distance.size == 0:
        return ErrorFigures(0.0, 0.0, 0.0)
    return ErrorFigures(float(distance.mean()), float(np.percentile(distance, 95.0)), float(distance.max()))


def cut_figures(tree: Tree, mesh: trimesh.Trimesh) -> list[dict[str, Any]]:
    """Return per cut, parents first: half width d, lobes, area of its step faces, and the largest step.

    The largest step is how far a point of a step face lies from the nearest surface that is none, mm (sampled).
    """
    rows = []
    source = np.asarray(mesh.face_attributes["source"])
    kinds = mesh.metadata["sources"]
    step_of = np.array([s.cut if isinstance(s, Step) else -1 for s in kinds] or [-1])[source]
    vertices, faces = np.asarray(mesh.vertices), np.asarray(mesh.faces)
    areas = face_areas(vertices, faces)
    smooth = step_of < 0
    beside = TriangleTree(vertices, faces[smooth]) if smooth.any() and not smooth.all() else None
    for number, cut in enumerate(cuts(tree.root)):
        own = np.flatnonzero(step_of == number)
        largest = 0.0
        if own.size and beside is not None:
            largest = float(beside.closest(vertices[faces[own]].mean(axis=1))[0].max())
        rows.append(
            {
                "half_width_mm": rounded(cut.half_width),
                "lobes": len(cut.contours),
                "step_area_mm2": rounded(float(areas[own].sum())),
                "largest_step_mm": rounded(largest),
            }
        )
    return rows


def topology(vertices: FloatArray, faces: IntArray, mesh: trimesh.Trimesh) -> dict[str, Any]:
    """Return bodies, genus and volume of the source and of the fit's mesh."""
    before = measure_quality(vertices, faces)
    fitted_faces = np.asarray(mesh.faces, dtype=np.int64)
    if len(fitted_faces) == 0:
        return {"bodies": [before.bodies, 0], "genus": [before.genus, 0], "volume_ml": [rounded(before.volume_ml), 0.0]}
    after = measure_quality(np.asarray(mesh.vertices), fitted_faces)
    return {
        "bodies": [before.bodies, after.bodies],
        "genus": [before.genus, after.genus],
        "volume_ml": [rounded(before.volume_ml), rounded(after.volume_ml)],
    }


def leaf_figures(tree: Tree) -> list[dict[str, Any]]:
    """Return per leaf: its kind and the numbers it takes."""
    return [
        {"kind": "model" if isinstance(leaf, ModelLeaf) else "retained", "parameters": leaf.parameters}
        for leaf in leaves(tree.root)
    ]


def rounded(value: float) -> float:
    """Return a figure to five significant digits: a file's header need not be longer."""
    return float(f"{value:.{SIGNIFICANT}g}")
