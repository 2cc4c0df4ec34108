"""Which triangles hang together, which way they face, and where a surface is open: on indices alone."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from hhsr.errors import SurfaceError
from hhsr.model import IntArray

BoolArray = NDArray[np.bool_]


def half_edges(faces: IntArray) -> tuple[IntArray, BoolArray]:
    """Return (3m,) keys of the undirected edges, face after face, and which run from the lower to the higher vertex."""
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    span = int(faces.max()) + 1 if faces.size else 1
    return np.minimum(start, end) * span + np.maximum(start, end), start < end


def edge_counts(faces: IntArray) -> IntArray:
    """Return how many triangles share each undirected edge."""
    return np.unique(half_edges(faces)[0], return_counts=True)[1]


def _neighbours(faces: IntArray) -> tuple[IntArray, IntArray, BoolArray]:
    """Return pairs of faces that share an edge, and whether they face the same way; only edges of exactly two faces."""
    keys, up = half_edges(faces)
    order = np.argsort(keys, kind="stable")
    sorted_keys = keys[order]
    starts = np.flatnonzero(np.r_[True, sorted_keys[1:] != sorted_keys[:-1]])
    two = starts[np.diff(np.r_[starts, sorted_keys.size]) == 2]
    first, second = order[two], order[two + 1]
    return first // 3, second // 3, up[first] != up[second]


def body_of_faces(faces: IntArray) -> IntArray:
    """Return (m,) the body of each face, numbered in order of first appearance; joined by shared edges.

    Faces that meet only in a vertex, or in an edge of more than two faces, are bodies of their own.
    """
    a, b, _ = _neighbours(faces)
    size = len(faces)
    graph = coo_array((np.ones(a.size, dtype=np.int8), (a, b)), shape=(size, size))
    return _in_order(connected_components(graph, directed=False)[1])


def _in_order(labels: IntArray) -> IntArray:
    _, first, inverse = np.unique(labels, return_index=True, return_inverse=True)
    rank = np.empty(first.size, dtype=np.int64)
    rank[np.argsort(first)] = np.arange(first.size)
    return np.asarray(rank[inverse.ravel()], dtype=np.int64)


def faces_to_turn(faces: IntArray) -> BoolArray:
    """Return (m,) which faces to turn so that neighbours face the same way; each body's larger share stays.

    A two-sheeted cover decides: face i the right way round and turned are two nodes, joined to the neighbour's by how
    the shared edge runs. SurfaceError where both nodes of a face are one component: a one-sided surface.
    """
    a, b, same = _neighbours(faces)
    size = len(faces)
    crossed = np.where(same, 0, size)
    rows = np.r_[a, a + size]
    columns = np.r_[b + crossed, b + size - crossed]
    graph = coo_array((np.ones(rows.size, dtype=np.int8), (rows, columns)), shape=(2 * size, 2 * size))
    sheets = connected_components(graph, directed=False)[1]
    upright, turned = sheets[:size], sheets[size:]
    if (upright == turned).any():
        raise SurfaceError("the surface is one-sided (like a Möbius strip), expected a closed surface with an inside")
    turn = upright > turned
    bodies = body_of_faces(faces)
    share = np.bincount(bodies, weights=turn) / np.bincount(bodies)
    return np.asarray(turn ^ (share > 0.5)[bodies])


def open_loops(faces: IntArray) -> list[IntArray]:
    """Return the borders of an evenly oriented surface as rings of vertices, each running as its faces do.

    SurfaceError where an edge has an odd number of triangles above one: a wall inside, or three sheets that meet.
    """
    keys, up = half_edges(faces)
    start, end = faces.ravel(), np.roll(faces, -1, axis=1).ravel()
    unique, inverse, counts = np.unique(keys, return_inverse=True, return_counts=True)
    balance = np.bincount(inverse.ravel(), weights=np.where(up, 1, -1), minlength=unique.size)
    if ((counts % 2 == 1) & (counts > 1)).any():
        number = int(((counts % 2 == 1) & (counts > 1)).sum())
        raise SurfaceError(
            f"{number} edges have three or more triangles that cannot be paired (a wall inside the solid?); "
            "expected a closed surface: remove inner walls and write the mesh again"
        )
    if ((counts % 2 == 0) & (balance != 0)).any():
        raise SurfaceError("triangles that share an edge face different ways even after turning: the mesh is no solid")
    border = counts[inverse.ravel()] == 1
    following: dict[int, list[int]] = {}
    for tail, head in zip(start[border].tolist(), end[border].tolist(), strict=True):
        following.setdefault(tail, []).append(head)
    loops = []
    while following:
        loops += _rings(following)
    return loops


def _rings(following: dict[int, list[int]]) -> list[IntArray]:
    """Take one closed trail of border edges out; return it as simple rings (cut where it touches itself)."""
    here = next(iter(following))
    path, place = [here], {here: 0}
    rings: list[IntArray] = []
    while True:
        heads = following.get(here)
        if not heads:
            if len(path) > 1:
                raise SurfaceError("a border of the surface does not close; the mesh is torn beyond repair")
            return rings
        following_head = heads.pop()
        if not heads:
            del following[here]
        here = following_head
        if here in place:
            at = place[here]
            rings.append(np.array(path[at:], dtype=np.int64))
            for vertex in path[at + 1 :]:
                del place[vertex]
            del path[at + 1 :]
        else:
            place[here] = len(path)
            path.append(here)
