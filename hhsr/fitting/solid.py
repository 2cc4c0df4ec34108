"""What the default fit knows of its source: triangles that answer, even samples, points deep inside (DESIGN §3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hhsr.fitting.rows import BoolArray
from hhsr.fitting.samples import Samples, area_samples, face_areas
from hhsr.model import Cut, FloatArray, IntArray, Node
from hhsr.triangle_tree import TriangleTree


class Region(NamedTuple):
    """A convex part of space: normals (k, 3), offsets (k,); p lies in it where normals · p ≥ offsets."""

    normals: FloatArray
    offsets: FloatArray

    def holds(self, points: FloatArray) -> BoolArray:
        """Return (n,) bool: which of (n, 3) points lie in the region."""
        inside = np.ones(points.shape[0], dtype=bool)
        for normal, offset in zip(self.normals, self.offsets, strict=True):
            inside &= np.einsum("ni,i->n", points, normal) >= offset
        return inside

    def halves(self, normal: FloatArray, offset: float) -> tuple[Region, Region]:
        """Return what lies below and above a plane."""
        below = Region(np.vstack([self.normals, -normal]), np.append(self.offsets, -offset))
        above = Region(np.vstack([self.normals, normal]), np.append(self.offsets, offset))
        return below, above

    def exits(self, origin: FloatArray, directions: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return (n,) how far rays from a point of the region run in it, and (n,) their cosine at its end."""
        reach = np.full(directions.shape[0], np.inf)
        cosine = np.ones(directions.shape[0])
        for normal, offset in zip(self.normals, self.offsets, strict=True):
            speed = -np.einsum("ni,i->n", directions, normal)
            room = max(float(normal @ origin) - offset, 0.0)
            t = np.where(speed > 1e-9, room / np.maximum(speed, 1e-9), np.inf)
            nearer = t < reach
            reach[nearer], cosine[nearer] = t[nearer], speed[nearer]
        return reach, cosine


def everywhere() -> Region:
    """Return the region without a bound."""
    return Region(np.zeros((0, 3)), np.zeros(0))


def regions(node: Node, region: Region | None = None) -> list[Region]:
    """Return each leaf's region, left to right."""
    region = everywhere() if region is None else region
    if not isinstance(node, Cut):
        return [region]
    below, above = region.halves(node.normal, node.offset)
    return regions(node.left, below) + regions(node.right, above)


class Solid(NamedTuple):
    """A closed surface in its normalised frame, mm.

    triangles: answers nearest points and rays. samples: even by area. sample_area: mm² that each of them stands for.
    inner: (c, 3) points inside the solid, half way through it as seen from the surface; depth: (c,) how far from where
    they were seen. size: longest side, mm.
    """

    vertices: FloatArray
    faces: IntArray
    triangles: TriangleTree
    samples: Samples
    sample_area: float
    inner: FloatArray
    depth: FloatArray
    size: float


def solid_of(vertices: FloatArray, faces: IntArray, samples: int, seed: int) -> Solid:
    """Return what the fit needs to know of a closed surface."""
    triangles = TriangleTree(vertices, faces)
    drawn = area_samples(vertices, faces, samples, seed)
    size = float(np.ptp(vertices[np.unique(faces)], axis=0).max())
    inner, depth = _inner_points(triangles, area_samples(vertices, faces, 2000, seed + 1), size)
    area = float(face_areas(vertices, faces).sum())
    return Solid(vertices, faces, triangles, drawn, area / samples, inner, depth, size)


def _inner_points(triangles: TriangleTree, seen: Samples, size: float) -> tuple[FloatArray, FloatArray]:
    """Return the middles of the chords that start inwards along the normals, and half their lengths."""
    start = seen.points - 1e-6 * size * seen.normals
    chord, _ = triangles.first_hit(start, -seen.normals)
    good = np.isfinite(chord) & (chord > 1e-4 * size)
    middle = start[good] - 0.5 * chord[good, None] * seen.normals[good]
    inside = triangles.contains(middle)
    if not inside.any():  # an inverted or paper-thin surface: its own samples are the deepest points there are
        return seen.points, np.zeros(seen.points.shape[0])
    return middle[inside], 0.5 * chord[good][inside]
