"""What is known of a surface before anything is fitted to it: measured, repaired, warned of."""

from __future__ import annotations

from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from hhsr.model import FloatArray, IntArray
from hhsr.read.topology import body_of_faces, edge_counts


@dataclass(frozen=True)
class QualityReport:
    """The state of a surface as it is handed to a fit, and what had to be done to get there.

    bodies: connected closed surfaces (cavities included). genus: handles over all bodies. cavities: bodies that face
    inward, inside another. touching_edges: edges that more than two triangles share, where bodies or walls touch.
    volume_ml: of the solid. extent_mm: sides of the box along LPS. holes_filled, orphan_vertices, duplicate_vertices,
    degenerate_faces, duplicate_faces, turned_faces: as found in the file. repairs, warnings: in words.
    """

    vertices: int
    faces: int
    bodies: int
    genus: int
    cavities: int
    touching_edges: int
    volume_ml: float
    area_mm2: float
    extent_mm: tuple[float, float, float]
    holes_filled: int = 0
    orphan_vertices: int = 0
    duplicate_vertices: int = 0
    degenerate_faces: int = 0
    duplicate_faces: int = 0
    turned_faces: int = 0
    repairs: tuple[str, ...] = ()
    warnings: tuple[str, ...] = ()

    def to_json(self) -> dict[str, Any]:
        """Return the report as JSON values."""
        return asdict(self)


def measure_quality(vertices: FloatArray, faces: IntArray, **found: Any) -> QualityReport:
    """Return the report of a closed surface; `found` are the counts and words of what was repaired."""
    bodies = body_of_faces(faces)
    volumes = body_volumes(vertices, faces, bodies)
    counts = edge_counts(faces)
    euler = np.unique(faces).size - counts.size + len(faces)
    corners = vertices[faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    extent = np.ptp(vertices, axis=0)
    return QualityReport(
        vertices=len(vertices),
        faces=len(faces),
        bodies=int(volumes.size),
        genus=max(int(volumes.size) - euler // 2, 0),
        cavities=int((volumes < 0).sum()),
        touching_edges=int((counts > 2).sum()),
        volume_ml=float(volumes.sum()) / 1000.0,
        area_mm2=float(np.linalg.norm(normals, axis=1).sum()) / 2.0,
        extent_mm=(float(extent[0]), float(extent[1]), float(extent[2])),
        **found,
    )


def body_volumes(vertices: FloatArray, faces: IntArray, bodies: IntArray) -> FloatArray:
    """Return (k,) signed volumes in mm³ of the bodies; < 0: the triangles face inward."""
    corners = vertices[faces] - vertices.mean(axis=0)
    sixfold = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    volumes: FloatArray = np.bincount(bodies, weights=sixfold, minlength=int(bodies.max()) + 1) / 6.0
    return volumes
