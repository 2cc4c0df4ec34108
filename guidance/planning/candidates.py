"""Candidate needles: every allowed entry towards the target."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from guidance.errors import SceneError
from guidance.needle import Array
from guidance.scene import Scene


@dataclass(frozen=True, eq=False)
class Candidates:
    """Straight paths as arrays: `entries`, `tips` (n, 3) mm; `inward` (n, 3) unit normals into the entered surface.

    `inward` is NaN where the entry is not on a surface (template holes, listed points).
    """

    entries: Array
    tips: Array
    inward: Array

    @cached_property
    def directions(self) -> Array:
        """Unit vectors (n, 3) from entry to tip; NaN where both are one point."""
        across = self.tips - self.entries
        length = np.linalg.norm(across, axis=1)
        return np.asarray(across / np.where(length > 0.0, length, np.nan)[:, None])

    @cached_property
    def depths(self) -> Array:
        """Inserted lengths (n,), mm."""
        return np.asarray(np.linalg.norm(self.tips - self.entries, axis=1))

    def __len__(self) -> int:
        return len(self.entries)


def make_candidates(scene: Scene, offsets: Array) -> Candidates:
    """Pair every entry of the scene with the target point moved by each of the offsets (m, 3), mm."""
    points, inward = _entries(scene)
    tips = scene.target.point + offsets
    n, m = len(points), len(tips)
    return Candidates(np.repeat(points, m, axis=0), np.tile(tips, (n, 1)), np.repeat(inward, m, axis=0))


def aim_offsets(tolerance_mm: float) -> Array:
    """Six other points (6, 3) within the target's tolerance, for when its very centre cannot be reached."""
    return 0.6 * tolerance_mm * np.concatenate([np.eye(3), -np.eye(3)])


def _entries(scene: Scene) -> tuple[Array, Array]:
    entry = scene.entry
    points, inward = [entry.points], [np.full((len(entry.points), 3), np.nan)]
    if entry.structure is not None and not len(entry.points):
        shape = scene.structure(entry.structure).shape
        if shape is None:
            raise SceneError(f"structure {entry.structure!r} has no model, so no entry can be placed on it")
        on_surface, normals = _spread(shape.mesh(0.2), entry.count)
        points.append(on_surface)
        inward.append(-normals)
    return np.concatenate(points), np.concatenate(inward)


def _spread(mesh: object, count: int) -> tuple[Array, Array]:
    """`count` points (n, 3) spread over a mesh in proportion to area, and the faces' unit normals (n, 3).

    One point per equal share of the cumulated area, its place in the triangle by the R2 sequence: no random numbers.
    """
    triangles = np.asarray(mesh.triangles, dtype=np.float64)  # type: ignore[attr-defined]
    a, b, c = triangles[:, 0], triangles[:, 1], triangles[:, 2]
    normal = np.cross(b - a, c - a)
    area = np.linalg.norm(normal, axis=1)
    cumulated = np.cumsum(area)
    face = np.searchsorted(cumulated, (np.arange(count) + 0.5) / count * cumulated[-1])
    face = np.minimum(face, len(area) - 1)
    k = np.arange(1, count + 1)
    u, v = (0.7548776662466927 * k) % 1.0, (0.5698402909980532 * k) % 1.0
    fold = u + v > 1.0
    u, v = np.where(fold, 1.0 - u, u)[:, None], np.where(fold, 1.0 - v, v)[:, None]
    points = a[face] + u * (b[face] - a[face]) + v * (c[face] - a[face])
    return points, normal[face] / np.maximum(area[face], 1e-300)[:, None]
