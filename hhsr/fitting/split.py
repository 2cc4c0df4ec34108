"""Parts of a shape: closed triangles within a convex region, cut in two by planes (PAPER §3, Algorithm 1)."""

from __future__ import annotations

from dataclasses import dataclass

import manifold3d
import numpy as np
import trimesh
from numpy.typing import NDArray

from hhsr.fitting.cuts import Plane
from hhsr.model import FloatArray, IntArray

ON_PLANE_SHARE = 1e-7


@dataclass(frozen=True, eq=False)
class Part:
    """A piece of the source: closed triangles, and the half spaces that its region is made of.

    vertices: (n, 3) mm. faces: (m, 3). planes: pairs of a plane and the side of it (+1 right, −1 left) of
    the part.
    """

    vertices: FloatArray
    faces: IntArray
    planes: tuple[tuple[Plane, int], ...] = ()

    @property
    def depth(self) -> int:
        return len(self.planes)

    @property
    def box_volume_mm3(self) -> float:
        """Volume of the bounding box: what t2 measures."""
        return float(np.ptp(self.vertices, axis=0).prod()) if self.vertices.size else 0.0

    def holds(self, points: FloatArray, margin_mm: float = 0.0) -> NDArray[np.bool_]:
        """Return (...) whether points (..., 3) lie in the part's region, at least `margin_mm` within its planes."""
        inside = np.ones(points.shape[:-1], dtype=np.bool_)
        for plane, side in self.planes:
            height = side * plane.heights(points)
            inside &= (height >= margin_mm) if side > 0 else (height > margin_mm)
        return inside

    def exits(self, origins: FloatArray, directions: FloatArray) -> FloatArray:
        """Return how far (n,) in mm a ray from within the region runs before it leaves it; inf where it never does."""
        reach = np.full(directions.shape[0], np.inf)
        for plane, side in self.planes:
            along = side * (directions @ plane.normal)
            away = side * plane.heights(origins)
            with np.errstate(divide="ignore", invalid="ignore"):
                reach = np.where(along < 0.0, np.minimum(reach, np.maximum(away, 0.0) / -along), reach)
        return reach

    def capped(self) -> NDArray[np.bool_]:
        """Return (m,) which triangles lie on a plane of the region: made by a cut, no surface of the shape."""
        on_cap = np.zeros(self.faces.shape[0], dtype=np.bool_)
        extent = float(np.ptp(self.vertices, axis=0).max()) if self.vertices.size else 0.0
        for plane, _ in self.planes:
            near = np.abs(plane.heights(self.vertices)) <= ON_PLANE_SHARE * extent
            on_cap |= near[self.faces].all(axis=1)
        return on_cap

    def cut(self, plane: Plane) -> tuple[Part, Part]:
        """Return the left and the right part; either may have no triangles left."""
        sides = []
        for side in (-1, 1):
            vertices, faces = trim(self.vertices, self.faces, [(plane, side)])
            sides.append(Part(vertices, faces, (*self.planes, (plane, side))))
        return sides[0], sides[1]


def trim(
    vertices: FloatArray, faces: IntArray, planes: list[tuple[Plane, int]], margin_mm: float = 0.0
) -> tuple[FloatArray, IntArray]:
    """Return closed triangles cut off `margin_mm` beyond each plane, and capped there.

    Triangles that are not an oriented manifold (edges with more than two faces) are cut without caps.
    """
    solid = as_manifold(vertices, faces)
    if solid is None:
        return _trim_open(vertices, faces, planes, margin_mm)
    for plane, side in planes:
        normal = side * plane.normal
        solid = solid.trim_by_plane([float(v) for v in normal], float(side * plane.offset - margin_mm))
    mesh = solid.to_mesh64()
    return (
        np.ascontiguousarray(mesh.vert_properties[:, :3], dtype=np.float64),
        np.ascontiguousarray(mesh.tri_verts, dtype=np.int64).reshape(-1, 3),
    )


def as_manifold(vertices: FloatArray, faces: IntArray) -> manifold3d.Manifold | None:
    """Return the triangles as a manifold3d solid, or None where they are not an oriented manifold."""
    mesh = manifold3d.Mesh64(
        np.array(vertices, dtype=np.float64, order="C"), np.array(faces, dtype=np.uint64, order="C")
    )
    solid = manifold3d.Manifold(mesh)
    if solid.status() != manifold3d.Error.NoError or (solid.is_empty() and len(faces)):
        mesh.merge()
        solid = manifold3d.Manifold(mesh)
    return solid if solid.status() == manifold3d.Error.NoError else None


def _trim_open(
    vertices: FloatArray, faces: IntArray, planes: list[tuple[Plane, int]], margin_mm: float
) -> tuple[FloatArray, IntArray]:
    """Return the triangles on the wanted sides, cut at the planes, without caps."""
    for plane, side in planes:
        if not len(faces):
            break
        normal = side * plane.normal
        origin = normal * (side * plane.offset - margin_mm)
        vertices, faces, _ = trimesh.intersections.slice_faces_plane(vertices, faces, normal, origin)  # type: ignore[no-untyped-call]
    return np.ascontiguousarray(vertices, dtype=np.float64), np.ascontiguousarray(faces, dtype=np.int64).reshape(-1, 3)
