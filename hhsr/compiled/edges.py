"""The straight edges of a surface: where a cut meets a plane that bounds its region, and the sides do not all agree.

A step face is bounded by patches, by strips and by these. With them the surface nearest to a point outside every step
face is on a patch or on a short list of segments.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np

from hhsr.compiled.records import Plane
from hhsr.model import Cut, FloatArray
from hhsr.segments import cross_segments

EDGE_OFFSET = 1e-6  # mm, how far off a straight edge its four sides are asked
EDGE_RESOLUTION = 1e-4  # mm


def straight_edges(
    blob: FloatArray, cuts: list[tuple[Cut, list[Plane]]], middle: FloatArray, reach: float
) -> list[FloatArray]:
    """Return the edges (6,), start and end in the tree's frame, of cuts and the planes that bound their regions.

    middle, reach: a point (3,) mm, and a length from it beyond which there is no solid.
    """
    edges: list[FloatArray] = []
    for cut, planes in cuts:
        n = np.array(cut.normal)
        for side in (-1.0, 1.0) if cut.half_width > 0 else (0.0,):
            for k, (m, c) in enumerate(planes):
                line = _meet(n, cut.offset + side * cut.half_width, m, c, middle)
                if line is None:
                    continue
                span = _clip(line, [p for i, p in enumerate(planes) if i != k], reach)
                if span is not None:
                    edges.extend(_edge_pieces(blob, *span, n, m))
    return edges


def _meet(n: FloatArray, c: float, m: FloatArray, e: float, near: FloatArray) -> tuple[FloatArray, FloatArray] | None:
    """Return (point, unit direction) of the line where n·p = c and m·p = e meet, the point next to `near`."""
    along = np.cross(n, m)
    length = float(np.linalg.norm(along))
    if length < 1e-9:
        return None
    along = along / length
    rows = np.array([n, m, along])
    return np.linalg.solve(rows, np.array([c, e, float(along @ near)])), along


def _clip(
    line: tuple[FloatArray, FloatArray], planes: list[Plane], reach: float
) -> tuple[FloatArray, FloatArray] | None:
    point, along = line
    t0, t1 = -reach, reach
    for m, c in planes:
        rate, gap = float(m @ along), c - float(m @ point)
        if abs(rate) < 1e-12:
            if gap < -1e-9:
                return None
        elif rate > 0:
            t1 = min(t1, gap / rate)
        else:
            t0 = max(t0, gap / rate)
    return (point + t0 * along, point + t1 * along) if t0 < t1 else None


def _edge_pieces(
    blob_view: FloatArray, start: FloatArray, end: FloatArray, n: FloatArray, m: FloatArray
) -> list[FloatArray]:
    """Return the pieces (6,) of start → end about which the four quadrants between two planes do not all agree."""
    shifts = EDGE_OFFSET * np.array([n + m, n - m, m - n, -n - m])
    counts, places, begins = np.empty(4, np.int64), np.empty(4, np.int64), np.empty(4, np.bool_)
    t = cross_segments(
        blob_view, start + shifts, end + shifts, np.arange(4), False, EDGE_RESOLUTION, EDGE_RESOLUTION, counts, begins,
        places,
    )  # fmt: skip
    stops = np.concatenate([[0.0], np.sort(t), [1.0]])
    pieces = []
    for a, b in pairwise(stops):
        if b <= a:
            continue
        x = 0.5 * (a + b)
        states = {
            bool(begins[k]) ^ bool((t[places[k] : places[k] + counts[k]] < x).sum() % 2)
            for k in range(4)
            if counts[k] >= 0
        }
        if len(states) > 1:
            pieces.append(np.concatenate([start + a * (end - start), start + b * (end - start)]))
    return pieces
