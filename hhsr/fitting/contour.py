"""The 2-D intersection shape of a cut: lobes of a plane section, each a radius over in-plane angles (DESIGN §2)."""

from __future__ import annotations

import math
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from hhsr.evaluate import CONTOUR_SUPPORT, contour_radius
from hhsr.kernels.leaf import MAX_SCALE
from hhsr.kernels.section import contour_map
from hhsr.model import Contour, FloatArray, frozen

WEIGHT_COUNTS = (0, 6, 8, 12, 16, 24, 32)
RIDGE = 1e-4
CENTRE_GRID = 17
LEAST_POINTS = 12
AXIS_STEPS = 20


class Lobe(NamedTuple):
    """points: (n, 2) mm, the section's loop in the plane's axes, in walking order. seen: (n,) bool, in the region."""

    points: FloatArray
    seen: np.ndarray


def section_lobes(
    vertices: FloatArray, faces: np.ndarray, frame: FloatArray, offset: float, spacing_mm: float
) -> list[FloatArray]:
    """Return the loops (n, 2) of the plane section n·p = offset in the plane's axes, points at most `spacing_mm` apart.

    vertices, faces: closed triangles. frame: (3, 3) rows e1, e2, n.
    """
    points, starts, _ = contour_map(
        np.ascontiguousarray(vertices),
        np.ascontiguousarray(faces),
        np.zeros(len(faces), dtype=np.bool_),
        np.ascontiguousarray(vertices @ frame[2]),
        offset,
        spacing_mm,
    )
    flat = points @ frame[:2].T
    return [flat[a:b] for a, b in pairwise(starts)]


def loop_area(points: FloatArray) -> float:
    """Return the area (mm² ≥ 0) that a loop encloses."""
    x, y = points.T
    return abs(float((x * np.roll(y, -1) - y * np.roll(x, -1)).sum())) / 2.0


def inside_loop(loop: FloatArray, points: FloatArray) -> np.ndarray:
    """Return (m,) whether a closed loop (n, 2) holds points (m, 2), by parity."""
    a, b = loop, np.roll(loop, -1, axis=0)
    y = points[:, 1, None]
    spans = (a[:, 1] > y) != (b[:, 1] > y)
    with np.errstate(divide="ignore", invalid="ignore"):
        at = a[:, 0] + (y - a[:, 1]) / (b[:, 1] - a[:, 1]) * (b[:, 0] - a[:, 0])
    return np.asarray((spans & (points[:, 0, None] < at)).sum(axis=1) % 2 == 1)


def star_centre(loops: list[FloatArray], within: FloatArray) -> tuple[FloatArray, float]:
    """Return the point (2,) that best sees all of several loops, and the share of their length that it does not see.

    Parameters
    ----------
    loops : (n, 2) each, in walking order: the sections that one lobe's centre must serve.
    within : (m, 2) a closed loop that must hold the centre.
    """
    low, high = within.min(axis=0), within.max(axis=0)
    axes = [np.linspace(low[i], high[i], CENTRE_GRID + 2)[1:-1] for i in range(2)]
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 2)
    grid = grid[inside_loop(within, grid)]
    if grid.shape[0] == 0:
        return within.mean(axis=0), 1.0
    hidden = np.zeros(grid.shape[0])
    nearest = np.full(grid.shape[0], np.inf)
    total = 0.0
    for loop in loops:
        step = np.roll(loop, -1, axis=0) - loop
        away = loop - grid[:, None]
        turn = away[..., 0] * step[:, 1] - away[..., 1] * step[:, 0]
        length = np.hypot(*step.T)
        sign = np.sign(turn.sum(axis=1, keepdims=True))
        hidden += ((turn * sign <= 0.0) * length).sum(axis=1)
        nearest = np.minimum(nearest, np.hypot(away[..., 0], away[..., 1]).min(axis=1))
        total += float(length.sum())
    share = hidden / max(total, 1e-300)
    best = int(np.lexsort((-nearest, np.round(share, 3)))[0])
    return grid[best], float(share[best])


def fit_contour(lobe: Lobe, centre: FloatArray, goal_mm: float) -> Contour | None:
    """Return a lobe's contour about a centre: half axes by Gauss–Newton, then as few uniform weights as meet the goal.

    Only points within the region count; elsewhere the ridge holds the contour to its superellipse. None where too few
    points are seen.
    """
    away = lobe.points[lobe.seen] - centre
    radii = np.hypot(*away.T)
    if radii.size < LEAST_POINTS or not radii.min() > 0.0:
        return None
    angles = np.arctan2(away[:, 1], away[:, 0])
    base = Contour(frozen(centre), frozen(_half_axes(away / radii[:, None], radii)))
    best = base
    for count in WEIGHT_COUNTS:
        best = with_weights(base, angles, radii, count)
        if float(np.abs(contour_radius(best, angles) - radii).mean()) <= goal_mm:
            break
    return best


def _half_axes(directions: FloatArray, radii: FloatArray) -> FloatArray:
    """Return the four half axes (mm) whose ellipse quadrants lie nearest to radii in unit directions (n, 2)."""
    negative = (directions < 0.0).astype(np.int64)
    column = negative + np.array([0, 2])
    logs = np.full(4, math.log(float(np.median(radii))))
    bounds = math.log(float(radii.min()) / 4.0), math.log(float(radii.max()) * 2.0)
    for _ in range(AXIS_STEPS):
        share = (directions / np.exp(logs)[column]) ** 2
        norm = np.sqrt(share.sum(axis=1))
        jacobian = np.zeros((radii.size, 4))
        np.put_along_axis(jacobian, column, share / norm[:, None] ** 3, axis=1)
        gram = jacobian.T @ jacobian
        gram += np.eye(4) * (1e-3 * np.trace(gram) / 4.0)
        step = np.linalg.solve(gram, jacobian.T @ (radii - 1.0 / norm))
        logs = np.clip(logs + np.clip(step, -0.5, 0.5), *bounds)
        if np.abs(step).max() < 1e-6:
            break
    return np.asarray(np.exp(logs))


def with_weights(base: Contour, angles: FloatArray, radii: FloatArray, count: int) -> Contour:
    """Return the contour with `count` uniform weights fitted to radii (n,) at angles (n,)."""
    if count == 0:
        return base
    at = -math.pi + 2.0 * math.pi * np.arange(count) / count
    extent = 1.0 - math.cos(min(CONTOUR_SUPPORT * 2.0 * math.pi / count, math.pi))
    h = (1.0 - np.cos(angles[:, None] - at)) / extent
    values = np.exp(-4.0 * np.minimum(h, 1.0)) * np.maximum(1.0 - h, 0.0) ** 2
    bare = contour_radius(base, angles)
    row = bare[:, None] * values
    gram = row.T @ row
    gram[np.diag_indices(count)] += RIDGE * np.trace(gram) / count
    target = bare * np.minimum(1.0 - radii / bare, MAX_SCALE)
    return Contour(base.centre, base.half_axes, base.logits, frozen(np.linalg.solve(gram, row.T @ target)))
