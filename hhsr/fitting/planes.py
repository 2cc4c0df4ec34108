"""Planes moved once all of them are there: a first cut knew nothing of those after it (DESIGN §3)."""

from __future__ import annotations

import numpy as np

from hhsr.fitting.lookahead import LEAST_SHARE, Layout, Piece, around, best_centre, hidden_costs, normal_of
from hhsr.fitting.quantise import rounded_plane
from hhsr.fitting.solid import Region, Solid, everywhere
from hhsr.kernels.plane_moves import leaves_of, misfits_of_places
from hhsr.model import FloatArray, IntArray

SAMPLES = 3000
ROUNDS = 2
ANGLES = (0.2, 0.1, 0.05, 0.025)
SHIFTS = np.linspace(-0.5, 0.5, 5)
LEAST_FALL = 0.02


def settled(solid: Solid, layout: Layout, power: float = 1.0) -> Layout:
    """Return the layout after its planes were turned and shifted one by one, as long as the misfit of all pieces falls.

    Each piece is seen from its centre; then the centres are chosen anew, and once more.
    """
    for _ in range(ROUNDS if layout.planes else 0):
        before = _misfit(layout)
        moved = _with_pieces(solid, layout, _moved_planes(solid, layout, power), power)
        if moved is None or _misfit(moved) > (1.0 - LEAST_FALL) * before:
            break
        layout = moved
    return layout


def _misfit(layout: Layout) -> float:
    """Return the summed misfit of the pieces, mm · samples."""
    return sum(piece.misfit for piece in layout.pieces)


def _moved_planes(solid: Solid, layout: Layout, power: float) -> list[tuple[FloatArray, float]]:
    """Return the planes after each was turned and shifted, ever finer, as long as that lowers the misfit."""
    few = np.arange(0, solid.samples.points.shape[0], -(-solid.samples.points.shape[0] // SAMPLES))
    points, slopes = solid.samples.points[few], solid.samples.normals[few]
    centres = np.array([piece.centre for piece in layout.pieces])
    gaps = hidden_costs(solid, centres, few, power)
    least = LEAST_SHARE * few.size
    planes = list(layout.planes)
    normals = np.array([normal_of(angles) for angles, _ in planes])
    offsets = np.array([offset for _, offset in planes])

    def costs(moved: int, tried: FloatArray, heights: FloatArray) -> FloatArray:
        found: FloatArray = misfits_of_places(
            points, slopes, gaps, centres, normals, offsets, layout.children, moved, tried, heights, least, power
        )
        return found

    for angle in ANGLES:
        for k in range(len(planes)):
            tried, heights, stored = _places(solid, points, normals[k], offsets[k], angle)
            cost = costs(k, tried, heights)
            best = int(cost.argmin())
            if cost[best] < cost[0]:
                planes[k] = stored[best]
                normals[k], offsets[k] = tried[best], heights[best]
    return planes


def _places(
    solid: Solid, points: FloatArray, normal: FloatArray, offset: float, angle: float
) -> tuple[FloatArray, FloatArray, list[tuple[FloatArray, float]]]:
    """Return places of a plane, as stored, its own first: tilted about where the points near it lie, and shifted."""
    near = np.abs(points @ normal - offset) < 0.05 * solid.size
    pivot = points[near].mean(axis=0) if near.any() else offset * normal
    pivot = pivot + (offset - pivot @ normal) * normal
    stored = [rounded_plane(normal, offset, solid.size)]
    shifts = 0.5 * angle * solid.size * SHIFTS
    for direction in around(normal, angle):
        stored += [rounded_plane(direction, float(direction @ pivot + shift), solid.size) for shift in shifts]
    tried = np.array([normal_of(angles) for angles, _ in stored])
    return tried, np.array([height for _, height in stored]), stored


def _with_pieces(solid: Solid, layout: Layout, planes: list[tuple[FloatArray, float]], power: float) -> Layout | None:
    """Return the layout with planes moved, its pieces and their centres found anew; None where one lost its samples."""
    normals = np.array([normal_of(angles) for angles, _ in planes])
    offsets = np.array([offset for _, offset in planes])
    owner = leaves_of(solid.samples.points, normals, offsets, layout.children)
    regions: list[Region] = [everywhere()] * len(layout.pieces)
    _fill(regions, layout.children, normals, offsets, 0, everywhere())
    pieces = []
    for k, old in enumerate(layout.pieces):
        members: IntArray = np.flatnonzero(owner == k)
        if members.size < 8 or not regions[k].holds(solid.inner).any():
            return None
        found = best_centre(solid, members, regions[k], power, old.centre)
        pieces.append(Piece(regions[k], members, *found, old.depth))
    return Layout(tuple(planes), layout.children, tuple(pieces))


def _fill(
    regions: list[Region], children: IntArray, normals: FloatArray, offsets: FloatArray, at: int, region: Region
) -> None:
    """Write the region of every piece below plane number `at`."""
    for child, half in zip(children[at], region.halves(normals[at], float(offsets[at])), strict=True):
        if child < 0:
            regions[-1 - child] = half
        else:
            _fill(regions, children, normals, offsets, int(child), half)
