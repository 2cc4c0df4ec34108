"""Spherical harmonics of the radius about one centre, by regularised least squares on the surface's points.

Parameters: 3 for the centre, (degree + 1)² coefficients. The published comparator exploded where a direction meets the
surface more than once; here samples count by how squarely their ray meets the surface, high degrees are damped by
(l (l + 1))², and centre and damping are those whose mesh is nearest to the source by true two-sided distance.
"""

from __future__ import annotations

import math

import numpy as np
import trimesh

from hhsr.baselines.distances import mesh_error
from hhsr.errors import FitError
from hhsr.fitting.samples import area_samples
from hhsr.model import FloatArray, IntArray
from hhsr.triangle_tree import TriangleTree

SAMPLES = 12_000
DAMPINGS = (0.0, 1e-10, 1e-8, 1e-6, 1e-4, 1e-3)
LEAST_COSINE = 0.2
CENTRES = 6
ROUGH_SAMPLES = 3000


def fit_spherical_harmonics(
    vertices: FloatArray, faces: IntArray, max_parameters: int, seed: int = 0
) -> tuple[FloatArray, IntArray, int]:
    """Return the mesh of the best radial expansion of at most `max_parameters` numbers, and how many it has."""
    degree = math.isqrt(max_parameters - 3) - 1 if max_parameters >= 4 else -1
    if degree < 0:
        raise FitError(f"max_parameters: got {max_parameters}, expected at least 4: a centre and a mean radius")
    sphere = trimesh.creation.icosphere(subdivisions=5)
    directions, triangles = np.asarray(sphere.vertices), np.asarray(sphere.faces, dtype=np.int64)
    basis_out = harmonics(directions, degree)
    samples = area_samples(vertices, faces, SAMPLES, seed)
    best: tuple[float, FloatArray, FloatArray] | None = None
    for centre in _centres(vertices, faces, samples.points, samples.normals, seed):
        normal, right, penalty = _normal_equations(samples.points - centre, samples.normals, degree)
        for damping in DAMPINGS:
            matrix = normal + np.diag(damping * penalty + 1e-12) * np.trace(normal) / len(normal)
            coefficients = np.linalg.solve(matrix, right)
            radii = np.maximum(basis_out @ coefficients, 1e-3)
            shape = centre + radii[:, None] * directions
            error = mesh_error(shape, triangles, vertices, faces, ROUGH_SAMPLES, seed).mean_mm
            if best is None or error < best[0]:
                best = (error, centre, coefficients)
    assert best is not None
    fine = trimesh.creation.icosphere(subdivisions=6)
    directions = np.asarray(fine.vertices)
    radii = np.concatenate([harmonics(part, degree) @ best[2] for part in np.array_split(directions, 8)])
    points = best[1] + np.maximum(radii, 1e-3)[:, None] * directions
    return points, np.asarray(fine.faces, dtype=np.int64), 3 + (degree + 1) ** 2


def _centres(
    vertices: FloatArray, faces: IntArray, points: FloatArray, normals: FloatArray, seed: int
) -> list[FloatArray]:
    """Return centres worth trying: of mass, and points inside from which most of the surface is seen from within."""
    corners = vertices[faces]
    sixfold = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    mass = (sixfold[:, None] * corners.sum(axis=1)).sum(axis=0) / (4.0 * sixfold.sum())
    rng = np.random.default_rng(seed)
    tries = rng.uniform(vertices.min(axis=0), vertices.max(axis=0), (400, 3))
    inside = tries[TriangleTree(vertices, faces).contains(tries)]
    seen = [_seen_share(points[::8] - centre, normals[::8]) for centre in inside]
    order = np.argsort(seen)[::-1][: CENTRES - 1]
    return [mass, *inside[order]]


def _seen_share(rays: FloatArray, normals: FloatArray) -> float:
    cosine = np.einsum("ni,ni->n", rays, normals) / np.linalg.norm(rays, axis=1)
    return float(np.minimum(cosine, 0.3).mean())


def _normal_equations(rays: FloatArray, normals: FloatArray, degree: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    length = np.linalg.norm(rays, axis=1)
    directions = rays / length[:, None]
    weight = np.maximum(np.abs(np.einsum("ni,ni->n", directions, normals)), LEAST_COSINE) ** 2
    basis = harmonics(directions, degree)
    orders = np.repeat(np.arange(degree + 1), 2 * np.arange(degree + 1) + 1)
    penalty = (orders * (orders + 1.0)) ** 2
    return basis.T @ (weight[:, None] * basis), basis.T @ (weight * length), penalty


def harmonics(directions: FloatArray, degree: int) -> FloatArray:
    """Return (n, (degree + 1)²) real spherical harmonics of unit directions, orthonormal on the sphere.

    Order: l = 0 … degree; within each m = −l … l (sines below 0, cosines from 0). Fully normalised recurrences.
    """
    x, y, z = directions.T
    ring = np.hypot(x, y)
    azimuth = np.arctan2(y, x)
    out = np.empty((len(directions), (degree + 1) ** 2))
    diagonal = np.full(len(directions), math.sqrt(1.0 / (4.0 * math.pi)))
    for m in range(degree + 1):
        if m:
            diagonal = diagonal * ring * math.sqrt((2 * m + 1) / (2 * m))
        before, now = np.zeros_like(z), diagonal
        scale = math.sqrt(2.0) if m else 1.0
        cosine, sine = scale * np.cos(m * azimuth), scale * np.sin(m * azimuth)
        for order in range(m, degree + 1):
            if order > m:
                a = math.sqrt((4 * order * order - 1) / (order * order - m * m))
                b = math.sqrt(((order - 1) ** 2 - m * m) / (4 * (order - 1) ** 2 - 1)) if order > m + 1 else 0.0
                before, now = now, a * (z * now - b * before)
            middle = order * order + order
            out[:, middle + m] = cosine * now
            if m:
                out[:, middle - m] = sine * now
    return out
