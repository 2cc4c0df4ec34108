"""Where to cut: each plane is judged by how well both sides could be told as radii from a centre (DESIGN §3)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal, NamedTuple

import numpy as np

from hhsr.fitting.quantise import rounded_plane
from hhsr.fitting.solid import Region, Solid, everywhere
from hhsr.kernels.lookahead import best_centres, misfits
from hhsr.model import MAX_DEPTH, Cut, FloatArray, IntArray, Node, RetainedPart, fibonacci_sphere, frozen

DIRECTIONS = 40
OFFSETS = 11
CENTRES = 12
CENTRES_AROUND = 6
COARSE = 2000
LEAST_SHARE = 0.004
NEAR_SHARE = 50
WORST_POWER = 2.0
# Planes that part the samples alike differ by the order of sums: the first of them is taken, not one by chance.
ROUNDING = 1e-9
# A sample that its leaf does not see costs more than its distance behind what is seen: it leaves a sliver beyond a
# fissure that no leaf tells (liver A of 8 pieces: 0.326 → 0.274 mm).
HIDDEN_COST = 3.0
_NOTHING = RetainedPart(frozen(np.zeros((0, 3))), frozen(np.zeros((0, 3)), np.int64))


@dataclass(frozen=True, eq=False)
class Piece:
    """A part of the solid: its region, (m,) samples, centre, misfit (mm · samples), how many samples the
    centre does not see, and how many cuts lead to it.
    """

    region: Region
    members: IntArray
    centre: FloatArray
    misfit: float
    hidden: float
    depth: int


@dataclass(frozen=True, eq=False)
class Split:
    """A cut of a piece, its plane as stored, and what it makes of it."""

    angles: FloatArray
    offset: float
    left: Piece
    right: Piece

    @property
    def misfit(self) -> float:
        return self.left.misfit + self.right.misfit


@dataclass(frozen=True, eq=False)
class Step:
    """One step of a parting: piece number `piece` is replaced by the split's left, and its right is appended."""

    piece: int
    split: Split


@dataclass(frozen=True, eq=False)
class Layout:
    """Planes that part a solid, and its pieces.

    planes: (angles (2,), offset) of each, as stored. children: (k, 2) planes, or −1 − piece, below and above each.
    """

    planes: tuple[tuple[FloatArray, float], ...]
    children: IntArray
    pieces: tuple[Piece, ...]

    def split(self, piece: int, split: Split) -> Layout:
        """Return the layout with one piece cut: its left stays number `piece`, its right comes last."""
        children = np.where(self.children == -1 - piece, len(self.planes), self.children)
        pieces = (*self.pieces[:piece], split.left, *self.pieces[piece + 1 :], split.right)
        return Layout(
            (*self.planes, (split.angles, split.offset)),
            np.vstack([children, [-1 - piece, -1 - len(self.pieces)]]).astype(np.int64),
            pieces,
        )

    def merged(self, solid: Solid, plane: int) -> Layout:
        """Return the layout without a plane that has a piece on either side."""
        first, second = sorted(-1 - int(child) for child in self.children[plane])
        one, other = self.pieces[first], self.pieces[second]
        members = np.sort(np.concatenate([one.members, other.members]))
        region = Region(one.region.normals[:-1], one.region.offsets[:-1])  # the last is this plane's own
        both = Piece(region, members, *best_centre(solid, members, region, 1.0), one.depth - 1)
        children = np.where(self.children == plane, -1 - first, self.children)
        children = np.where(children > plane, children - 1, np.where(children < -1 - second, children + 1, children))
        pieces = [both if k == first else piece for k, piece in enumerate(self.pieces) if k != second]
        planes = self.planes[:plane] + self.planes[plane + 1 :]
        return Layout(planes, np.delete(children, plane, axis=0), tuple(pieces))

    def tree(self, leaves: Sequence[Node]) -> Node:
        """Return the tree with these leaves, one a piece."""

        def node(at: int) -> Node:
            if at < 0:
                return leaves[-1 - at]
            angles, offset = self.planes[at]
            return Cut(angles, offset, 0.0, (), *(node(int(child)) for child in self.children[at]))

        return node(0 if self.planes else -1)


class Parting:
    """A solid cut into ever more pieces, each cut the one that lowers the misfit the most; made as it is asked for."""

    def __init__(self, solid: Solid, power: float = 1.0) -> None:
        self._solid = solid
        self._power = power
        members = np.arange(solid.samples.points.shape[0])
        self._pieces = [[Piece(everywhere(), members, *best_centre(solid, members, everywhere(), power), 0)]]
        self._steps: list[Step] = []
        self._offers: list[Split | Literal["unknown"] | None] = ["unknown"]

    def grown(self, count: int) -> bool:
        """Cut until there are `count` pieces; return whether there are."""
        while len(self._pieces) < count:
            if not self._cut():
                return False
        return True

    def pieces(self, count: int) -> list[Piece]:
        """Return the pieces when there were `count`."""
        return self._pieces[count - 1]

    def misfit(self, count: int) -> float:
        """Return the summed misfit of `count` pieces, mm · samples."""
        return sum(piece.misfit for piece in self._pieces[count - 1])

    def hidden(self, count: int) -> float:
        """Return the share of the samples that the centres of `count` pieces do not see."""
        unseen = sum(piece.hidden for piece in self._pieces[count - 1])
        return unseen / len(self._solid.samples.points)

    def layout(self, count: int) -> Layout:
        """Return the layout of `count` pieces."""
        layout = Layout((), np.zeros((0, 2), np.int64), tuple(self._pieces[0]))
        for step in self._steps[: count - 1]:
            layout = layout.split(step.piece, step.split)
        return layout

    def _take(self, at: int, split: Split) -> None:
        """Note a cut."""
        current = self._pieces[-1]
        self._steps.append(Step(at, split))
        self._pieces.append([*current[:at], split.left, *current[at + 1 :], split.right])

    def _cut(self) -> bool:
        """Make the next cut; return whether there was one."""
        current = self._pieces[-1]
        for k, piece in enumerate(current):
            if self._offers[k] == "unknown":
                self._offers[k] = best_split(self._solid, piece, self._power)
        falls = [_fall(piece, offer) for piece, offer in zip(current, self._offers, strict=True)]
        at = int(np.argmax(falls))
        split = self._offers[at]
        if not isinstance(split, Split) or falls[at] <= 0.0:
            return False
        self._take(at, split)
        self._offers[at] = "unknown"
        self._offers.append("unknown")
        return True


def _fall(piece: Piece, offer: Split | Literal["unknown"] | None) -> float:
    """Return by how much a split lowers a piece's misfit; −inf where there is none."""
    return float(piece.misfit - offer.misfit) if isinstance(offer, Split) else -np.inf


def best_centre(
    solid: Solid, members: IntArray, region: Region, power: float, start: FloatArray | None = None
) -> tuple[FloatArray, float, float]:
    """Return the point inside the solid and the region from which the members look most like a radius.

    start: look around this point only. With the point come the misfit, and how many members it does not see: sums over
    all members, in mm (for power 1) and samples, from the few that are looked at.
    """
    inner = np.flatnonzero(region.holds(solid.inner))
    few = members[:: -(-members.size // COARSE)].copy()
    if inner.size == 0:
        middle = solid.samples.points[members].mean(axis=0)
        inner = np.array([int(((solid.inner - middle) ** 2).sum(axis=1).argmin())])
    count = CENTRES
    if start is not None:
        count = CENTRES_AROUND
    else:
        tried = inner[_spread(solid.inner[inner], solid.depth[inner], CENTRES)]
        start = solid.inner[tried[int(_seen_from(solid, tried, few, power)[0].argmin())]]
    near = inner[np.argsort(((solid.inner[inner] - start) ** 2).sum(axis=1), kind="stable")]
    tried = near[: inner.size // CENTRES + 1 : max(inner.size // (CENTRES * count), 1)][:count]
    values, unseen = _seen_from(solid, tried, few, power)
    at = int(values.argmin())
    share = members.size / few.size
    return solid.inner[tried[at]], float(values[at]) * share, float(unseen[at]) * share


def _seen_from(solid: Solid, inner: IntArray, few: IntArray, power: float) -> tuple[FloatArray, FloatArray]:
    """Return (c,) the misfit of a few members from some inner points, and (c,) how many of them are not seen."""
    centres = solid.inner[inner]
    costs = hidden_costs(solid, centres, few, power)
    samples = solid.samples
    values: FloatArray = misfits(samples.points, samples.normals, few, costs, centres, power)
    return values, (costs > 0.0).sum(axis=1).astype(float)


def hidden(solid: Solid, centres: FloatArray, members: IntArray) -> FloatArray:
    """Return (c, m) how far (mm) each member lies behind the first surface that a centre sees; 0 where it is seen."""
    offset = solid.samples.points[members][None, :, :] - centres[:, None, :]
    flat = offset.reshape(-1, 3)
    share = solid.triangles.first_hit(np.repeat(centres, members.size, axis=0), flat, 1.0)[0]
    gap = np.sqrt((flat**2).sum(axis=1)) * (1.0 - np.where(np.isfinite(share), share, 1.0))
    return np.where(gap > 1e-5 * solid.size, gap, 0.0).reshape(offset.shape[:2])


def hidden_costs(solid: Solid, centres: FloatArray, members: IntArray, power: float) -> FloatArray:
    """Return (c, m) what each member costs in the misfit where a centre does not see it, else 0."""
    costs: FloatArray = (HIDDEN_COST * hidden(solid, centres, members)) ** power
    return costs


def best_split(solid: Solid, piece: Piece, power: float, spot: FloatArray | None = None) -> Split | None:
    """Return the best cut of a piece, or None where neither side could have a centre.

    spot: (3,) around which members count more, as much as half of all: a cut for what is missed there.
    """
    least = max(int(LEAST_SHARE * solid.samples.points.shape[0]), 8)
    if piece.members.size < 2 * least or piece.depth >= MAX_DEPTH:
        return None
    inner = np.flatnonzero(piece.region.holds(solid.inner))
    if inner.size < 2:
        return None
    chosen = solid.inner[inner[_spread(solid.inner[inner], solid.depth[inner], CENTRES)]]
    few = piece.members[:: -(-piece.members.size // COARSE)].copy()
    if spot is not None:
        apart = ((solid.samples.points[piece.members] - spot) ** 2).sum(axis=1)
        near = piece.members[np.argsort(apart, kind="stable")[: max(piece.members.size // NEAR_SHARE, 8)]]
        few = np.concatenate([few, np.repeat(near, max(few.size // (2 * near.size), 1))])
    gaps = hidden_costs(solid, chosen, few, power)
    view = _View(solid, few, gaps, chosen, least * few.size / piece.members.size, power)
    best = view.best_plane(fibonacci_sphere(2 * DIRECTIONS)[:DIRECTIONS], None, None)
    spread = float(np.ptp(solid.samples.points[few], axis=0).max())
    angle = 0.25
    for _ in range(3):
        shifts = best.offset + 0.5 * angle * spread * np.linspace(-0.5, 0.5, 5)
        turned = view.best_plane(around(best.normal, angle), shifts, best.normal)
        if turned.misfit < (1.0 - ROUNDING) * best.misfit:
            best = turned
        angle *= 0.5
    if not np.isfinite(best.misfit):
        return None
    return split_by(solid, piece, best, power)


class _Found(NamedTuple):
    """A plane, and the misfit of both of its sides."""

    normal: FloatArray
    offset: float
    misfit: float


class _View(NamedTuple):
    """What a cut is judged by: (m,) members, (c, m) what is hidden of them from (c, 3) centres."""

    solid: Solid
    members: IntArray
    gaps: FloatArray
    centres: FloatArray
    least: float
    power: float

    def best_plane(self, directions: FloatArray, offsets: FloatArray | None, old: FloatArray | None) -> _Found:
        """Return the plane with the least misfit of both sides.

        offsets: along the old normal; a turned plane keeps its height over the members' mean. None: even shares.
        """
        own = self.solid.samples.points[self.members]
        heights = np.einsum("di,ni->dn", directions, own)
        if offsets is None or old is None:
            planes = np.quantile(heights, np.linspace(0.0, 1.0, OFFSETS + 2)[1:-1], axis=1).T.copy()
        else:
            planes = np.einsum("di,i->d", directions - old, own.mean(axis=0))[:, None] + offsets[None, :]
        return self.best_of(directions, heights, planes)

    def best_of(self, directions: FloatArray, heights: FloatArray, planes: FloatArray) -> _Found:
        """Return the best of the planes at offsets (d, k) along (d, 3) directions; heights: (d, m) of the members."""
        points, normals = self.solid.samples.points, self.solid.samples.normals
        across = np.einsum("di,ci->dc", directions, self.centres)
        value, _ = best_centres(
            points, normals, self.members, self.gaps, heights, planes, self.centres, across, self.power
        )
        count = (heights[:, None, :] < planes[:, :, None]).sum(axis=2)
        total = value.sum(axis=2)
        total[(count < self.least) | (self.members.size - count < self.least)] = np.inf
        first = np.flatnonzero(total.ravel() <= (1.0 + ROUNDING) * total.min())[0]
        d, k = np.unravel_index(int(first), total.shape)
        return _Found(directions[d], float(planes[d, k]), float(total[d, k]))


def split_by(solid: Solid, piece: Piece, found: _Found, power: float) -> Split | None:
    """Return a piece cut by a plane, with the best centre of either side; None where a side is empty."""
    angles, offset = rounded_plane(found.normal, found.offset, solid.size)
    normal = normal_of(angles)
    heights = np.einsum("ni,i->n", solid.samples.points[piece.members], normal)
    below, above = piece.region.halves(normal, offset)
    sides = []
    halves = (below, piece.members[heights < offset]), (above, piece.members[heights >= offset])
    for region, members in halves:
        if members.size < 8:
            return None
        sides.append(Piece(region, members, *best_centre(solid, members, region, power), piece.depth + 1))
    return Split(angles, offset, sides[0], sides[1])


def normal_of(angles: FloatArray) -> FloatArray:
    """Return the (3,) unit normal of a plane's azimuth and elevation, as `hhsr.model.Cut` has it."""
    return np.asarray(Cut(angles, 0.0, 0.0, (), _NOTHING, _NOTHING).normal)


def around(normal: FloatArray, angle: float) -> FloatArray:
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
