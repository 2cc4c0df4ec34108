"""Triangles over a leaf: a conforming, adaptive tessellation of its radius over all directions."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import trimesh
from numpy.typing import NDArray

from hhsr.evaluate import LeafArrays, leaf_arrays
from hhsr.kernels.leaf import leaf_radii
from hhsr.kernels.mesh_edges import number_edges
from hhsr.model import FloatArray, IntArray, ModelLeaf, rotation_matrix

START_LEVEL = 4  # 2,562 directions, 0.07 rad apart: the finest scale-field centres are about as dense
MAX_ROUNDS = 16
FLATTEST = 0.1  # the share of a radial gap that is taken as distance, at least


class Halfspace:
    """n · p ≤ offset, mm, n a unit vector."""

    def __init__(self, normal: FloatArray, offset: float) -> None:
        self.normal, self.offset = np.asarray(normal, dtype=np.float64), float(offset)


@lru_cache(maxsize=1)
def _start() -> tuple[FloatArray, IntArray]:
    sphere = trimesh.creation.icosphere(START_LEVEL)
    directions = np.array(sphere.vertices, dtype=np.float64)
    return directions / np.linalg.norm(directions, axis=1, keepdims=True), np.array(sphere.faces, dtype=np.int64)


def tessellate(
    leaf: ModelLeaf, region: list[Halfspace], tolerance_mm: float, finest_mm: float, affordable: int
) -> tuple[FloatArray, IntArray]:
    """Return (vertices (n, 3) in the tree's frame, faces (m, 3)), closed and outward, vertices on the leaf's surface.

    Edges and face centres within the region lie within `tolerance_mm` of the surface; outside it the mesh stays coarse.
    As long as that takes fewer than `affordable` faces it goes on, to `finest_mm` at most. Every new vertex lies on the
    great circle of the edge it splits, so that the mesh is a radial graph and never meets itself.
    """
    arrays = leaf_arrays(leaf)
    rotation = rotation_matrix(leaf.rotation)
    normals = np.array([h.normal for h in region]).reshape(-1, 3) @ rotation
    offsets = np.array([h.offset - h.normal @ leaf.centre for h in region])
    directions, faces = _start()
    points = _on_surface(directions, arrays)
    active = np.ones(len(faces), dtype=bool)
    goal = tolerance_mm
    for _ in range(MAX_ROUNDS):
        of_face, split, middles = _edges_to_split(points, faces, active, arrays, normals, offsets, goal)
        if len(split) == 0:
            finer = max(finest_mm, goal * len(faces) / affordable)  # faces grow as 1 / tolerance
            if goal < tolerance_mm or finer > 0.7 * goal:
                break
            goal, active = finer, np.ones(len(faces), dtype=bool)
            continue
        number = np.full(of_face.max() + 1, -1)
        number[split] = len(points) + np.arange(len(split))
        points = np.concatenate([points, middles])
        faces, active = split_faces(faces, number[of_face])
    return points @ rotation.T + leaf.centre, faces


def _on_surface(directions: FloatArray, arrays: LeafArrays) -> FloatArray:
    unit = directions / np.linalg.norm(directions, axis=1, keepdims=True)
    return np.asarray(unit * leaf_radii(np.ascontiguousarray(unit), *arrays)[:, None])


def _edges_to_split(
    points: FloatArray,
    faces: IntArray,
    active: NDArray[np.bool_],
    arrays: LeafArrays,
    normals: FloatArray,
    offsets: FloatArray,
    tolerance_mm: float,
) -> tuple[IntArray, IntArray, FloatArray]:
    """Return each face's edge numbers (m, 3) in the order 01, 12, 20, the edges to split, and their new points.

    Only active faces are looked at: the others were found flat enough before. A split edge may still belong to one.
    """
    edges, of_face = number_edges(faces, len(points))
    some, of_some = faces[active], of_face[active]
    corners = points[some]
    span = corners[:, [1, 2, 0]] - corners
    length = np.sqrt((span * span).sum(axis=2))
    near = _reaches(corners, length.max(axis=1), normals, offsets)
    facet = np.cross(span[:, 0], -span[:, 2])
    facet /= np.maximum(np.linalg.norm(facet, axis=1, keepdims=True), 1e-300)

    asked = np.zeros(len(edges), dtype=bool)
    asked[of_some[near]] = True
    wanted = np.flatnonzero(asked)
    middles = np.zeros((len(edges), 3))
    middles[wanted] = points[edges[wanted]].mean(axis=1)
    slope = np.zeros(len(edges))
    np.maximum.at(slope, of_some, np.abs(np.einsum("fek,fk->fe", middles[of_some], facet)))
    flat = middles[wanted]
    middles[wanted] = _on_surface(flat, arrays)
    slope = np.maximum(slope[wanted] / np.linalg.norm(flat, axis=1), FLATTEST)
    gap = np.linalg.norm(middles[wanted] - flat, axis=1)
    marked = np.zeros(len(edges), dtype=bool)
    marked[wanted[gap * slope > tolerance_mm]] = True

    centre = corners[near].mean(axis=1)
    bulge = np.linalg.norm(_on_surface(centre, arrays) - centre, axis=1)
    slope = np.abs(np.einsum("fk,fk->f", centre, facet[near])) / np.linalg.norm(centre, axis=1)
    bent = np.flatnonzero(near)[bulge * np.maximum(slope, FLATTEST) > tolerance_mm]
    marked[of_some[bent, length[bent].argmax(axis=1)]] = True
    split = np.flatnonzero(marked)
    return of_face, split, middles[split]


def _reaches(corners: FloatArray, size: FloatArray, normals: FloatArray, offsets: FloatArray) -> NDArray[np.bool_]:
    """Return which triangles (k, 3, 3) may stand for surface within the region: none lies far beyond one plane."""
    reaches = np.ones(len(corners), dtype=bool)
    for normal, offset in zip(normals, offsets, strict=True):
        reaches &= (corners @ normal).min(axis=1) - offset <= size
    return reaches


def split_faces(faces: IntArray, new: IntArray) -> tuple[IntArray, NDArray[np.bool_]]:
    """Return the faces after edges were split, and which of them are new.

    new: (m, 3) the new vertex on each face's edges 01, 12, 20; −1: none.
    """
    count = (new >= 0).sum(axis=1)
    parts = [faces[count == 0]]
    # Turn each face so that a single split edge comes first, a single whole edge last.
    turn = np.where(count == 1, (new >= 0).argmax(axis=1), ((new < 0).argmax(axis=1) + 1) % 3)
    turn[count == 3] = 0
    index = (turn[:, None] + np.arange(3)) % 3
    corner, middle = np.take_along_axis(faces, index, axis=1), np.take_along_axis(new, index, axis=1)
    for wanted, patterns in _PATTERNS.items():
        chosen = count == wanted
        six = np.concatenate([corner[chosen], middle[chosen]], axis=1)
        parts += [six[:, list(p)] for p in patterns]
    out = np.concatenate(parts)
    return out, np.arange(len(out)) >= len(parts[0])


# Corners 0 1 2 and the new vertices 3 on (0, 1), 4 on (1, 2), 5 on (2, 0).
_PATTERNS = {
    1: ((0, 3, 2), (3, 1, 2)),
    2: ((3, 1, 4), (0, 3, 4), (0, 4, 2)),
    3: ((0, 3, 5), (3, 1, 4), (5, 4, 2), (3, 4, 5)),
}
