"""Points on a surface, evenly by area and the same for the same seed (DESIGN §3)."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np

from hhsr.errors import SurfaceError
from hhsr.model import FloatArray, IntArray


class Samples(NamedTuple):
    """Points drawn on triangles: (n, 3) mm, outward unit normals (n, 3) of their triangles, (n,) triangle of each."""

    points: FloatArray
    normals: FloatArray
    face: IntArray


def face_areas(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return the area of each triangle, (m,) mm²."""
    areas: FloatArray = 0.5 * np.sqrt((_crosses(vertices, faces) ** 2).sum(axis=1))
    return areas


def area_samples(vertices: FloatArray, faces: IntArray, count: int, seed: int = 0) -> Samples:
    """Return `count` points spread over the surface in proportion to area.

    The triangles' areas are laid end to end and cut into `count` equal strata, one point in each: the mean of a smooth
    quantity is far less noisy than with independent points. Nothing depends on the machine's number of threads.

    Parameters
    ----------
    vertices, faces : (n, 3) mm, (m, 3) triangles.
    count : number of points, ≥ 1.
    seed : of the generator.

    Raises
    ------
    SurfaceError : the triangles have no area.
    """
    crosses = _crosses(vertices, faces)
    doubled = np.sqrt((crosses**2).sum(axis=1))
    ends = np.cumsum(doubled)
    if not (ends.size and ends[-1] > 0.0):
        raise SurfaceError("faces: the surface has no area, expected triangles that enclose a solid")
    random = np.random.default_rng(seed)
    at = (np.arange(count) + random.random(count)) * (ends[-1] / count)
    face = np.minimum(np.searchsorted(ends, at, side="right"), ends.size - 1)
    root, share = np.sqrt(random.random(count)), random.random(count)
    weights = np.stack([1.0 - root, root * (1.0 - share), root * share], axis=1)
    points = np.einsum("nk,nki->ni", weights, vertices[faces[face]])
    return Samples(points, crosses[face] / doubled[face, None], face.astype(np.int64))


def vertex_normals(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (n, 3) unit normals, the area-weighted mean of the triangles around each vertex; 0 for an orphan."""
    total = np.zeros_like(vertices)
    crosses = _crosses(vertices, faces)
    for corner in range(3):
        for axis in range(3):
            total[:, axis] += np.bincount(faces[:, corner], crosses[:, axis], vertices.shape[0])
    length = np.sqrt((total**2).sum(axis=1, keepdims=True))
    normals: FloatArray = np.divide(total, length, out=np.zeros_like(total), where=length > 0.0)
    return normals


def turned_fibonacci(count: int, seed: int = 0) -> FloatArray:
    """Return (count, 3) unit directions, evenly spread, turned by a seeded random rotation.

    The turn keeps rays and test directions off the centres of the scale field's grids, which are unturned.
    """
    index = np.arange(count) + 0.5
    z = 1.0 - 2.0 * index / count
    turn = math.pi * (3.0 - math.sqrt(5.0)) * index
    ring = np.sqrt(1.0 - z * z)
    even = np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)
    basis: FloatArray = np.linalg.qr(np.random.default_rng(seed).standard_normal((3, 3)))[0]
    turned: FloatArray = np.einsum("ij,nj->ni", basis, even)
    return turned


def side_by_side(directions: FloatArray) -> FloatArray:
    """Return (n, 3) unit directions put in order: to and fro in bands, so that one is near to the next.

    What is asked of a tree for one of them is then a good guess for the next: half of the time for nearest points.
    """
    bands = max(math.isqrt(len(directions) // 3), 1)
    band = np.minimum((0.5 * bands * (1.0 - directions[:, 2])).astype(np.int64), bands - 1)
    azimuth = np.arctan2(directions[:, 1], directions[:, 0])
    order = np.lexsort((np.where(band % 2, -azimuth, azimuth), band))
    return np.ascontiguousarray(directions[order])


def _crosses(vertices: FloatArray, faces: IntArray) -> FloatArray:
    """Return (m, 3) outward normals of the triangles, as long as twice their area."""
    corners = np.asarray(vertices, dtype=np.float64)[faces]
    return np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
