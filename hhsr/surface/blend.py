"""The bodies of a band: one for each lobe, between the planes h = −d and h = +d (DESIGN §2)."""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hhsr.model import FloatArray, IntArray
from hhsr.surface.piece import Piece
from hhsr.surface.sources import Strip

JOIN = 0.01  # mm: an outline this near to the band's own end is the band's end
COARSEST, FINEST = 32, 1024


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
    shares = np.arange(1, rows) / rows
    rings += [(centre + _polar(_radius(strip, angles, share), angles), angles) for share in shares]
    rings.append(_end_ring(strip, 1.0, above, angles))
    heights = [-d, *((2.0 * shares - 1.0) * d), d]
    starts = np.cumsum([0, *(len(points) for points, _ in rings)])
    flat = np.concatenate([*(points for points, _ in rings), [centre, centre]])
    height = np.concatenate([np.repeat(heights, np.diff(starts)), [-d, d]])
    wall = np.concatenate([_between(a[1], b[1], *starts[i : i + 2]) for i, (a, b) in enumerate(pairwise(rings))])
    low, high = np.arange(starts[1]), np.arange(starts[-2], starts[-1])
    bottom = np.stack([np.full(len(low), len(flat) - 2), np.roll(low, -1), low], axis=1)
    top = np.stack([np.full(len(high), len(flat) - 1), high, np.roll(high, -1)], axis=1)
    return Piece(
        np.column_stack([flat, height]),
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
        between = max(4, 512 // count)  # none of the table's 256 corners goes unseen
        angles = -np.pi + 2.0 * np.pi * np.arange(between * count) / (between * count)
        worst = 0.0
        for share in (0.0, 0.25, 0.5, 0.75, 1.0):
            radius = _radius(strip, angles, share)
            points = _polar(radius, angles).reshape(count, between, 2)
            start, end = points[:, 0], np.roll(points[:, 0], -1, axis=0)
            along = (end - start) / np.maximum(np.linalg.norm(end - start, axis=1, keepdims=True), 1e-300)
            off = points[:, 1:] - start[:, None]
            worst = max(worst, float(np.abs(along[:, :1] * off[:, :, 1] - along[:, 1:] * off[:, :, 0]).max()))
        if worst <= tolerance_mm:
            return count
        count *= 2
    return FINEST


def _radius(strip: Strip, angles: FloatArray, share: float) -> FloatArray:
    return strip.radius(angles, np.full(angles.shape, share))


def _rows_needed(strip: Strip, angles: FloatArray, tolerance_mm: float) -> int:
    """Return how many rows keep the parabolas within the tolerance; at least 2, for the contour itself."""
    ends = [_radius(strip, angles, t) for t in (0.0, 0.5, 1.0)]
    sag = float(np.abs(ends[0] - 2.0 * ends[1] + ends[2]).max()) / 2.0
    return min(max(2, int(np.ceil(np.sqrt(sag / tolerance_mm)))), 64)


def _end_ring(strip: Strip, share: float, edges: FloatArray, angles: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return a band's end, points (k, 2) and ascending angles (k,): the child's outline where it fits, else its own.

    The outline's coordinates are taken over to the bit, so that the Boolean finds the ends the same.
    """
    centre = strip.model.contours[strip.lobe].centre
    local = edges - centre
    radius, angle = np.linalg.norm(local, axis=2), np.arctan2(local[:, :, 1], local[:, :, 0])
    wanted = _radius(strip, angle.ravel(), share).reshape(angle.shape)
    turn = np.mod(angle[:, 1] - angle[:, 0] + np.pi, 2.0 * np.pi) - np.pi
    fits = (
        (np.abs(radius - wanted) <= JOIN).all(axis=1) & (wanted > 2.0 * JOIN).all(axis=1) & (turn > 1e-9) & (turn < 0.5)
    )
    first, span = angle[fits, 0], turn[fits]
    position = np.argsort(first)
    first, span = first[position], span[position]
    free = np.ones(len(angles), dtype=bool)
    for begin, length in zip(first, span, strict=True):
        free &= np.mod(angles - begin + 1e-9, 2.0 * np.pi) > length + 2e-9
    points = np.concatenate([edges[fits].reshape(-1, 2), centre + _polar(_radius(strip, angles, share), angles)[free]])
    angle = np.concatenate([angle[fits].ravel(), angles[free]])
    order = np.argsort(angle, kind="stable")
    points, angle = points[order], angle[order]
    apart = np.diff(angle, append=angle[:1] + 2.0 * np.pi) > 1e-9
    return points[apart], angle[apart]


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
