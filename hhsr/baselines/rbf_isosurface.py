"""RBF iso-surface: the zero set of Σ w_j φ(|x − c_j|) + a linear function, its centres chosen greedily.

As in the paper's comparator (Carr et al. 2001), but fitted to true signed distances near the surface, with both usual
kernels tried, and its mesh put onto the exact zero set. Parameters: 4 a centre, 4 of the linear function.
"""

from __future__ import annotations

import numpy as np
from skimage.measure import marching_cubes

from hhsr.baselines.distances import mesh_error
from hhsr.errors import FitError
from hhsr.fitting.samples import area_samples
from hhsr.model import FloatArray, IntArray
from hhsr.read.quality import body_volumes
from hhsr.read.topology import body_of_faces
from hhsr.triangle_tree import TriangleTree

SURFACE_SAMPLES = 3000
OFFSETS = (0.02, 0.08)  # of the longest side, to both sides
FAR_SAMPLES = 800
ROUNDS = 10
CELLS = 80
KERNELS = (1, 3)
RIDGE = 1e-9


def fit_rbf_isosurface(
    vertices: FloatArray, faces: IntArray, max_parameters: int, seed: int = 0
) -> tuple[FloatArray, IntArray, int]:
    """Return the mesh of the best iso-surface of at most `max_parameters` numbers, and how many it has."""
    count = (max_parameters - 4) // 4
    if count < 4:
        raise FitError(f"max_parameters: got {max_parameters}, expected at least 20: four centres and a plane")
    middle, size = vertices.mean(axis=0), float(np.ptp(vertices, axis=0).max())
    points, values, weights = _targets((vertices - middle) / size, faces, seed)
    best: tuple[float, FloatArray, IntArray] | None = None
    for power in KERNELS:
        centres, solution = _greedy(points, values, weights, count, power)
        mesh = _zero_set(centres, solution, power)
        if mesh is None:
            continue
        found = mesh[0] * size + middle
        error = mesh_error(found, mesh[1], vertices, faces, 4000, seed).mean_mm
        if best is None or error < best[0]:
            best = (error, found, mesh[1])
    if best is None:
        return np.zeros((0, 3)), np.zeros((0, 3), dtype=np.int64), 4 * count + 4
    return best[1], best[2], 4 * count + 4


def _targets(vertices: FloatArray, faces: IntArray, seed: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return points, signed distances and weights: on the surface, near it on both sides, and all around."""
    tree = TriangleTree(vertices, faces)
    on = area_samples(vertices, faces, SURFACE_SAMPLES, seed)
    near = [on.points[i::2] + side * offset * on.normals[i::2] for i, offset in enumerate(OFFSETS) for side in (-1, 1)]
    far = np.random.default_rng(seed).uniform(
        vertices.min(axis=0) - 0.15, vertices.max(axis=0) + 0.15, (FAR_SAMPLES, 3)
    )
    points = np.concatenate([on.points, *near, far])
    distance = tree.closest(points)[0]
    values = np.where(tree.contains(points), -distance, distance)
    values[: len(on.points)] = 0.0
    weights = 1.0 / (1.0 + (np.abs(values) / 0.01) ** 2)
    return points, values, np.sqrt(weights)


def _greedy(
    points: FloatArray, values: FloatArray, weights: FloatArray, count: int, power: int
) -> tuple[FloatArray, FloatArray]:
    """Return (count, 3) centres and the solution; each round adds the farthest apart of the worst-fitted points."""
    chosen = _spread(points, np.ones(len(points)), np.zeros((0, 3)), max(count // ROUNDS, 4))
    while True:
        basis = _basis(points, points[chosen], power)
        solution = _solve(weights[:, None] * basis, weights * values)
        if len(chosen) >= count:
            return points[chosen], solution
        residual = np.abs(weights * (basis @ solution - values))
        more = min(max(count // ROUNDS, 1), count - len(chosen))
        chosen = np.r_[chosen, _spread(points, residual, points[chosen], more)]


def _spread(points: FloatArray, worth: FloatArray, taken: FloatArray, count: int) -> IntArray:
    """Return indices of `count` points, one after another of most worth times distance to what is taken."""
    distance = np.full(len(points), 1.0)
    for centre in taken:
        np.minimum(distance, np.linalg.norm(points - centre, axis=1), out=distance)
    found = []
    for _ in range(count):
        index = int(np.argmax(worth * distance))
        found.append(index)
        np.minimum(distance, np.linalg.norm(points - points[index], axis=1), out=distance)
    return np.array(found, dtype=np.int64)


def _solve(basis: FloatArray, values: FloatArray) -> FloatArray:
    scale = np.linalg.norm(basis, axis=0)
    scaled = basis / scale
    matrix = scaled.T @ scaled
    solution: FloatArray = np.linalg.solve(matrix + RIDGE * np.eye(len(matrix)), scaled.T @ values) / scale
    return solution


def _basis(points: FloatArray, centres: FloatArray, power: int) -> FloatArray:
    square = np.maximum((points**2).sum(axis=1)[:, None] + (centres**2).sum(axis=1) - 2.0 * points @ centres.T, 0.0)
    return np.hstack([square ** (power / 2), np.ones((len(points), 1)), points])


def _value(points: FloatArray, centres: FloatArray, solution: FloatArray, power: int) -> FloatArray:
    parts = np.array_split(points, max(len(points) // 20_000, 1))
    return np.concatenate([_basis(part, centres, power) @ solution for part in parts])


def _gradient(points: FloatArray, centres: FloatArray, solution: FloatArray, power: int) -> FloatArray:
    away = points[:, None, :] - centres
    length = np.maximum(np.linalg.norm(away, axis=2), 1e-12)
    slope: FloatArray = (
        np.einsum("nk,nki->ni", power * length ** (power - 2) * solution[: len(centres)], away) + solution[-3:]
    )
    return slope


def _zero_set(centres: FloatArray, solution: FloatArray, power: int) -> tuple[FloatArray, IntArray] | None:
    """Return the zero set's mesh, its vertices moved onto it by Newton's steps; None where there is none."""
    low, high = centres.min(axis=0) - 0.06, centres.max(axis=0) + 0.06
    step = float((high - low).max()) / CELLS
    axes = [np.arange(a, b + step, step) for a, b in zip(low, high, strict=True)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    values = _value(grid.reshape(-1, 3), centres, solution, power).reshape(grid.shape[:3])
    values = np.pad(values, 1, constant_values=float(np.abs(values).max()) + 1e-6)  # closed, whatever the function does
    if values.min() >= 0:
        return None
    found = marching_cubes(values, 0.0)  # type: ignore[no-untyped-call]
    points = (found[0].astype(np.float64) - 1.0) * step + low
    for _ in range(3):
        parts = np.array_split(points, max(len(points) // 4000, 1))
        moved = []
        for part in parts:
            slope = _gradient(part, centres, solution, power)
            length = np.maximum((slope**2).sum(axis=1), 1e-12)
            away = np.clip(_value(part, centres, solution, power) / np.sqrt(length), -step / 4, step / 4)
            moved.append(part - (away / np.sqrt(length))[:, None] * slope)
        points = np.concatenate(moved)
    return _largest_body(points, found[1].astype(np.int64))


def _largest_body(points: FloatArray, faces: IntArray) -> tuple[FloatArray, IntArray]:
    """Return the body of most volume: whoever decodes the function can drop the sheets that it invents far away."""
    bodies = body_of_faces(faces)
    kept = faces[bodies == int(np.argmax(np.abs(body_volumes(points, faces, bodies))))]
    used = np.unique(kept)
    return points[used], np.searchsorted(used, kept)
