"""The bodies of a band: one for each lobe, between the planes h = −d and h = +d (DESIGN §2)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hhsr.model import FloatArray, IntArray
from hhsr.surface.piece import Piece
from hhsr.surface.sources import Strip

JOIN = 0.01  # mm: an outline this near to the band's own end is the band's end
COARSEST, FINEST = 32, 4096


def slab_body(
    strip: Strip, below: FloatArray, above: FloatArray, source: int, steps: tuple[int, int], tolerance_mm: float
) -> Piece:
    """Return a lobe's body in the cut's frame, closed; its ends lie at z = ∓d exactly.

    below, above: (k, 2, 2) mm, edges of the children's outlines on the two planes; where they follow the band's end,
    the body takes them over, so that nothing is left between. steps: the sources of the end faces.
    """
    d, centre = strip.model.half_width, strip.model.contours[strip.lobe].centre
    count = _angles_needed(strip, tolerance_mm)
    angles = -np.pi + 2.0 * np.pi * np.arange(count) / count
    rows = _rows_needed(strip, angles, tolerance_mm)
    rings = [_end_ring(strip, 0.0, below, angles)]
    for share in np.arange(1, rows) / rows:
        radius = strip.radius(angles, np.full(count, share))
        rings.append(np.column_stack([_polar(radius, angles), np.full(count, (2.0 * share - 1.0) * d)]))
    rings.append(_end_ring(strip, 1.0, above, angles))
    rings[0][:, 2], rings[-1][:, 2] = -d, d
    for ring in rings:
        ring[:, :2] += centre
    starts = np.cumsum([0, *(len(r) for r in rings)])
    vertices = np.concatenate([*rings, [[*centre, -d], [*centre, d]]])
    sides = [
        _between(_angle(a - [*centre, 0.0]), _angle(b - [*centre, 0.0]), starts[i], starts[i + 1])
        for i, (a, b) in enumerate(pairwise(rings))
    ]
    low, high = starts[0] + np.arange(len(rings[0])), starts[-2] + np.arange(len(rings[-1]))
    bottom = np.stack([np.full(len(low), len(vertices) - 2), np.roll(low, -1), low], axis=1)
    top = np.stack([np.full(len(high), len(vertices) - 1), high, np.roll(high, -1)], axis=1)
    wall = np.concatenate(sides)
    return Piece(
        vertices,
        np.concatenate([wall, bottom, top]),
        np.repeat([source, *steps], [len(wall), len(bottom), len(top)]),
    )


def outline(piece: Piece, height: float, up: bool) -> FloatArray:
    """Return (k, 2, 2) mm the edges of a piece's outline on the plane z = height, counter-clockwise about the solid.

    up: the solid lies below the plane.
    """
    on = piece.vertices[:, 2] == height
    flat = on[piece.faces].all(axis=1)
    faces = piece.faces[flat]
    edges = faces[:, [0, 1, 1, 2, 2, 0]].reshape(-1, 2)
    keys = edges[:, 0] * len(piece.vertices) + edges[:, 1]
    twins = edges[:, 1] * len(piece.vertices) + edges[:, 0]
    rim = edges[~np.isin(keys, twins)]
    return np.asarray(piece.vertices[rim if up else rim[:, ::-1]][:, :, :2])


def _polar(radius: FloatArray, angles: FloatArray) -> FloatArray:
    return np.asarray(np.stack([radius * np.cos(angles), radius * np.sin(angles)], axis=1))


def _angle(points: FloatArray) -> FloatArray:
    return np.asarray(np.arctan2(points[:, 1], points[:, 0]))


def _angles_needed(strip: Strip, tolerance_mm: float) -> int:
    """Return the least power of two of chords that keep within the tolerance of the strip at five heights."""
    count = COARSEST
    while count < FINEST:
        angles = -np.pi + 2.0 * np.pi * np.arange(4 * count) / (4 * count)
        worst = 0.0
        for share in (0.0, 0.25, 0.5, 0.75, 1.0):
            points = _polar(strip.radius(angles, np.full(4 * count, share)), angles).reshape(count, 4, 2)
            start, end = points[:, 0], np.roll(points[:, 0], -1, axis=0)
            along = (end - start) / np.maximum(np.linalg.norm(end - start, axis=1, keepdims=True), 1e-300)
            for k in (1, 2, 3):
                off = points[:, k] - start
                worst = max(worst, float(np.abs(along[:, 0] * off[:, 1] - along[:, 1] * off[:, 0]).max()))
        if worst <= tolerance_mm:
            return count
        count *= 2
    return FINEST


def _rows_needed(strip: Strip, angles: FloatArray, tolerance_mm: float) -> int:
    """Return how many rows keep the parabolas within the tolerance; at least 2, for the contour itself."""
    ends = [strip.radius(angles, np.full(len(angles), t)) for t in (0.0, 0.5, 1.0)]
    sag = float(np.abs(ends[0] - 2.0 * ends[1] + ends[2]).max()) / 2.0
    return min(max(2, int(np.ceil(np.sqrt(sag / tolerance_mm)))), 64)


def _end_ring(strip: Strip, share: float, edges: FloatArray, angles: FloatArray) -> FloatArray:
    """Return (k, 3) a band's end about its centre: the child's outline where it fits, else the band's own radii."""
    centre = strip.model.contours[strip.lobe].centre
    local = edges - centre
    radius, angle = np.linalg.norm(local, axis=2), np.arctan2(local[:, :, 1], local[:, :, 0])
    wanted = strip.radius(angle.ravel(), np.full(angle.size, share)).reshape(angle.shape)
    turn = np.mod(angle[:, 1] - angle[:, 0] + np.pi, 2.0 * np.pi) - np.pi
    fits = (np.abs(radius - wanted) <= JOIN).all(axis=1) & (turn > 1e-9) & (turn < 0.5)
    first, span = angle[fits, 0], turn[fits]
    position = np.argsort(first)
    first, span = first[position], span[position]
    free = np.ones(len(angles), dtype=bool)
    for begin, length in zip(first, span, strict=True):
        free &= np.mod(angles - begin + 1e-9, 2.0 * np.pi) > length + 2e-9
    points = np.concatenate(
        [local[fits].reshape(-1, 2), _polar(strip.radius(angles, np.full(len(angles), share)), angles)[free]]
    )
    order = np.argsort(_angle(points), kind="stable")
    points = points[order]
    gaps = np.diff(_angle(points), append=_angle(points[:1]) + 2.0 * np.pi)
    points = points[gaps > 1e-9]
    return np.column_stack([points, np.zeros(len(points))])


def _between(low: FloatArray, high: FloatArray, low_start: int, high_start: int) -> IntArray:
    """Return triangles between two rings given by ascending angles; outward, the second ring above the first."""
    n, m = len(low), len(high)
    # Walk both rings once around; the next triangle advances the ring whose next vertex comes first.
    steps = np.concatenate([np.r_[low[1:], low[0] + 2.0 * np.pi], np.r_[high[1:], high[0] + 2.0 * np.pi]])
    is_high = np.repeat([False, True], [n, m])
    order = np.argsort(steps, kind="stable")
    is_high = is_high[order]
    i = np.cumsum(~is_high) - ~is_high
    j = np.cumsum(is_high) - is_high
    a, b = low_start + i % n, high_start + j % m
    following = np.where(is_high, high_start + (j + 1) % m, low_start + (i + 1) % n)
    return np.stack([a, following, b], axis=1)
