"""The frame in which a shape is fitted: centre of mass, principal axes, signs by third moments (DESIGN §3)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy.spatial.transform import Rotation

from hhsr.errors import SurfaceError
from hhsr.model import Cut, FloatArray, IntArray, Node, RetainedPart, frozen, rotation_matrix

ROTATION_STEP = 2.0**-22
SHIFT_STEP_SHARE = 2.0**-22
# Vertices lie on a grid of the longest side: the same source elsewhere, or larger, is then the same to the last bit,
# and so are all greedy choices. Where it was the same to 1e-5 mm only, they and the error (by up to 12 %) differed.
GRID_STEP = 2.0**-22


def normalise(vertices: FloatArray, faces: IntArray | None) -> tuple[FloatArray, FloatArray]:
    """Return the vertices on the shape's own axes, and the pose that carries them back.

    Parameters
    ----------
    vertices : (n, 3) mm, any frame.
    faces : (m, 3) outward triangles of a closed surface, or None: moments of the points instead of the solid.

    Returns
    -------
    (n, 3) mm, about the centre of mass, longest principal axis first, each of the first two axes pointing to the side
    of the positive third moment; and the pose (6,), rotation vector (rad) then translation (mm), p_source = R p + t.

    Raises
    ------
    SurfaceError : fewer than four points, or no extent.

    A rigid motion of the source changes the pose alone, a scaling scales the vertices. Both are exact but for a source
    so rounded that its vertices fall on other points of the grid (2⁻²² of the longest side).
    """
    points = np.asarray(vertices, dtype=np.float64)
    if points.shape[0] < 4:
        raise SurfaceError(f"vertices: got {points.shape[0]} points, expected at least 4 that span a solid")
    used = np.unique(faces) if faces is not None else np.arange(points.shape[0])
    middle = points[used].mean(axis=0)
    extent = float(np.ptp(points[used], axis=0).max())
    if not extent > 0.0:
        raise SurfaceError("vertices: all points are the same, expected points that span a solid")
    unit = (points - middle) / extent
    centre, second = _moments(unit, faces)
    axes = np.linalg.eigh(second)[1][:, ::-1].T.copy()
    axes[2] = np.cross(axes[0], axes[1])
    along = np.einsum("ij,kj->ik", unit - centre, axes)
    for axis in range(2):
        if _third_moment(along[:, axis], along, faces) < 0.0:
            axes[axis] = -axes[axis]
    axes[2] = np.cross(axes[0], axes[1])
    along = np.einsum("ij,kj->ik", unit - centre, axes)
    vector = np.round(Rotation.from_matrix(axes.T).as_rotvec() / ROTATION_STEP) * ROTATION_STEP
    step = 2.0 ** np.floor(np.log2(extent)) * SHIFT_STEP_SHARE
    shift = np.round((middle + extent * centre) / step) * step
    local, size = on_grid(along * extent, used)
    return local * size, np.concatenate([vector, shift])


def on_grid(vertices: FloatArray, used: IntArray) -> tuple[FloatArray, float]:
    """Return vertices (n, 3) in units of the longest side of those used, on a grid of 2⁻²² of it, and that side, mm."""
    size = float(np.ptp(vertices[used], axis=0).max())
    local: FloatArray = np.round(vertices / (size * GRID_STEP)) * GRID_STEP
    return local, size


def scaled(node: Node, factor: float) -> Node:
    """Return a node with all of its lengths times a factor."""
    if isinstance(node, Cut):
        contours = tuple(
            replace(c, centre=frozen(c.centre * factor), half_axes=frozen(c.half_axes * factor)) for c in node.contours
        )
        return replace(
            node,
            offset=node.offset * factor,
            half_width=node.half_width * factor,
            contours=contours,
            left=scaled(node.left, factor),
            right=scaled(node.right, factor),
        )
    if isinstance(node, RetainedPart):
        return replace(node, vertices=frozen(node.vertices * factor))
    base = replace(node.superquadric, half_axes=frozen(node.superquadric.half_axes * factor))
    return replace(node, centre=frozen(node.centre * factor), superquadric=base)


def apply_inverse(points: FloatArray, pose: FloatArray) -> FloatArray:
    """Return (..., 3) source points in the normalised frame of `pose`: Rᵀ (p − t)."""
    shifted = np.asarray(points, dtype=np.float64) - pose[3:]
    turned: FloatArray = np.einsum("...j,ji->...i", shifted, rotation_matrix(pose[:3]))
    return turned


def _moments(points: FloatArray, faces: IntArray | None) -> tuple[FloatArray, FloatArray]:
    """Return the centre of mass (3,) and the second central moments (3, 3) of the solid, or of the points."""
    if faces is None:
        centre = points.mean(axis=0)
        return centre, np.einsum("ni,nj->ij", points - centre, points - centre) / points.shape[0]
    corners = points[faces]
    volumes = _volumes(corners)
    total = volumes.sum()
    if not total > 0.0:
        return _moments(points[np.unique(faces)], None)
    sums = corners.sum(axis=1)
    centre = np.einsum("f,fi->i", volumes, sums) / (4.0 * total)
    second = np.einsum("f,fi,fj->ij", volumes, sums, sums) + np.einsum("f,fki,fkj->ij", volumes, corners, corners)
    return centre, second / (20.0 * total) - np.outer(centre, centre)


def _third_moment(values: FloatArray, points: FloatArray, faces: IntArray | None) -> float:
    """Return the third moment of one coordinate, `values`, over the solid or over the points."""
    if faces is None:
        return float((values**3).mean())
    volumes = _volumes(points[faces])
    a, b, c = values[faces].T
    cubic = a**3 + b**3 + c**3 + a * a * (b + c) + b * b * (a + c) + c * c * (a + b) + a * b * c
    return float((volumes * cubic).sum())


def _volumes(corners: FloatArray) -> FloatArray:
    """Return six times the signed volume of each triangle's tetrahedron with the origin, (m,) from (m, 3, 3)."""
    volumes: FloatArray = np.einsum("fi,fi->f", corners[:, 0], np.cross(corners[:, 1], corners[:, 2]))
    return volumes
