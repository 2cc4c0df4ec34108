"""Cut a closed body by a plane: what lies on one side, closed again by faces in the plane."""

from __future__ import annotations

import manifold3d
import numpy as np

from hhsr.model import FloatArray, IntArray
from hhsr.surface.piece import SNAP, Bodies, Piece


def trim(bodies: Bodies, piece: Piece, side: int, height: float, cut_face: int) -> Piece:
    """Return the part of a piece with side · z ≥ side · height, side = ±1.

    Vertices within 1e-9 mm of the plane, and all new ones, lie at z = height exactly. The new faces have source
    `cut_face`. Where the outline on the plane touches itself, the Boolean library decides how it closes.
    """
    z = piece.vertices[:, 2]
    z = np.where(np.abs(z - height) < SNAP, height, z)
    whole = Piece(np.column_stack([piece.vertices[:, :2], z]), piece.faces, piece.source)
    above = np.sign(side * (z - height)).astype(np.int64)
    if (above >= 0).all():
        return whole
    if (above <= 0).all():
        return Piece.empty()
    opened = _open(whole, above, height)
    loops = _loops(_rim(opened, height))
    return bodies.trimmed(whole, side, height, cut_face) if loops is None else _capped(opened, loops, side, cut_face)


def _open(piece: Piece, above: IntArray, height: float) -> Piece:
    """Return the triangles above the plane (above = 1; 0 on it, −1 below), those across it clipped, without a cap."""
    state = above[piece.faces]
    across = (state > 0).any(axis=1) & (state < 0).any(axis=1)
    whole = (state >= 0).all(axis=1) & (state > 0).any(axis=1)
    faces, state, source = piece.faces[across], state[across], piece.source[across]
    # Turn each face so that a vertex above comes first, and where two are above, the one below comes last.
    turn = np.where((state > 0).sum(axis=1) == 2, (state < 0).argmax(axis=1) + 1, (state > 0).argmax(axis=1))
    index = (turn[:, None] + np.arange(3)) % 3
    faces, state = np.take_along_axis(faces, index, axis=1), np.take_along_axis(state, index, axis=1)
    ends = np.sort(np.stack([faces, np.roll(faces, -1, axis=1)], axis=2), axis=2)
    cuts_edge = state * np.roll(state, -1, axis=1) < 0
    keys, number = np.unique(ends[cuts_edge][:, 0] * len(piece.vertices) + ends[cuts_edge][:, 1], return_inverse=True)
    a, b = piece.vertices[keys // len(piece.vertices)], piece.vertices[keys % len(piece.vertices)]
    share = (height - a[:, 2]) / (b[:, 2] - a[:, 2])
    new = a + share[:, None] * (b - a)
    new[:, 2] = height
    middle = np.full(faces.shape, -1)
    middle[cuts_edge] = len(piece.vertices) + number
    six = np.concatenate([faces, middle], axis=1)
    second, third = state[:, 1], state[:, 2]
    parts = [
        (whole, None),
        ((second < 0) & (third < 0), (0, 3, 5)),
        ((second > 0) & (third < 0), (0, 1, 4)),
        ((second > 0) & (third < 0), (0, 4, 5)),
        ((second == 0) & (third < 0), (0, 1, 5)),
        ((second < 0) & (third == 0), (0, 3, 2)),
    ]
    return Piece(
        np.concatenate([piece.vertices, new]),
        np.concatenate([piece.faces[m] if p is None else six[m][:, list(p)] for m, p in parts]),
        np.concatenate([piece.source[m] if p is None else source[m] for m, p in parts]),
    )


def _rim(opened: Piece, height: float) -> IntArray:
    """Return (k, 2) the directed edges on the plane that have a face on one side only."""
    on = opened.vertices[:, 2] == height
    edges = opened.faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    edges = edges[on[edges].all(axis=1)]
    count = len(opened.vertices)
    return np.asarray(edges[~np.isin(edges[:, 0] * count + edges[:, 1], edges[:, 1] * count + edges[:, 0])])


def _loops(rim: IntArray) -> list[list[int]] | None:
    """Return the closed chains of the edges, or None where they meet in a vertex."""
    following = dict(rim.tolist())
    if len(following) < len(rim) or set(following) != set(following.values()):
        return None
    loops = []
    while following:
        first, here = following.popitem()
        loop = [first]
        while here != first:
            loop.append(here)
            here = following.pop(here)
        loops.append(loop)
    return loops


def _capped(opened: Piece, loops: list[list[int]], side: int, cut_face: int) -> Piece:
    """Return the triangles closed by faces within the loops; the cap runs against the edges of the rim."""
    index = np.concatenate([np.array(loop[::-1] if side < 0 else loop) for loop in loops])
    flat: FloatArray = opened.vertices[index, :2]
    borders = np.cumsum([len(loop) for loop in loops])[:-1]
    cap = index[np.asarray(manifold3d.triangulate(np.split(flat, borders)), dtype=np.int64).reshape(-1, 3)]
    faces = np.concatenate([opened.faces, cap if side < 0 else cap[:, ::-1]])
    used = np.zeros(len(opened.vertices), dtype=bool)
    used[faces] = True
    number = np.cumsum(used) - 1
    source = np.concatenate([opened.source, np.full(len(cap), cut_face)])
    return Piece(opened.vertices[used], number[faces], source)
