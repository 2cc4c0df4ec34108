"""What one leaf has to tell: its samples, its rays, and where it must reach the planes that cut it off (DESIGN §3)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from hhsr.fitting.base import base_radii
from hhsr.fitting.rows import GRAZING, BoolArray, Rows
from hhsr.fitting.samples import side_by_side, turned_fibonacci
from hhsr.fitting.solid import Region, Solid
from hhsr.model import FloatArray, IntArray, ModelLeaf

RAYS = 2500
BOUND_RAYS = 8000
SLACK_OF_DEPTH = 0.3
SLACK_OF_REACH = 0.1
MOST_URGENT = 5.0
FARTHEST_HINT = 1.5
HINT = 0.3
HOLD = 0.1


class Task(NamedTuple):
    """A leaf's task as seen from its centre.

    points, normals: (n, 3) its samples; seen: (n,) which of them the centre sees through the solid.
    along, radii, cosine: (s, 3), (s,) mm, (s,) of those that it sees: direction, distance, cosine with the normal.
    free: (r, 3) rays that meet the source within the region.
    behind: (b, 3) rays that leave the region inside the solid: there the leaf is cut off, and has to reach the plane.
    bound, slack: (b,) mm that ρ has to be at least: the plane and some slack; (b,) mm, that slack.
    urgency: (b,) by how much a miss counts more: falling short by a hair opens a void as deep as the solid is there.
    hint: (b,) mm, where the ray leaves the solid beyond the plane, at most half as far again.
    directions: (s + r + b, 3) along, free and behind together.
    stride: of how many samples and rays one was taken; their shares of each other stay.
    """

    region: Region
    points: FloatArray
    normals: FloatArray
    seen: BoolArray
    along: FloatArray
    radii: FloatArray
    cosine: FloatArray
    free: FloatArray
    behind: FloatArray
    bound: FloatArray
    slack: FloatArray
    urgency: FloatArray
    hint: FloatArray
    directions: FloatArray
    stride: int


def task_of(solid: Solid, region: Region, members: IntArray, centre: FloatArray, seed: int, stride: int = 1) -> Task:
    """Return the task of the leaf of a region with some samples, for a centre inside the solid and the region.

    stride: one of so many samples and rays is taken.
    """
    members = members[::stride]
    free = side_by_side(turned_fibonacci(RAYS, seed)[::stride])
    reach, _, hit = _cast(solid, region, centre, free)
    free = free[~(np.isfinite(reach) & (hit > reach))]
    behind = side_by_side(turned_fibonacci(BOUND_RAYS, seed + 1)[::stride])
    reach, cosine, hit = _cast(solid, region, centre, behind)
    through = np.isfinite(reach) & (hit > reach)
    behind, reach, cosine, hit = behind[through], reach[through], cosine[through], hit[through]
    depth = solid.triangles.closest(centre + reach[:, None] * behind)[0]
    slack = np.minimum(np.minimum(SLACK_OF_DEPTH * depth, SLACK_OF_REACH * reach), 0.5 * (hit - reach))
    urgency = np.minimum(depth / np.maximum(slack, 1e-9 * solid.size), MOST_URGENT)
    points, normals = solid.samples.points[members], solid.samples.normals[members]
    seen = _in_sight(solid, points, normals, centre)
    radii, along = polar(points[seen], centre)
    return Task(
        region,
        points,
        normals,
        seen,
        along,
        radii,
        np.einsum("ni,ni->n", along, normals[seen]),
        free,
        behind,
        reach + slack,
        slack,
        urgency * np.sqrt(np.maximum(cosine, GRAZING)),
        np.minimum(hit, FARTHEST_HINT * reach),
        np.concatenate([along, free, behind]),
        stride,
    )


def _cast(
    solid: Solid, region: Region, centre: FloatArray, directions: FloatArray
) -> tuple[FloatArray, FloatArray, FloatArray]:
    """Return (n,) mm to the region's end (inf), the cosine there, and mm to the source's first surface.

    Surface farther than 1.5 times the region's end is not looked for (inf), nor any where the region has no end (NaN).
    """
    reach, cosine = region.exits(centre, directions)
    ends = np.isfinite(reach)
    far = FARTHEST_HINT * np.maximum(reach[ends], 1e-9 * solid.size)
    t = solid.triangles.first_hit(np.broadcast_to(centre, (far.size, 3)), far[:, None] * directions[ends], 1.0)[0]
    hit = np.full(reach.size, np.nan)
    hit[ends] = np.where(np.isfinite(t), t * far, np.inf if solid.triangles.contains(centre) else np.nan)
    return reach, cosine, hit


def _in_sight(solid: Solid, points: FloatArray, normals: FloatArray, centre: FloatArray) -> BoolArray:
    """Return (n,) which points of the surface a centre sees from inside, nothing between."""
    offset = points - centre
    facing = np.flatnonzero(np.einsum("ni,ni->n", offset, normals) > 0.0)
    radii = np.sqrt((offset[facing] ** 2).sum(axis=1))
    near = 1.0 - 1e-6 - 1e-6 * solid.size / np.maximum(radii, 1e-6 * solid.size)
    ends = offset[facing] * np.maximum(near, 0.0)[:, None]
    seen = np.zeros(points.shape[0], dtype=bool)
    seen[facing] = np.isnan(solid.triangles.first_hit(np.broadcast_to(centre, ends.shape), ends, 1.0)[0])
    return seen


def polar(points: FloatArray, centre: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return (n,) distances from a centre, and (n, 3) unit directions."""
    offset = points - centre
    radii = np.sqrt((offset**2).sum(axis=1))
    return radii, offset / np.maximum(radii, 1e-300)[:, None]


def ray_share(solid: Solid, rays: int) -> float:
    """Return the solid angle of one of so many rays over a sample's area, 1/mm²: times ρ², it weighs like samples."""
    return 4.0 * np.pi / rays / solid.sample_area


def start_rows(task: Task, solid: Solid) -> Rows:
    """Return the rows before anything is fitted: the samples in sight, by max(|cos γ|, 0.2), and the bounds."""
    weights = np.maximum(task.cosine, GRAZING)
    samples = Rows(task.along, task.radii, weights, np.zeros(task.radii.size, dtype=bool))
    weights = np.sqrt(ray_share(solid, BOUND_RAYS)) * task.bound * task.urgency
    return samples.joined(Rows(task.behind, task.bound, weights, np.ones(task.bound.size, dtype=bool)))


def hint_rows(task: Task, solid: Solid) -> Rows:
    """Return where the rays that pass a plane leave the solid: a base that knows it passes without a kink."""
    weight = HINT * np.sqrt(ray_share(solid, BOUND_RAYS)) * task.hint
    return Rows(task.behind, task.hint, weight, np.zeros(task.hint.size, dtype=bool))


def first_rows(task: Task, solid: Solid, leaf: ModelLeaf) -> Rows:
    """Return the rows that the first centres are chosen for, one for each of the task's directions.

    The samples in sight; and where the leaf is cut off the bounds that its base breaks. Elsewhere behind cuts, weakly,
    the base: without that the centres chosen for the surface beside a cut swing freely behind it, and open voids there
    (a liver: 0.34 mm with, 0.45 mm and more without).
    """
    base = base_radii(leaf, task.behind)
    weight = np.sqrt(ray_share(solid, BOUND_RAYS)) * task.bound
    weight *= np.sqrt(HOLD**2 + np.where(base < task.bound, task.urgency, 0.0) ** 2)
    free = np.zeros(task.free.shape[0])
    return Rows(
        task.directions,
        np.concatenate([task.radii, free, np.maximum(base, task.bound)]),
        np.concatenate([np.maximum(task.cosine, GRAZING), free, weight]),
        np.zeros(task.directions.shape[0], dtype=bool),
    )
