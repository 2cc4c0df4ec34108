"""Where a leaf is cut off: points of its planes that lie in the solid, and whether it covers them (DESIGN §2, §3).

What a leaf does not cover there is a void, with a step face as deep as the solid is: an error that neither the samples
of the source nor the leaf's own points tell much of.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import NamedTuple

import numpy as np

from hhsr.fitting.solid import Region, Solid
from hhsr.fitting.task import polar
from hhsr.model import FloatArray, plane_frame

POINTS_ACROSS = 64
HALVINGS = 4
STEEPEST = 2.0
HALF_DIAGONAL = 0.5**0.5


class Section(NamedTuple):
    """Points on the planes of a leaf's region that lie inside the solid.

    along: (m, 3) unit directions from the leaf's centre. reach: (m,) mm, their distances. depth: (m,) mm from the
    source's surface. hit: (m,) mm to the first surface on the way; less than `reach` where a point is hidden.
    cell: (m,) mm² that each stands for.
    """

    along: FloatArray
    reach: FloatArray
    depth: FloatArray
    hit: FloatArray
    cell: FloatArray

    def joined(self, other: Section) -> Section:
        """Return the points of both."""
        return Section(*(np.concatenate(pair) for pair in zip(self, other, strict=True)))


def section_of(solid: Solid, region: Region, centre: FloatArray) -> Section:
    """Return the points of a region's planes inside the solid, evenly spread, as seen from a centre in the region."""
    spacing = solid.size / POINTS_ACROSS
    found = [np.zeros((0, 3))]
    for grid, _, others in _planes(solid, region, spacing):
        points = grid[others.holds(grid)]
        found.append(points[solid.triangles.contains(points)])
    return _seen(solid, centre, np.concatenate(found), spacing)


def near_voids(
    solid: Solid, region: Region, centre: FloatArray, radii: Callable[[FloatArray], FloatArray], least: float
) -> Section:
    """Return points, 16 times as near to each other as a section's, at which a leaf leaves a void or nearly so.

    Only what lies deeper than `least` (mm) is looked for. A cell of the plane is parted as long as the leaf's surface
    may fall short of it there: by its radius at the middle, taken to lose 2 mm on the plane's distance a mm.
    radii: the leaf's, (n,) mm in (n, 3) unit directions.
    """
    spacing = solid.size / POINTS_ACROSS
    finest = spacing / 2**HALVINGS
    found = [np.zeros((0, 3))]
    for grid, frame, others in _planes(solid, region, spacing):
        points, side = grid, spacing
        while len(points):
            around = HALF_DIAGONAL * side
            points = points[others._replace(offsets=others.offsets - around).holds(points)]
            reach, along = polar(points, centre)
            points = points[radii(along) - reach < STEEPEST * around]
            depth = solid.triangles.closest(points)[0] * np.where(solid.triangles.contains(points), 1.0, -1.0)
            points = points[depth > least - around]
            if side <= finest:
                break
            side *= 0.5
            corners = 0.5 * side * np.array([[-1.0, -1.0], [-1.0, 1.0], [1.0, -1.0], [1.0, 1.0]])
            points = (points[:, None] + corners @ frame[:2]).reshape(-1, 3)
        points = points[others.holds(points)]
        found.append(points[solid.triangles.contains(points)])
    return _seen(solid, centre, np.concatenate(found), finest)


def _planes(solid: Solid, region: Region, spacing: float) -> Iterator[tuple[FloatArray, FloatArray, Region]]:
    """Yield of each plane of a region a grid (n, 3) as wide as the solid, its frame (3, 3), and the other planes."""
    for k, (normal, offset) in enumerate(zip(region.normals, region.offsets, strict=True)):
        frame = plane_frame(normal)
        heights = solid.vertices @ frame[:2].T
        low, high = heights.min(axis=0), heights.max(axis=0)
        a, b = (np.arange(lo + 0.5 * spacing, hi, spacing) for lo, hi in zip(low, high, strict=True))
        grid = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
        others = Region(np.delete(region.normals, k, axis=0), np.delete(region.offsets, k))
        yield grid @ frame[:2] + offset * normal, frame, others


def _seen(solid: Solid, centre: FloatArray, points: FloatArray, spacing: float) -> Section:
    """Return a section of (n, 3) points of planes, each of which stands for a square."""
    reach, along = polar(points, centre)
    depth = solid.triangles.closest(points)[0]
    hit = solid.triangles.first_hit(np.broadcast_to(centre, along.shape), along)[0]
    return Section(along, reach, depth, np.where(np.isfinite(hit), hit, np.inf), np.full(len(points), spacing**2))
