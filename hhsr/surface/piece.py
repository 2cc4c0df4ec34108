"""A closed body of triangles that know which surface they stem from, and its Booleans (by manifold3d)."""

from __future__ import annotations

from typing import Any, NamedTuple

import manifold3d
import numpy as np

from hhsr.errors import SurfaceError
from hhsr.model import FloatArray, IntArray

SNAP = 1e-9


class Piece(NamedTuple):
    """Closed triangles, outward.

    vertices: (n, 3) mm. faces: (m, 3). source: (m,) index into the list of surfaces (see `hhsr.surface.sources`).
    """

    vertices: FloatArray
    faces: IntArray
    source: IntArray

    @staticmethod
    def empty() -> Piece:
        """Return the body that holds no point."""
        return Piece(np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), np.zeros(0, dtype=np.int64))


class Bodies:
    """Pieces as manifolds: remembers, by the ids that a Boolean carries along, the source of every triangle."""

    def __init__(self) -> None:
        self._sources: dict[int, IntArray] = {}

    def body(self, piece: Piece) -> Any:
        """Return a piece as a manifold.

        Raises SurfaceError where its triangles are not closed and consistently wound.
        """
        if len(piece.faces) == 0:
            return manifold3d.Manifold()
        number = int(manifold3d.Manifold.reserve_ids(1))
        self._sources[number] = piece.source
        mesh = manifold3d.Mesh64(
            vert_properties=np.ascontiguousarray(piece.vertices),
            tri_verts=piece.faces.astype(np.uint64),
            run_index=np.array([0, 3 * len(piece.faces)], dtype=np.uint64),
            run_original_id=np.array([number], dtype=np.uint32),
            # One id a triangle: nothing is taken for flat and simplified away.
            face_id=np.arange(len(piece.faces), dtype=np.uint64),
        )
        solid = manifold3d.Manifold(mesh)
        if solid.status() != manifold3d.Error.NoError:
            raise SurfaceError(f"the triangles of a part are not closed ({solid.status().name}); repair the source")
        return solid

    def piece(self, body: Any, cut_face: int = -1) -> Piece:
        """Return a manifold as a piece; triangles that no known piece brought along get source `cut_face`."""
        if body.is_empty():
            return Piece.empty()
        mesh = body.to_mesh64()
        faces = np.asarray(mesh.tri_verts).astype(np.int64)
        source = np.full(len(faces), cut_face, dtype=np.int64)
        face_id = np.asarray(mesh.face_id).astype(np.int64)
        runs = np.asarray(mesh.run_index).astype(np.int64) // 3
        for number, first, last in zip(mesh.run_original_id, runs[:-1], runs[1:], strict=True):
            known = self._sources.get(int(number))
            if known is not None:
                source[first:last] = known[face_id[first:last]]
        return Piece(np.array(mesh.vert_properties[:, :3], dtype=np.float64), faces, source)

    def trimmed(self, piece: Piece, side: int, height: float, cut_face: int) -> Piece:
        """Return the part with side · z ≥ side · height, side = ±1, closed by faces of source `cut_face`."""
        cut = self.piece(self.body(piece).trim_by_plane((0.0, 0.0, float(side)), side * height), cut_face)
        cut.vertices[np.abs(cut.vertices[:, 2] - height) < SNAP, 2] = height
        return cut

    def united(self, pieces: list[Piece]) -> Piece:
        """Return the union of pieces that touch at most in faces."""
        some = [p for p in pieces if len(p.faces)]
        if len(some) <= 1:
            return some[0] if some else Piece.empty()
        bodies = [self.body(p) for p in some]
        return self.piece(manifold3d.Manifold.batch_boolean(bodies, manifold3d.OpType.Add))
