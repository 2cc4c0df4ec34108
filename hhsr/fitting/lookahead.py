"""Where to cut: each plane is judged by how well both sides could be told as radii from a centre (DESIGN §3)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hhsr.fitting.solid import Region, Solid, everywhere
from hhsr.kernels.lookahead import best_centres, misfits
from hhsr.model import FloatArray, IntArray, fibonacci_sphere

DIRECTIONS = 48
OFFSETS = 13
CENTRES = 12
COARSE = 2500
LEAST_SHARE = 0.004


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of the source: its region, (m,) samples, centre and misfit (mm · samples)."""

    region: Region
    members: IntArray
    centre: FloatArray
    misfit: float


@dataclass(frozen=True, eq=False)
class Split:
    """A cut of a piece and what it makes of it."""

    normal: FloatArray
    offset: float
    left: Piece
    right: Piece

    @property
    def misfit(self) -> float:
        return self.left.misfit + self.right.misfit


@dataclass(frozen=True, eq=False)
class Step:
    """One step of the parting: piece number `piece` is replaced by the split's left, and its right is appended."""

    piece: int
    split: Split


def whole(solid: Solid, power: float) -> Piece:
    """Return the source uncut, with its best centre."""
    members = np.arange(solid.samples.points.shape[0])
    centre, misfit = best_centre(solid, members, everywhere(), power)
    return Piece(everywhere(), members, centre, misfit)


def parting(solid: Solid, pieces: int, power: float = 1.0) -> tuple[Piece, list[Step]]:
    """Return the uncut piece and up to pieces − 1 steps, each the split that lowers the misfit the most."""
    first = whole(solid, power)
    current = [first]
    offers: list[Split | None] = [best_split(solid, first, power)]
    steps: list[Step] = []
    while len(current) < pieces:
        gains = [p.misfit - s.misfit if s is not None else -np.inf for p, s in zip(current, offers, strict=True)]
        at = int(np.argmax(gains))
        split = offers[at]
        if split is None or gains[at] <= 0.0:
            break
        steps.append(Step(at, split))
        current[at] = split.left
        current.append(split.right)
        offers[at] = best_split(solid, split.left, power)
        offers.append(best_split(solid, split.right, power))
    return first, steps


def best_centre(solid: Solid, members: IntArray, region: Region, power: float) -> tuple[FloatArray, float]:
    """Return the point inside the solid and the region from which the members look most like a radius, and the misfit."""
    inner = np.flatnonzero(region.holds(solid.inner))
    points, normals = solid.samples.points, solid.samples.normals
    if inner.size == 0:
        inner = np.array([int(((solid.inner - points[members].mean(axis=0)) ** 2).sum(axis=1).argmin())])
    tried = inner[_spread(solid.inner[inner], solid.depth[inner], 4 * CENTRES)]
    few = members[:: max(members.size // COARSE, 1)]
    best = tried[int(misfits(points, normals, few, solid.inner[tried], power).argmin())]
    near = inner[np.argsort(((solid.inner[inner] - solid.inner[best]) ** 2).sum(axis=1), kind="stable")[: 2 * CENTRES]]
    values = misfits(points, normals, members, solid.inner[near], power)
    return solid.inner[near[int(values.argmin())]], float(values.min())


def best_split(solid: Solid, piece: Piece, power: float) -> Split | None:
    """Return the best cut of a piece, or None where neither side could have a centre."""
    least = max(int(LEAST_SHARE * solid.samples.points.shape[0]), 8)
    if piece.members.size < 2 * least:
        return None
    inner = np.flatnonzero(piece.region.holds(solid.inner))
    if inner.size < 2:
        return None
    chosen = solid.inner[inner[_spread(solid.inner[inner], solid.depth[inner], CENTRES)]]
    few = piece.members[:: max(piece.members.size // COARSE, 1)]
    directions = fibonacci_sphere(2 * DIRECTIONS)[:DIRECTIONS]
    normal, offset, value = _best_plane(
        solid, few, chosen, directions, None, least * few.size / piece.members.size, power
    )
    spread = float(np.ptp(solid.samples.points[few], axis=0).max())
    angle = 0.25
    for _ in range(3):
        around = _around(normal, angle)
        normal_, offset_, value_ = _best_plane(
            solid,
            few,
            chosen,
            around,
            offset + 0.5 * angle * spread * np.linspace(-0.5, 0.5, 7),
            least * few.size / piece.members.size,
            power,
            pivot=solid.samples.points[few].mean(axis=0),
            old=normal,
        )
        if value_ < value:
            normal, offset, value = normal_, offset_, value_
        angle *= 0.5
    if not np.isfinite(value):
        return None
    return split_by(solid, piece, normal, offset, power)


def split_by(solid: Solid, piece: Piece, normal: FloatArray, offset: float, power: float) -> Split | None:
    """Return a piece cut by a plane, with the best centre of either side; None where a side is empty."""
    heights = np.einsum("ni,i->n", solid.samples.points[piece.members], normal)
    below, above = piece.region.halves(normal, offset)
    sides = []
    for region, members in ((below, piece.members[heights < offset]), (above, piece.members[heights >= offset])):
        if members.size < 8:
            return None
        sides.append(Piece(region, members, *best_centre(solid, members, region, power)))
    return Split(normal, offset, sides[0], sides[1])


def _best_plane(
    solid: Solid,
    members: IntArray,
    centres: FloatArray,
    directions: FloatArray,
    offsets: FloatArray | None,
    least: float,
    power: float,
    pivot: FloatArray | None = None,
    old: FloatArray | None = None,
) -> tuple[FloatArray, float, float]:
    """Return the plane with the least misfit of both sides: normal, offset, misfit.

    offsets: along the old normal; a turned plane keeps its height over the pivot. None: even shares of the members.
    """
    points, normals = solid.samples.points, solid.samples.normals
    heights = np.einsum("di,ni->dn", directions, points[members])
    if offsets is None:
        planes = np.quantile(heights, np.linspace(0.0, 1.0, OFFSETS + 2)[1:-1], axis=1).T.copy()
    else:
        assert pivot is not None and old is not None
        shift = np.einsum("di,i->d", directions - old, pivot)
        planes = shift[:, None] + offsets[None, :]
    inner_heights = np.einsum("di,ci->dc", directions, centres)
    value, _ = best_centres(points, normals, members, heights, planes, centres, inner_heights, power)
    count = (heights[:, None, :] < planes[:, :, None]).sum(axis=2)
    total = value.sum(axis=2)
    total[(count < least) | (members.size - count < least)] = np.inf
    d, k = np.unravel_index(int(total.argmin()), total.shape)
    return directions[d], float(planes[d, k]), float(total[d, k])


def _around(normal: FloatArray, angle: float) -> FloatArray:
    """Return (9, 3): a direction and eight tilted by an angle (rad)."""
    side = np.cross(normal, np.eye(3)[int(np.abs(normal).argmin())])
    side /= np.sqrt((side**2).sum())
    turn = np.arange(8) * (np.pi / 4.0)
    tilt = np.cos(turn)[:, None] * side + np.sin(turn)[:, None] * np.cross(normal, side)
    return np.vstack([normal, np.cos(angle) * normal + np.sin(angle) * tilt])


def _spread(points: FloatArray, depth: FloatArray, count: int) -> IntArray:
    """Return `count` indices of points far from each other, deep ones first: the deepest, then always the farthest."""
    count = min(count, points.shape[0])
    chosen = np.empty(count, dtype=np.int64)
    chosen[0] = int(depth.argmax())
    distance = np.sqrt(((points - points[chosen[0]]) ** 2).sum(axis=1))
    for k in range(1, count):
        chosen[k] = int((np.minimum(distance, 4.0 * depth + 1e-12)).argmax())
        distance = np.minimum(distance, np.sqrt(((points - points[chosen[k]]) ** 2).sum(axis=1)))
    return chosen
