"""Shapes with closed forms, asked like `hhsr.Shape`: a ball and a rod (a capsule). Exact, so they judge the rest."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import trimesh


@dataclass(frozen=True)
class Crossings:
    offsets: np.ndarray
    t: np.ndarray
    points: np.ndarray
    entering: np.ndarray


@dataclass(frozen=True)
class Clearance:
    clearance: np.ndarray
    t: np.ndarray
    on_axis: np.ndarray
    on_surface: np.ndarray


def segment_distance(a, b, c, d):
    """Least distance of the segments ab (..., 3) and cd (3,): ends against the other, and the interior optimum."""
    a, b = np.atleast_2d(a), np.atleast_2d(b)
    u, v, w = b - a, d - c, a - c
    uu, uv, vv = (u * u).sum(-1), u @ v, v @ v
    uw, vw = (u * w).sum(-1), w @ v
    det = uu * vv - uv * uv
    with np.errstate(invalid="ignore", divide="ignore"):
        s = np.clip(np.where(det > 1e-12, (uv * vw - vv * uw) / det, 0.0), 0.0, 1.0)

    def gap(s, t):
        return np.linalg.norm(a + s[:, None] * u - c - t[:, None] * v, axis=-1)

    def best_t(s):
        return np.clip(((a + s[:, None] * u - c) @ v) / vv if vv > 0 else np.zeros(len(a)), 0.0, 1.0)

    def best_s(t):
        q = c + t[:, None] * v
        return np.clip(((q - a) * u).sum(-1) / np.where(uu > 0, uu, 1.0), 0.0, 1.0)

    tries = [gap(s, best_t(s))]
    for end in (0.0, 1.0):
        e = np.full(len(a), end)
        tries += [gap(e, best_t(e)), gap(best_s(e), e)]
    return np.min(tries, axis=0)


class Rod:
    """All points within `radius` of the segment from `start` to `end`; a ball where these are one."""

    def __init__(self, start, end, radius, fit_error=(0.0, 0.0, 0.0)):
        self.start, self.end = np.asarray(start, float), np.asarray(end, float)
        self.radius, self.fit_error, self.parameters = float(radius), fit_error, 7

    @property
    def bounds(self):
        ends = np.stack([self.start, self.end])
        return np.stack([ends.min(0) - self.radius, ends.max(0) + self.radius])

    def _axis_point(self, p):
        v = self.end - self.start
        vv = v @ v
        t = np.clip(((p - self.start) @ v) / vv, 0.0, 1.0) if vv > 0 else np.zeros(p.shape[:-1])
        return self.start + t[..., None] * v

    def signed_distance(self, points, tolerance_mm=0.01):
        p = np.asarray(points, float)
        return np.linalg.norm(p - self._axis_point(p), axis=-1) - self.radius

    def contains(self, points):
        return self.signed_distance(points) <= 0.0

    def closest_point(self, points):
        p = np.asarray(points, float)
        foot = self._axis_point(p)
        away = p - foot
        away = away / np.linalg.norm(away, axis=-1, keepdims=True)
        q = foot + self.radius * away
        return q, np.linalg.norm(p - q, axis=-1)

    def clearance(self, starts, ends, radius=0.0, tolerance_mm=0.01):
        starts, ends = np.asarray(starts, float), np.asarray(ends, float)
        gap = segment_distance(starts.reshape(-1, 3), ends.reshape(-1, 3), self.start, self.end)
        return (gap - self.radius - radius).reshape(starts.shape[:-1])

    def closest_approach(self, starts, ends, radius=0.0):
        """Clearance in closed form; where, by fine samples of the axis."""
        starts, ends = np.asarray(starts, float), np.asarray(ends, float)
        t = np.linspace(0.0, 1.0, 301)
        axis = starts[..., None, :] + t[:, None] * (ends - starts)[..., None, :]
        best = t[self.signed_distance(axis).argmin(axis=-1)]
        on_axis = starts + best[..., None] * (ends - starts)
        return Clearance(self.clearance(starts, ends, radius), best, on_axis, self.closest_point(on_axis)[0])

    def _crossing_list(self, a, b):
        """Sign changes by fine steps and bisection: slow, plain, good to 1e-9 of the segment."""
        t = np.linspace(0.0, 1.0, 401)
        f = self.signed_distance(a + t[:, None] * (b - a))
        roots = []
        for k in np.flatnonzero((f[:-1] > 0) != (f[1:] > 0)):
            lo, hi, outside = t[k], t[k + 1], f[k] > 0
            for _ in range(30):
                mid = 0.5 * (lo + hi)
                lo, hi = (mid, hi) if (self.signed_distance(a + mid * (b - a)) > 0) == outside else (lo, mid)
            roots.append((0.5 * (lo + hi), bool(outside)))
        return roots

    def crossings(self, starts, ends):
        starts, ends = np.atleast_2d(starts), np.atleast_2d(ends)
        lists = [self._crossing_list(a, b) for a, b in zip(starts, ends, strict=True)]
        offsets = np.concatenate([[0], np.cumsum([len(x) for x in lists])]).astype(int)
        flat = [(i, *x) for i, row in enumerate(lists) for x in row]
        t = np.array([x[1] for x in flat])
        index = np.array([x[0] for x in flat], dtype=int)
        points = starts[index] + t[:, None] * (ends - starts)[index] if flat else np.zeros((0, 3))
        return Crossings(offsets, t, points, np.array([x[2] for x in flat], dtype=bool))

    def first_crossing(self, starts, ends):
        found = self._crossing_list(np.asarray(starts, float), np.asarray(ends, float))
        return np.float64(found[0][0] if found else np.nan)

    def mesh(self, tolerance_mm=0.02):
        height = float(np.linalg.norm(self.end - self.start))
        if height == 0.0:
            mesh = trimesh.creation.icosphere(subdivisions=4, radius=self.radius)
            mesh.apply_translation(self.start)
            return mesh
        mesh = trimesh.creation.capsule(height=height, radius=self.radius)
        mesh.apply_translation([0.0, 0.0, -mesh.bounds[:, 2].mean()])
        mesh.apply_transform(trimesh.geometry.align_vectors([0, 0, 1], (self.end - self.start) / height))
        mesh.apply_translation(0.5 * (self.start + self.end))
        return mesh

    def fit_error_at(self, points):
        return np.broadcast_to(np.array(self.fit_error), (*np.shape(points)[:-1], 3))

    @property
    def leaf_errors(self):
        return (self.fit_error,)

    @property
    def encoded(self):
        return f"{self.start}{self.end}{self.radius}{self.fit_error}".encode()


def ball(centre, radius, **more):
    """A ball (the rod without length)."""
    return Rod(centre, centre, radius, **more)
