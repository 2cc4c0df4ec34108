"""Put vertices that a Boolean made back onto the exact surfaces that meet in them; the triangles stay as they are."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hhsr.model import FloatArray, IntArray
from hhsr.surface.sources import Retained, Source

ROUNDS = 12
PRECISE = 1e-9
STEP = 1e-5
WEAKEST = 0.02  # directions in which the surfaces hardly differ (sine of the angle) are left alone


class Polish(NamedTuple):
    """vertices: (n, 3) mm, after. left: (n,) those that should have moved but stayed (no common point near by)."""

    vertices: FloatArray
    left: NDArray[np.bool_]


def polish(
    vertices: FloatArray,
    faces: IntArray,
    source: IntArray,
    chosen: NDArray[np.bool_],
    surfaces: list[Source],
    furthest_mm: float,
) -> Polish:
    """Move the chosen vertices (tree's frame) onto all surfaces of the faces around them, by `furthest_mm` at most."""
    out = vertices.copy()
    left = np.zeros(len(vertices), dtype=bool)
    corner_vertex, corner_source = faces.ravel(), np.repeat(source, 3)
    some = chosen[corner_vertex]
    pairs = np.unique(np.stack([corner_vertex[some], corner_source[some]], axis=1), axis=0)
    first = np.flatnonzero(np.r_[True, np.diff(pairs[:, 0]) != 0]) if len(pairs) else np.zeros(0, dtype=np.int64)
    groups: dict[tuple[int, ...], list[int]] = {}
    for begin, end in zip(first, np.r_[first[1:], len(pairs)], strict=True):
        groups.setdefault(tuple(int(s) for s in pairs[begin:end, 1]), []).append(int(pairs[begin, 0]))
    for members, index in groups.items():
        meeting = [surfaces[m] for m in members if not isinstance(surfaces[m], Retained)]
        if len(meeting) == 0:
            continue
        here = vertices[index]
        moved, miss = _newton(here, meeting)
        good = (miss < 1e-7) & (np.linalg.norm(moved - here, axis=1) <= furthest_mm)
        out[np.array(index)[good]] = moved[good]
        left[np.array(index)[~good]] = True
    return Polish(out, left)


def _newton(points: FloatArray, meeting: list[Source]) -> tuple[FloatArray, FloatArray]:
    """Return (points, largest miss in mm) after least-norm Newton steps onto all surfaces at once."""
    p = points.copy()
    miss = _misses(p, meeting)
    worst = np.abs(miss).max(axis=1)
    active = np.flatnonzero(worst > PRECISE)
    for _ in range(ROUNDS):
        if len(active) == 0:
            break
        here = p[active]
        slope = np.empty((len(active), miss.shape[1], 3))
        for axis in range(3):
            ahead = np.zeros(3)
            ahead[axis] = STEP
            slope[:, :, axis] = (_misses(here + ahead, meeting) - _misses(here - ahead, meeting)) / (2.0 * STEP)
        move = np.einsum("nij,nj->ni", np.linalg.pinv(slope, rcond=WEAKEST), miss[active])
        p[active] = here - move
        miss[active] = _misses(p[active], meeting)
        worst[active] = np.abs(miss[active]).max(axis=1)
        active = active[worst[active] > PRECISE]
    return p, worst


def _misses(points: FloatArray, meeting: list[Source]) -> FloatArray:
    return np.stack([s.miss(points) for s in meeting if not isinstance(s, Retained)], axis=1)
