"""Where a leaf is cut off: points of its planes that lie in the solid, and whether it covers them (DESIGN §2, §3).

What a leaf does not cover there is a void, with a step face as deep as the solid is: an error that neither the samples
of the source nor the leaf's own points tell much of.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hhsr.fitting.solid import Region, Solid
from hhsr.fitting.task import polar
from hhsr.model import FloatArray, plane_frame

POINTS_ACROSS = 64


class Section(NamedTuple):
    """Points on the planes of a leaf's region that lie inside the solid.

    along: (m, 3) unit directions from the leaf's centre. reach: (m,) mm, their distances. depth: (m,) mm from the
    source's surface. hit: (m,) mm to the first surface on the way; less than `reach` where a point is hidden.
    cell: mm² that each stands for.
    """

    along: FloatArray
    reach: FloatArray
    depth: FloatArray
    hit: FloatArray
    cell: float


def section_of(solid: Solid, region: Region, centre: FloatArray) -> Section:
    """Return the points of a region's planes inside the solid, evenly spread, as seen from a centre in the region."""
    spacing = solid.size / POINTS_ACROSS
    found = [np.zeros((0, 3))]
    for k, (normal, offset) in enumerate(zip(region.normals, region.offsets, strict=True)):
        frame = plane_frame(normal)
        heights = solid.vertices @ frame[:2].T
        low, high = heights.min(axis=0), heights.max(axis=0)
        a, b = (np.arange(lo + 0.5 * spacing, hi, spacing) for lo, hi in zip(low, high, strict=True))
        grid = np.stack(np.meshgrid(a, b, indexing="ij"), axis=-1).reshape(-1, 2)
        points = grid @ frame[:2] + offset * normal
        others = Region(np.delete(region.normals, k, axis=0), np.delete(region.offsets, k))
        points = points[others.holds(points)]
        found.append(points[solid.triangles.contains(points)])
    points = np.concatenate(found)
    reach, along = polar(points, centre)
    depth = solid.triangles.closest(points)[0]
    hit = solid.triangles.first_hit(np.broadcast_to(centre, along.shape), along)[0]
    return Section(along, reach, depth, np.where(np.isfinite(hit), hit, np.inf), spacing**2)
