"""The closed surface of a point cloud with normals: Poisson reconstruction on a grid, then moved onto the points.

Everything after reading (rays, insides, volumes, two-sided errors) needs a closed surface, so a cloud is made into one
at the border. The indicator's gradient is the normals' field (Kazhdan et al. 2006; solved by FFT), which closes gaps
and bears noise; its level set is then put onto the points by moving least squares with their normals (Kolluri 2005), so
the grid's cell does not limit the accuracy. 20,000 points of a 230 mm liver: 0.07 mm from it in the mean.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.fft import irfftn, next_fast_len, rfftn
from scipy.ndimage import map_coordinates
from scipy.spatial import cKDTree
from skimage.measure import marching_cubes

from hhsr.errors import SurfaceError
from hhsr.model import FloatArray, IntArray
from hhsr.read.topology import body_of_faces

CELLS = 96  # over the longest side
MARGIN = 16  # cells around; the FFT is periodic
NEIGHBOURS = 12
FEWEST = 100
# A surface is bare where it is farther from its nearest point than 0.7 of the way to that point's twelfth neighbour (an
# even random cloud leaves 0.3 % bare by that) and than a fortieth of the longest side.
BARE_SHARE, FINE_SHARE = 0.7, 1 / 40
MOST_BARE_SHARE = 0.05


_Kept = tuple[FloatArray, IntArray, IntArray]


def surface_of_points(points: FloatArray, normals: FloatArray | None) -> tuple[FloatArray, IntArray, tuple[str, ...]]:
    """Return vertices, faces and warnings of the closed surface of a cloud, in the cloud's frame and unit.

    points : (n, 3). normals : (n, 3) outward (or all inward), any length.

    Raises
    ------
    SurfaceError : no normals, not finite, fewer than 100 points, or large parts of the surface without points.
    """
    unit_normals = _checked(points, normals)
    tree = cKDTree(points)
    near = tree.query(points, NEIGHBOURS)[0]
    spacing = float(np.median(near[:, 1:5]))
    areas = np.pi * near[:, -1] ** 2 / NEIGHBOURS
    vertices, faces = _poisson(points, unit_normals, areas)
    vertices = _onto_points(vertices, points, unit_normals, tree)
    distance, nearest = tree.query(vertices)
    reach = np.maximum(BARE_SHARE * near[nearest, -1], FINE_SHARE * float(np.ptp(points, axis=0).max()))
    vertices, faces, kept = _bodies_with_points(vertices, faces, distance < 2.0 * reach)
    share = float((distance > reach)[kept].mean())
    if share > MOST_BARE_SHARE:
        raise SurfaceError(
            f"{100 * share:.0f} % of the surface is bare of points (they are {spacing:.3g} apart), expected "
            f"{100 * MOST_BARE_SHARE:.0f} % at most: the cloud is too sparse or open; add points, or give a mesh"
        )
    words = (
        f"reconstructed from {len(points)} points, {spacing:.3g} apart; at most {distance[kept].max():.3g} from a point"
    )
    return vertices, faces, (words,)


def _checked(points: FloatArray, normals: FloatArray | None) -> FloatArray:
    """Return unit normals; SurfaceError where the cloud cannot be used."""
    if normals is None:
        raise SurfaceError(
            f"the file holds {len(points)} points, no triangles and no normals (nx, ny, nz); expected a mesh or normals"
        )
    if len(points) < FEWEST:
        raise SurfaceError(f"the file holds {len(points)} points and no triangles, expected at least {FEWEST} points")
    length = np.linalg.norm(normals, axis=1)
    bad = ~(np.isfinite(points).all(axis=1) & np.isfinite(length) & (length > 0))
    if bad.any():
        raise SurfaceError(f"{int(bad.sum())} points or normals are zero or not finite (first: point {np.argmax(bad)})")
    return np.asarray(normals / length[:, None])


def _poisson(points: FloatArray, normals: FloatArray, areas: FloatArray) -> tuple[FloatArray, IntArray]:
    """Return the level set of the indicator whose gradient is −Σ area · normal · Gaussian (σ: 1.2 cells)."""
    low, side = points.min(axis=0), np.ptp(points, axis=0)
    cell = float(side.max()) / CELLS
    if cell == 0:
        raise SurfaceError("all points of the cloud are the same, expected a surface")
    shape = tuple(next_fast_len(int(np.ceil(length / cell)) + 2 * MARGIN, real=True) for length in side)
    at = (points - low) / cell + MARGIN
    waves = np.meshgrid(
        *(2 * np.pi * np.fft.fftfreq(n) for n in shape[:2]), 2 * np.pi * np.fft.rfftfreq(shape[2]), indexing="ij"
    )
    square = sum(wave**2 for wave in waves)
    square[0, 0, 0] = 1.0
    spectrum = sum(1j * wave * rfftn(_splat(at, areas * normals[:, axis], shape)) for axis, wave in enumerate(waves))
    smooth = np.exp(-0.5 * 1.2**2 * square) / square
    smooth[0, 0, 0] = 0.0
    indicator = irfftn(spectrum * smooth, shape)
    level = float(np.average(map_coordinates(indicator, at.T, order=1), weights=areas))
    found = marching_cubes(indicator, level, gradient_direction="ascent")  # type: ignore[no-untyped-call]
    return (found[0].astype(np.float64) - MARGIN) * cell + low, found[1].astype(np.int64)


def _splat(at: FloatArray, values: FloatArray, shape: tuple[int, ...]) -> FloatArray:
    """Return values spread to the eight grid points around each position, in linear shares."""
    base = np.floor(at).astype(np.int64)
    rest = at - base
    out = np.zeros(int(np.prod(shape)))
    for corner in np.ndindex(2, 2, 2):
        share = np.prod(np.where(np.array(corner) == 1, rest, 1.0 - rest), axis=1)
        index = np.ravel_multi_index(tuple((base + np.array(corner)).T), shape)
        out += np.bincount(index, share * values, out.size)
    return out.reshape(shape)


def _onto_points(vertices: FloatArray, points: FloatArray, normals: FloatArray, tree: cKDTree) -> FloatArray:
    """Return the vertices on the moving-least-squares surface of the points and their normals."""
    for _ in range(3):
        distance, index = tree.query(vertices, NEIGHBOURS)
        reach = distance[:, 4:5] + 1e-300
        weights = np.exp(-((distance / reach) ** 2))
        weights /= weights.sum(axis=1, keepdims=True)
        direction = np.einsum("vk,vkj->vj", weights, normals[index])
        direction /= np.maximum(np.linalg.norm(direction, axis=1, keepdims=True), 1e-12)
        height = np.einsum("vk,vkj,vkj->v", weights, vertices[:, None, :] - points[index], normals[index])
        vertices = vertices - np.clip(height, -reach[:, 0], reach[:, 0])[:, None] * direction
    return vertices


def _bodies_with_points(vertices: FloatArray, faces: IntArray, near: NDArray[np.bool_]) -> _Kept:
    """Drop bodies that no points lie on (bubbles); return what is left, and which vertices those were."""
    bodies = body_of_faces(faces)
    share = np.bincount(bodies, near[faces].all(axis=1)) / np.bincount(bodies)
    left = faces[(share > 0.5)[bodies]]
    used = np.unique(left)
    if not used.size:
        raise SurfaceError("no closed surface lies on the points; are the normals consistent?")
    return vertices[used], np.searchsorted(used, left), used
