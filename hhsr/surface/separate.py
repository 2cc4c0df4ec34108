"""Make triangles a manifold where they touch themselves: edges of four faces and more, vertices of several fans."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from hhsr.errors import SurfaceError
from hhsr.model import FloatArray, IntArray
from hhsr.surface.piece import Piece


def has_two_faces_an_edge(faces: IntArray) -> bool:
    """Return whether every edge is passed once each way."""
    start, end = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    count = int(faces.max(initial=0)) + 1
    one_way, other = np.sort(start * count + end), np.sort(end * count + start)
    return bool((np.diff(one_way) > 0).all() and np.array_equal(one_way, other))


def separate(piece: Piece) -> Piece:
    """Return the same triangles with vertices doubled, so that every edge has two faces and every vertex one fan.

    At an edge of several bodies each keeps to itself: a face is joined to that one across the solid.

    Raises SurfaceError where an edge is not passed as often one way as the other: the triangles are open.
    """
    faces = piece.faces
    start, end = faces.ravel(), faces[:, [1, 2, 0]].ravel()
    low, high = np.minimum(start, end), np.maximum(start, end)
    keys = low * len(piece.vertices) + high
    order = np.argsort(keys, kind="stable")
    borders = np.flatnonzero(np.r_[True, np.diff(keys[order]) != 0, True])
    pairs: list[tuple[int, int]] = []
    for first, last in pairwise(borders.tolist()):
        group = order[first:last]
        forward = start[group] == low[group]
        if 2 * forward.sum() != len(group):
            where = piece.vertices[[low[group[0]], high[group[0]]]].mean(axis=0).round(2).tolist()
            raise SurfaceError(f"the triangles of a part are not closed at {where} mm; repair the source")
        pairs += _across_the_solid(piece.vertices, faces, group, forward)
    one, other = np.array(pairs).T
    after = np.arange(len(start)).reshape(-1, 3)[:, [1, 2, 0]].ravel()
    row, column = np.r_[one, after[one]], np.r_[after[other], other]
    graph = coo_array((np.ones(len(row), dtype=bool), (row, column)), shape=(len(start), len(start)))
    _, number = connected_components(graph, directed=False)
    _, corner = np.unique(number, return_index=True)
    return Piece(piece.vertices[start[corner]], number.reshape(-1, 3).astype(np.int64), piece.source)


def _across_the_solid(
    vertices: FloatArray, faces: IntArray, group: IntArray, forward: np.ndarray
) -> list[tuple[int, int]]:
    """Return which half edges of one edge belong together. group: their numbers, 3 · face + corner."""
    if len(group) > 2:
        ahead = int(group[forward][0])
        a, b = vertices[faces[ahead // 3, ahead % 3]], vertices[faces[ahead // 3, (ahead % 3 + 1) % 3]]
        along = (b - a) / max(float(np.linalg.norm(b - a)), 1e-300)
        side = np.cross(along, np.eye(3)[np.abs(along).argmin()])
        opposite = vertices[faces[group // 3, (group % 3 + 2) % 3]] - a
        angle = np.arctan2(opposite @ np.cross(along, side), opposite @ side)
        turn = np.argsort(angle, kind="stable")
        # Around the edge the solid begins at a backward face and ends at the next forward one.
        turn = np.roll(turn, -int(np.flatnonzero(~forward[turn])[0]))
        if not forward[turn][::2].any():
            return list(zip(group[turn[1::2]].tolist(), group[turn[::2]].tolist(), strict=True))
    return list(zip(group[forward].tolist(), group[~forward].tolist(), strict=True))
