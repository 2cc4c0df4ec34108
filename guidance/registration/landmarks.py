"""Registration by landmarks in pairs: least squares, errors to expect, outliers refused."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from guidance.errors import InputError
from guidance.registration.points import (
    Array,
    RegistrationError,
    checked_points,
    kabsch,
    refuse_lines,
    residuals_mm,
    rms,
)
from guidance.rigid import transform_points

__all__ = ["LandmarkRegistration", "register_landmarks"]


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
    source, target = checked_points(source, "source", 3), checked_points(target, "target", 3)
    if source.shape != target.shape:
        raise InputError(f"source and target: expected pairs, got {len(source)} and {len(target)} points")
    refuse_lines(source, "source")
    refuse_lines(target, "target")
    used = np.ones(len(source), dtype=bool)
    if outlier_mm is not None:
        limit = len(source) // 3 if max_outliers is None else max_outliers
        used = _without_outliers(source, target, float(outlier_mm), limit)
    T = kabsch(source[used], target[used])
    residuals = residuals_mm(T, source, target)
    error = rms(residuals[used])
    mirror = rms(residuals_mm(kabsch(source[used], target[used], mirrored=True), source, target)[used])
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
            T = kabsch(source[others], target[others])
            errors[position] = rms(residuals_mm(T, source[others], target[others]))
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
