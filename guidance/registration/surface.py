"""Registration of points digitised on a surface: trimmed ICP on the shape's own closest points."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from devices.rotation import rotation_from_vector
from guidance.errors import InputError
from guidance.registration.points import Array, checked_points, kabsch, rms
from guidance.rigid import check_rigid, transform_points

__all__ = ["HasClosestPoint", "SurfaceRegistration", "register_surface"]


class HasClosestPoint(Protocol):
    """What surface registration asks of a shape."""

    def closest_point(self, points: Array) -> tuple[Array, Array]:
        """Return the nearest surface points (..., 3) and their distances (...), mm."""


@dataclass(frozen=True, eq=False)
class SurfaceRegistration:
    """A rigid registration of digitised points to a shape.

    Parameters
    ----------
    T_target_source : (4, 4) array
        Shape's frame from the frame of the points, mm.
    rms_mm : float
        Root mean square distance of the points used.
    residuals_mm : (n,) array
        Distance of every point from the surface, trimmed ones included.
    used : (n,) bool array
    iterations : int
    converged : bool
        False where `max_iterations` came first: do not trust it.
    weakest_mm : float
        How far the registration could move in its worst-determined direction for 1 mm of rms error: large where the
        points leave it free (a sphere, a plane).
    """

    T_target_source: Array
    rms_mm: float
    residuals_mm: Array
    used: NDArray[np.bool_]
    iterations: int
    converged: bool
    weakest_mm: float


def register_surface(
    points: ArrayLike,
    shape: HasClosestPoint,
    T_target_source: ArrayLike,
    trim: float = 0.1,
    max_iterations: int = 200,
    tolerance_mm: float = 1e-3,
) -> SurfaceRegistration:
    """Register digitised points to a shape's surface by trimmed ICP, from a start near the answer.

    Each step asks the shape for the closest points and solves for a small motion that shortens the distances along
    their own directions (point to plane); where that does not help, it pulls points to points (Kabsch).

    Parameters
    ----------
    points : (n, 3) array_like
        Digitised on the surface, in the source frame, mm; n ≥ 6.
    shape : object with ``closest_point((n, 3)) → ((n, 3), (n,))``
        In the target frame: an `hhsr.Shape`.
    T_target_source : (4, 4) array_like
        Start, for example from landmarks; ICP finds the nearest good fit, not the best in the world.
    trim : float
        Share of the points, farthest first, that are left out of each step, in [0, 0.9].
    max_iterations : int
    tolerance_mm : float
        Stop once no point moves by more in a step.

    Returns
    -------
    SurfaceRegistration
    """
    points = checked_points(points, "points", 6)
    T = check_rigid(T_target_source, "T_target_source")
    if not 0.0 <= trim <= 0.9:
        raise InputError(f"trim: expected a share in [0, 0.9], got {trim!r}")
    keep = max(6, math.ceil((1.0 - trim) * len(points)))
    fit = _Fit.of(T, points, shape, keep)
    converged, iteration = False, 0
    while not converged and iteration < max_iterations:
        iteration += 1
        used, closest = fit.moved[fit.used], fit.closest[fit.used]
        better = None
        for propose in (_plane_step, kabsch):
            step = propose(used, closest)
            if step is None:
                continue
            trial = _Fit.of(step @ fit.T, points, shape, keep)
            if trial.rms_mm < fit.rms_mm - 1e-3 * tolerance_mm:
                better = trial
                break
        converged = better is None or float(np.abs(better.moved - fit.moved).max()) <= tolerance_mm
        fit = better or fit
    weakest = _weakest_mm(fit.moved[fit.used], fit.closest[fit.used])
    return SurfaceRegistration(fit.T, fit.rms_mm, fit.residuals_mm, fit.used, iteration, converged, weakest)


@dataclass(frozen=True, eq=False)
class _Fit:
    """The points under one candidate transform, with their closest points and the share that counts."""

    T: Array
    moved: Array
    closest: Array
    residuals_mm: Array
    used: NDArray[np.bool_]
    rms_mm: float

    @classmethod
    def of(cls, T: Array, points: Array, shape: HasClosestPoint, keep: int) -> _Fit:
        moved = transform_points(T, points)
        closest, distances = shape.closest_point(moved)
        residuals = np.abs(np.asarray(distances, dtype=np.float64))
        used = np.zeros(len(points), dtype=bool)
        used[np.argsort(residuals, kind="stable")[:keep]] = True
        return cls(T, moved, np.asarray(closest, dtype=np.float64), residuals, used, rms(residuals[used]))


def _plane_rows(moved: Array, closest: Array) -> tuple[Array, Array, Array, float]:
    """Normals, lever arms (scaled to the points' size) and distances, for points that are off the surface."""
    gap = moved - closest
    distance = np.linalg.norm(gap, axis=1)
    # direction of a gap of the shape's own tolerance (0.01 mm) is noise
    off = distance > 0.02
    normals = gap[off] / distance[off, None]
    centre = moved.mean(axis=0)
    scale = float(np.sqrt(((moved - centre) ** 2).sum(axis=1).mean()))
    levers = np.cross((moved[off] - centre) / scale, normals)
    return normals, levers, distance[off], scale


def _plane_step(moved: Array, closest: Array) -> Array | None:
    normals, levers, distance, scale = _plane_rows(moved, closest)
    if len(distance) < 12:
        return None
    rows = np.hstack([normals, levers])
    # Tikhonov: directions that the points do not fix stay where they are
    solution = np.linalg.lstsq(
        np.vstack([rows, 1e-3 * math.sqrt(len(rows)) * np.eye(6)]), np.append(-distance, np.zeros(6)), rcond=None
    )[0]
    turn = solution[3:] / scale
    if np.linalg.norm(turn) > 0.5:
        return None
    step = np.eye(4)
    step[:3, :3] = rotation_from_vector(turn)
    centre = moved.mean(axis=0)
    step[:3, 3] = centre + solution[:3] - step[:3, :3] @ centre
    return step


def _weakest_mm(moved: Array, closest: Array) -> float:
    normals, levers, _, _ = _plane_rows(moved, closest)
    if len(normals) < 6:
        return math.nan
    smallest = np.linalg.svd(np.hstack([normals, levers]), compute_uv=False)[-1] / math.sqrt(len(normals))
    return float(1.0 / smallest) if smallest > 0.0 else math.inf
