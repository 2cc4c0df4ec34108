"""Collapse the edges too short to be stored: slivers that Booleans leave where surfaces nearly touch."""

from __future__ import annotations

import numpy as np

from hhsr.model import FloatArray, IntArray
from hhsr.surface.piece import Piece

PASSES = 6


def tidy(piece: Piece, shortest_mm: float) -> Piece:
    """Return the piece without edges shorter than `shortest_mm`, as far as its topology allows; no vertex moves.

    Of an edge's ends that one stays which lies on more surfaces, so that what stays is exact.
    """
    for attempt in range(PASSES):
        short = _short_edges(piece, shortest_mm)
        if len(short) == 0:
            break
        smaller = _collapse(piece, short, careful=attempt < PASSES // 2)
        if smaller is None:
            if attempt >= PASSES // 2:
                break
            continue
        piece = smaller
    return piece


def _short_edges(piece: Piece, shortest_mm: float) -> IntArray:
    """Return (k, 2) the short edges, shortest first."""
    edges = piece.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = edges[edges[:, 0] < edges[:, 1]]
    length = np.linalg.norm(piece.vertices[edges[:, 1]] - piece.vertices[edges[:, 0]], axis=1)
    short = np.flatnonzero(length < shortest_mm)
    return np.asarray(edges[short[np.argsort(length[short], kind="stable")]])


def _collapse(piece: Piece, short: IntArray, careful: bool) -> Piece | None:
    """Return the piece after as many collapses as go, or None. careful: no face may turn over."""
    faces = piece.faces.copy()
    around = _Around(faces)
    alive = np.ones(len(faces), dtype=bool)
    done = 0
    for a, b in short.tolist():
        ring_a, ring_b = around.faces(a), around.faces(b)
        shared = [f for f in ring_a if f in ring_b]
        if len(shared) != 2:  # one of them went with an earlier collapse
            continue
        if set(faces[list(ring_a)].ravel()) & set(faces[list(ring_b)].ravel()) - set(faces[shared].ravel()):
            continue  # a third common neighbour: the surface would touch itself
        sources_a = set(piece.source[list(ring_a)].tolist())
        sources_b = set(piece.source[list(ring_b)].tolist())
        gone, kept = (a, b) if sources_a <= sources_b or len(sources_a) < len(sources_b) else (b, a)
        moving = [f for f in around.faces(gone) if f not in shared]
        if careful and _turns_over(piece.vertices, faces[moving], gone, kept):
            continue
        if _repeats(faces, moving, gone, kept, [f for f in around.faces(kept) if f not in shared]):
            continue
        faces[moving] = np.where(faces[moving] == gone, kept, faces[moving])
        alive[shared] = False
        around.merge(gone, kept, shared, faces)
        done += 1
    if not done:
        return None
    used, numbers = np.unique(faces[alive], return_inverse=True)
    return Piece(piece.vertices[used], numbers.reshape(-1, 3), piece.source[alive])


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


def _repeats(faces: IntArray, moving: list[int], gone: int, kept: int, others: list[int]) -> bool:
    """Return whether a moved face would hold the same three vertices as another."""
    known = {frozenset(f) for f in faces[others].tolist()}
    return any(frozenset(f) in known for f in np.where(faces[moving] == gone, kept, faces[moving]).tolist())
