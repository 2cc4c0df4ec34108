"""Collapse the edges too short to be stored: slivers that Booleans leave where surfaces nearly touch."""

from __future__ import annotations

import numpy as np
from scipy.spatial import cKDTree

from hhsr.model import FloatArray, IntArray
from hhsr.surface.piece import Piece

PASSES = 4
DETOUR = 0.01  # mm that a way may be longer if what stays is then exact


def tidy(piece: Piece, shortest_mm: float, storable_mm: float) -> Piece:
    """Return the piece without edges shorter than `shortest_mm`, where what stays is exact: no vertex moves.

    Of an edge's ends that one stays which lies on all surfaces of the other. Edges shorter than `storable_mm` go even
    where there is none such, as far as the surface stays a manifold.
    """
    for length, careful in ((shortest_mm, True), (storable_mm, False)):
        for _ in range(PASSES):
            short = _short_edges(piece, length)
            smaller = _collapse(piece, short, careful) if len(short) else None
            if smaller is None:
                break
            piece = smaller
    return piece


def apart(piece: Piece, storable_mm: float) -> Piece:
    """Return the piece with vertices that coincide without an edge between them moved apart, by a few `storable_mm`.

    Where two sheets touch along an edge, a reader that merges equal vertices would find four faces there.
    """
    vertices = piece.vertices.copy()
    edges = piece.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    for _ in range(PASSES):
        pairs = cKDTree(vertices).query_pairs(storable_mm, output_type="ndarray")
        if len(pairs) == 0:
            break
        for vertex in np.unique(pairs[:, 1]).tolist():
            way = vertices[edges[edges[:, 0] == vertex, 1]].mean(axis=0) - vertices[vertex]
            length = float(np.linalg.norm(way))
            if length > 0:
                vertices[vertex] += way / length * min(4.0 * storable_mm, 0.2 * length)
    return Piece(vertices, piece.faces, piece.source)


def _short_edges(piece: Piece, shortest_mm: float) -> IntArray:
    """Return (k, 2) the short edges, shortest first."""
    edges = piece.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = edges[edges[:, 0] < edges[:, 1]]
    length = np.linalg.norm(piece.vertices[edges[:, 1]] - piece.vertices[edges[:, 0]], axis=1)
    short = np.flatnonzero(length < shortest_mm)
    return np.asarray(edges[short[np.argsort(length[short], kind="stable")]])


def _collapse(piece: Piece, short: IntArray, careful: bool) -> Piece | None:
    """Return the piece after as many collapses as go, or None. careful: no face turns over, no surface is left."""
    surface = _Surface(piece)
    done = 0
    for a, b in short.tolist():
        if not surface.joined(a, b):
            continue  # one of them went with an earlier collapse
        ways = [way for way in ((a, b), (b, a)) if surface.exact(*way)]
        if not careful:
            ways += [(a, b), (b, a), *surface.detours(a, b)]
        done += any(surface.collapse(*way, careful) for way in ways)
    return surface.piece() if done else None


class _Surface:
    """Triangles whose vertices merge."""

    def __init__(self, piece: Piece) -> None:
        self._vertices, self._faces, self._source = piece.vertices, piece.faces.copy(), piece.source
        self._alive = np.ones(len(self._faces), dtype=bool)
        self._around = _Around(self._faces)

    def joined(self, a: int, b: int) -> bool:
        """Return whether two vertices are still the ends of an edge."""
        return bool(self._around.faces(a) & self._around.faces(b))

    def exact(self, gone: int, kept: int) -> bool:
        """Return whether `kept` lies on all the surfaces that `gone` lies on."""
        of_gone, of_kept = (set(self._source[list(self._around.faces(v))].tolist()) for v in (gone, kept))
        return of_gone <= of_kept

    def detours(self, a: int, b: int) -> list[tuple[int, int]]:
        """Return other collapses that take one end of a stubborn edge away: short ones first, exact ones before."""
        ways = [(v, w) for v in (a, b) for w in self._neighbours(v) - {a, b}]
        return sorted(ways, key=lambda way: self._length(*way) + (0.0 if self.exact(*way) else DETOUR))

    def _length(self, a: int, b: int) -> float:
        return float(np.linalg.norm(self._vertices[a] - self._vertices[b]))

    def _neighbours(self, vertex: int) -> set[int]:
        return set(self._faces[list(self._around.faces(vertex))].ravel().tolist()) - {vertex}

    def collapse(self, gone: int, kept: int, careful: bool) -> bool:
        """Merge `gone` into `kept` if the surface stays a manifold; return whether it was done."""
        ring, other = self._around.faces(gone), self._around.faces(kept)
        shared = sorted(ring & other)
        if len(shared) != 2 or len(self._neighbours(gone) & self._neighbours(kept)) != 2:
            return False  # a third common neighbour: the surface would touch itself
        moving = sorted(ring - other)
        if careful and _turns_over(self._vertices, self._faces[moving], gone, kept):
            return False
        moved = np.where(self._faces[moving] == gone, kept, self._faces[moving])
        known = {frozenset(f) for f in self._faces[sorted(other - ring)].tolist()}
        if any(frozenset(f) in known for f in moved.tolist()):
            return False
        self._faces[moving] = moved
        self._alive[shared] = False
        self._around.merge(gone, kept, shared, self._faces)
        return True

    def piece(self) -> Piece:
        used, numbers = np.unique(self._faces[self._alive], return_inverse=True)
        return Piece(self._vertices[used], numbers.reshape(-1, 3), self._source[self._alive])


class _Around:
    """The faces around each vertex, kept while vertices merge."""

    def __init__(self, faces: IntArray) -> None:
        self._order = np.argsort(faces.ravel(), kind="stable")
        self._start = np.searchsorted(faces.ravel()[self._order], np.arange(faces.max() + 2))
        self._changed: dict[int, set[int]] = {}

    def faces(self, vertex: int) -> set[int]:
        if vertex not in self._changed:
            corners = self._order[self._start[vertex] : self._start[vertex + 1]]
            self._changed[vertex] = set((corners // 3).tolist())
        return self._changed[vertex]

    def merge(self, gone: int, kept: int, shared: list[int], faces: IntArray) -> None:
        for vertex in set(faces[shared].ravel().tolist()) | {gone, kept}:
            self._changed[vertex] = self.faces(vertex) - set(shared)
        self._changed[kept] |= self._changed[gone]
        self._changed[gone] = set()


def _turns_over(vertices: FloatArray, faces: IntArray, gone: int, kept: int) -> bool:
    before = vertices[faces]
    after = vertices[np.where(faces == gone, kept, faces)]
    n0 = np.cross(before[:, 1] - before[:, 0], before[:, 2] - before[:, 0])
    n1 = np.cross(after[:, 1] - after[:, 0], after[:, 2] - after[:, 0])
    return bool((np.einsum("ij,ij->i", n0, n1) < 0).any())
