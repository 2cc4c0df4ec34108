"""What every registration does with points: check them, move one set onto another."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from guidance.errors import GuidanceError, InputError
from guidance.rigid import transform_points

__all__ = ["Array", "RegistrationError", "checked_points", "kabsch", "refuse_lines", "residuals_mm", "rms"]

Array = NDArray[np.float64]


class RegistrationError(GuidanceError, ValueError):
    """Points that fix no trustworthy registration; the message says which and why."""


def checked_points(points: ArrayLike, name: str, least: int) -> Array:
    """Finite points as an (n, 3) copy; `InputError` or, where there are fewer than `least`, `RegistrationError`."""
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


def kabsch(source: Array, target: Array, mirrored: bool = False) -> Array:
    """Least-squares rigid motion of paired points (Arun 1987, Kabsch 1976); with a reflection where asked to."""
    source_centre, target_centre = source.mean(axis=0), target.mean(axis=0)
    U, _, Vt = np.linalg.svd((target - target_centre).T @ (source - source_centre))
    sign = np.sign(np.linalg.det(U @ Vt)) * (-1.0 if mirrored else 1.0)
    T = np.eye(4)
    T[:3, :3] = U @ np.diag([1.0, 1.0, sign]) @ Vt
    T[:3, 3] = target_centre - T[:3, :3] @ source_centre
    return T


def residuals_mm(T: Array, source: Array, target: Array) -> Array:
    """Distance of each moved point from its partner, mm."""
    return np.asarray(np.linalg.norm(transform_points(T, source) - target, axis=1))


def rms(values: Array) -> float:
    """Root mean square."""
    return float(np.sqrt(np.mean(values**2)))


def refuse_lines(points: Array, name: str) -> None:
    """Raise where the points lie on one line: a turn about it would stay free."""
    extent = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    if extent[1] < 0.02 * extent[0] or extent[0] == 0.0:
        raise RegistrationError(
            f"{name}: the points lie on one line (width {extent[1]:.3g} mm against length {extent[0]:.3g} mm); "
            "a turn about it stays free: add a landmark beside the line"
        )
