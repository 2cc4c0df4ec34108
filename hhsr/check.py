"""The one boundary where arrays from outside become the arrays that the engine works on."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from hhsr.errors import InputError

FloatArray = NDArray[np.float64]


def as_points(value: ArrayLike, name: str = "points") -> FloatArray:
    """Return `value` as a C-contiguous float64 array of shape (..., 3); raise InputError on another shape or type."""
    try:
        points = np.ascontiguousarray(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: got {type(value).__name__}, expected numbers of shape (..., 3)") from error
    if not points.flags.writeable:  # kernels would be compiled anew for it: a minute in which nothing answers
        points = points.copy()
    if points.shape == (0,):
        return points.reshape(0, 3)
    if points.ndim == 0 or points.shape[-1] != 3:
        raise InputError(f"{name}: got shape {points.shape}, expected (..., 3): one row x, y, z in mm per point")
    return points


def finite_rows(points: FloatArray) -> NDArray[np.bool_]:
    """Return which rows of (..., 3) are finite, shape (...)."""
    return np.asarray(np.isfinite(points).all(axis=-1))


def require_finite(points: FloatArray, name: str) -> None:
    """Raise InputError naming the first row that is not finite."""
    bad = ~finite_rows(points)
    if bad.any():
        index = np.argwhere(np.atleast_1d(bad))[0].tolist()
        raise InputError(
            f"{name}: {int(bad.sum())} rows are not finite (first at {index}), expected millimetres; "
            'a lost pose is not a point: drop it, or ask with on_invalid="mark"'
        )


def as_float(value: Any, name: str, low: float = -math.inf, high: float = math.inf) -> float:
    """Return `value` as a finite float within [low, high]; raise InputError otherwise."""
    try:
        number = float(value)
    except (TypeError, ValueError) as error:
        raise InputError(f"{name}: got {value!r}, expected a number") from error
    if not (math.isfinite(number) and low <= number <= high):
        raise InputError(f"{name}: got {number}, expected a finite number in [{low}, {high}]")
    return number


def as_rigid(value: ArrayLike, name: str = "T_target_source", tolerance: float = 1e-6) -> FloatArray:
    """Return `value` as a (4, 4) rigid transform; raise InputError if it scales, shears, mirrors or is not finite."""
    transform = np.ascontiguousarray(value, dtype=np.float64)
    if transform.shape != (4, 4) or not np.isfinite(transform).all():
        raise InputError(f"{name}: got shape {transform.shape}, expected a finite (4, 4) rigid transform")
    rotation = transform[:3, :3]
    off = float(np.abs(rotation @ rotation.T - np.eye(3)).max())
    if off > tolerance or np.linalg.det(rotation) < 0 or not np.allclose(transform[3], (0, 0, 0, 1), atol=tolerance):
        raise InputError(
            f"{name}: not a rigid motion (|R Rᵀ − 1| = {off:.2g}, det {np.linalg.det(rotation):.3g}); "
            "expected rotation and translation in mm, without scale or mirror"
        )
    return transform
