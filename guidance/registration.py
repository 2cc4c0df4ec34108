"""Registration: where is the patient in the tracker's frame? By landmarks, or by points digitised on a surface."""

from __future__ import annotations

import math
from dataclasses import dataclass
from itertools import permutations
from typing import Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.optimize import linear_sum_assignment
from scipy.spatial.distance import cdist

from devices.rotation import rotation_from_vector
from guidance.errors import GuidanceError, InputError
from guidance.rigid import check_rigid, transform_points

__all__ = [
    "LandmarkRegistration",
    "RegistrationError",
    "SurfaceRegistration",
    "match_landmarks",
    "register_landmarks",
    "register_surface",
]

Array = NDArray[np.float64]


class RegistrationError(GuidanceError, ValueError):
    """Points that fix no trustworthy registration; the message says which and why."""


@dataclass(frozen=True, eq=False)
class LandmarkRegistration:
    """A rigid registration of paired landmarks.

    Parameters
    ----------
    T_target_source : (4, 4) array
        mm.
    fiducial_registration_error_mm : float
        Root mean square of the residuals of the landmarks used.
    residuals_mm : (n,) array
        Distance of every landmark from its partner after registration, refused ones included.
    used : (n,) bool array
        False where a landmark was refused as an outlier.
    source : (n, 3) array
        The landmarks in the source frame, mm.
    """

    T_target_source: Array
    fiducial_registration_error_mm: float
    residuals_mm: Array
    used: NDArray[np.bool_]
    source: Array

    @property
    def fiducial_localisation_error_mm(self) -> float:
        """Estimated rms error of placing one landmark, mm: FRE² = (1 − 2/n) FLE² (Sibson; Fitzpatrick et al. 1998)."""
        n = int(self.used.sum())
        return self.fiducial_registration_error_mm / math.sqrt(1.0 - 2.0 / n)

    def target_registration_error_mm(self, points: ArrayLike) -> Array:
        """Expected rms registration error at points of the source frame, mm (Fitzpatrick, West, Maurer 1998).

        TRE² = FLE²/n · (1 + ⅓ Σ_k d_k²/f_k²), with d_k the point's and f_k the landmarks' rms distance from the k-th
        principal axis. It assumes equal, isotropic, independent placing errors; a common mistake of all landmarks does
        not show in it.

        Parameters
        ----------
        points : (..., 3) array_like

        Returns
        -------
        (...) ndarray
        """
        landmarks = self.source[self.used]
        centre = landmarks.mean(axis=0)
        _, _, axes = np.linalg.svd(landmarks - centre)
        along = (landmarks - centre) @ axes.T
        far = (np.asarray(points, dtype=np.float64) - centre) @ axes.T
        ratio = np.zeros(far.shape[:-1])
        for k in range(3):
            others = [axis for axis in range(3) if axis != k]
            ratio += (far[..., others] ** 2).sum(axis=-1) / (along[:, others] ** 2).sum(axis=-1).mean()
        return self.fiducial_localisation_error_mm * np.sqrt((1.0 + ratio / 3.0) / len(landmarks))


def _checked_points(points: ArrayLike, name: str, least: int) -> Array:
    try:
        array = np.array(points, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected an (n, 3) array of numbers in mm") from None
    if array.ndim != 2 or array.shape[1] != 3:
        raise InputError(f"{name}: expected shape (n, 3), got {array.shape}")
    if not np.isfinite(array).all():
        rows = np.flatnonzero(~np.isfinite(array).all(axis=1)).tolist()
        raise InputError(f"{name}: NaN or infinite in rows {rows[:8]}; leave missing points out on both sides")
    if len(array) < least:
        raise RegistrationError(f"{name}: {len(array)} points, at least {least} are needed")
    return array


def _kabsch(source: Array, target: Array, mirrored: bool = False) -> Array:
    """Least-squares rigid motion of paired points (Arun 1987, Kabsch 1976); with a reflection where asked to."""
    source_centre, target_centre = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - target_centre).T @ (source - source_centre))
    sign = np.sign(np.linalg.det(U @ Vt)) * (-1.0 if mirrored else 1.0)
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, sign]) @ Vt
    T[:3, 3] = target_centre - T[:3, :3] @ source_centre
    return T


def _residuals(T: Array, source: Array, target: Array) -> Array:
    return np.asarray(np.linalg.norm(transform_points(T, source) - target, axis=1))


def _rms(values: Array) -> float:
    return float(np.sqrt(np.mean(values**2)))


def _refuse_lines(points: Array, name: str) -> None:
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extent[1] < 0.02 * extent[0] or extent[0] == 0.0:
        raise RegistrationError(
            f"{name}: the points lie on one line (width {extent[1]:.3g} mm against length {extent[0]:.3g} mm); "
            "a turn about it stays free: add a landmark beside the line"
        )


def register_landmarks(
    source: ArrayLike, target: ArrayLike, outlier_mm: float | None = None, max_outliers: int | None = None
) -> LandmarkRegistration:
    """Rigid registration of paired landmarks by least squares.

    Parameters
    ----------
    source, target : (n, 3) array_like
        Landmark k in either frame, mm; n ≥ 3, not on one line.
    outlier_mm : float or None
        A landmark whose distance from the registration *of the others* exceeds this is refused, worst first, while at
        least 4 remain. None keeps all.
    max_outliers : int or None
        Most landmarks that may be refused; by default a third of them. More raise.

    Returns
    -------
    LandmarkRegistration

    Raises
    ------
    InputError
        Where shapes differ or a value is not finite.
    RegistrationError
        Where the points lie on a line, one side is mirrored, or too many landmarks are outliers.
    """
    source, target = _checked_points(source, "source", 3), _checked_points(target, "target", 3)
    if source.shape != target.shape:
        raise InputError(f"source and target: expected pairs, got {len(source)} and {len(target)} points")
    _refuse_lines(source, "source")
    _refuse_lines(target, "target")
    used = np.ones(len(source), dtype=bool)
    if outlier_mm is not None:
        limit = len(source) // 3 if max_outliers is None else max_outliers
        used = _without_outliers(source, target, float(outlier_mm), limit)
    T = _kabsch(source[used], target[used])
    residuals = _residuals(T, source, target)
    error = _rms(residuals[used])
    mirror = _rms(_residuals(_kabsch(source[used], target[used], mirrored=True), source, target)[used])
    # only a solid set of four or more can tell; flat sets fit their mirror image equally well
    if used.sum() >= 4 and error > 2.0 and mirror < 0.2 * error:
        raise RegistrationError(
            f"mirrored: the landmarks fit to {error:.2f} mm, but to {mirror:.2f} mm with one axis flipped; "
            "bring both sides into LPS (RAS has x and y negated)"
        )
    return LandmarkRegistration(T, error, residuals, used, source)


def _without_outliers(source: Array, target: Array, outlier_mm: float, limit: int) -> NDArray[np.bool_]:
    """Refuse the landmark whose leaving helps the others most, as long as one misses them by more than `outlier_mm`."""
    used = np.ones(len(source), dtype=bool)
    while True:
        rows = np.flatnonzero(used)
        if len(rows) <= 4:
            return used
        # the error of the others without it finds the culprit; its own distance from their fit convicts it
        errors, misses = np.empty(len(rows)), np.empty(len(rows))
        for position, row in enumerate(rows):
            others = rows[rows != row]
            T = _kabsch(source[others], target[others])
            errors[position] = _rms(_residuals(T, source[others], target[others]))
            misses[position] = np.linalg.norm(transform_points(T, source[row]) - target[row])
        worst = int(np.argmin(errors))
        if misses[worst] <= outlier_mm:
            return used
        if len(source) - len(rows) >= limit:
            raise RegistrationError(
                f"more than {limit} of {len(source)} landmarks miss the others by more than {outlier_mm:g} mm "
                f"(landmark {rows[worst]} by {misses[worst]:.2f} mm); digitise them again, in the order of the targets"
            )
        used[rows[worst]] = False


def match_landmarks(source: ArrayLike, target: ArrayLike, ambiguity: float = 2.0) -> NDArray[np.intp]:
    """Find which target belongs to which source landmark, when their order is unknown.

    The three source points of the largest triangle are tried on every ordered triple of targets; the rest is assigned
    by distance. Works for up to some thirty landmarks.

    Parameters
    ----------
    source, target : (n, 3) array_like
        The same landmarks in two frames and two orders, mm; n ≥ 4.
    ambiguity : float
        The next best order must be worse by this factor in rms error, else the match is refused.

    Returns
    -------
    (n,) ndarray of int
        ``target[order[k]]`` is the partner of ``source[k]``.

    Raises
    ------
    RegistrationError
        Where the arrangement is too symmetric to tell.
    """
    source, target = _checked_points(source, "source", 4), _checked_points(target, "target", 4)
    if source.shape != target.shape:
        raise InputError(f"source and target: expected equal numbers, got {len(source)} and {len(target)} points")
    _refuse_lines(source, "source")
    first = np.array(np.unravel_index(np.argmax(cdist(source, source)), (len(source), len(source))))
    edge = source[first[1]] - source[first[0]]
    width = np.linalg.norm(np.cross(source - source[first[0]], edge), axis=1)
    triple = np.append(first, np.argmax(width))
    wanted, given = cdist(source[triple], source[triple]), cdist(target, target)
    found: dict[tuple[int, ...], float] = {}
    for candidate in permutations(range(len(target)), 3):
        chosen = np.array(candidate)
        # a triangle that differs by a fifth is no candidate: landmarks are placed to a few per cent of their distances
        if np.abs(given[np.ix_(chosen, chosen)] - wanted).max() > 0.2 * wanted.max():
            continue
        T = _kabsch(source[triple], target[chosen])
        _, order = linear_sum_assignment(cdist(transform_points(T, source), target) ** 2)
        key = tuple(int(k) for k in order)
        if key not in found:
            found[key] = _rms(_residuals(_kabsch(source, target[order]), source, target[order]))
    if not found:
        raise RegistrationError("the two sets have no triangle in common; are both in mm, and of the same body?")
    ranked = sorted(found, key=found.__getitem__)
    if len(ranked) > 1 and found[ranked[1]] < max(ambiguity * found[ranked[0]], 1e-6):
        raise RegistrationError(
            f"ambiguous: two orders fit to {found[ranked[0]]:.2f} and {found[ranked[1]]:.2f} mm; give the order"
        )
    return np.array(ranked[0], dtype=np.intp)


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
    points = _checked_points(points, "points", 6)
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
        for propose in (_plane_step, _kabsch):
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
        return cls(T, moved, np.asarray(closest, dtype=np.float64), residuals, used, _rms(residuals[used]))


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
