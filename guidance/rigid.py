"""Rigid transforms: checked, inverted, applied.

A rigid transform is a (4, 4) float64 array in mm, named `T_target_source`:
`p_target = T_target_source @ p_source`; chain them with `@` so that neighbouring names match.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from devices.rotation import is_rigid
from guidance.errors import InputError

__all__ = ["check_rigid", "invert", "is_rigid", "pose", "rotation_angle_rad", "transform_points"]


def _departure(T: NDArray[np.float64]) -> tuple[float, float, bool]:
    """Largest entry of |R Rᵀ − 1|, determinant of R, and whether the last row is (0, 0, 0, 1)."""
    R = T[:3, :3]
    return float(np.abs(R @ R.T - np.eye(3)).max()), float(np.linalg.det(R)), bool((T[3] == (0.0, 0.0, 0.0, 1.0)).all())


def check_rigid(T: ArrayLike, name: str, tolerance: float = 1e-3) -> NDArray[np.float64]:
    """Return `T` as a new (4, 4) float64 array, or raise if it is not a rigid transform in mm.

    Parameters
    ----------
    T : (4, 4) array_like
        The transform, mm.
    name : str
        What to call it in the message, for example ``"T_patient_tracker"``.
    tolerance : float
        Largest allowed entry of ``|R @ R.T - 1|``.

    Raises
    ------
    InputError
        Where the shape is wrong, an entry is not finite, the last row is not (0, 0, 0, 1), or the 3 × 3 part is
        no rotation (scaled, sheared or mirrored).
    """
    try:
        matrix = np.array(T, dtype=np.float64)
    except (TypeError, ValueError):
        raise InputError(f"{name}: expected a (4, 4) array of numbers, got {type(T).__name__}") from None
    if matrix.shape != (4, 4):
        raise InputError(f"{name}: expected a (4, 4) rigid transform in mm, got shape {matrix.shape}")
    if not np.isfinite(matrix).all():
        raise InputError(f"{name}: has NaN or infinite entries; a missing pose must not be used as a transform")
    departure, determinant, last_row = _departure(matrix)
    if not last_row:
        raise InputError(
            f"{name}: last row is {matrix[3].tolist()}, expected [0, 0, 0, 1]; is the matrix transposed (row vectors)?"
        )
    if determinant <= 0.0:
        raise InputError(f"{name}: determinant {determinant:.4g}, expected +1; an axis is mirrored (LPS against RAS?)")
    if departure > tolerance:
        raise InputError(
            f"{name}: not a rotation, |R Rᵀ − 1| is {departure:.3g} (allowed {tolerance:.3g}); "
            "remove scaling or shear, and give lengths in mm"
        )
    return matrix


def invert(T_target_source: ArrayLike) -> NDArray[np.float64]:
    """Return T_source_target of a rigid transform (by transposing, not by solving).

    Parameters
    ----------
    T_target_source : (..., 4, 4) array_like
        Rigid transforms, mm; not checked.

    Returns
    -------
    (..., 4, 4) ndarray
    """
    T = np.asarray(T_target_source, dtype=np.float64)
    inverse = np.zeros(T.shape)
    Rt = np.swapaxes(T[..., :3, :3], -1, -2)
    inverse[..., :3, :3] = Rt
    inverse[..., :3, 3] = -(Rt @ T[..., :3, 3:])[..., 0]
    inverse[..., 3, 3] = 1.0
    return inverse


def transform_points(T_target_source: ArrayLike, points: ArrayLike) -> NDArray[np.float64]:
    """Map points from the source to the target frame.

    Parameters
    ----------
    T_target_source : (4, 4) array_like
        Transform, mm.
    points : (..., 3) array_like
        Points in the source frame, mm.

    Returns
    -------
    (..., 3) ndarray
        The same points in the target frame, mm.
    """
    T = np.asarray(T_target_source, dtype=np.float64)
    p = np.asarray(points, dtype=np.float64)
    if p.ndim == 0 or p.shape[-1] != 3:
        raise InputError(f"points: expected shape (..., 3), got {p.shape}")
    return p @ T[:3, :3].T + T[:3, 3]


def rotation_angle_rad(R: ArrayLike) -> NDArray[np.float64]:
    """Angle of a rotation, in [0, π] rad, exact to rounding near 0 as well as near π.

    Parameters
    ----------
    R : (..., 3, 3) or (..., 4, 4) array_like
        Rotations, or rigid transforms whose rotation is meant.

    Returns
    -------
    (...) ndarray
        rad; a scalar array for one rotation.
    """
    R = np.asarray(R, dtype=np.float64)
    twice_sin = np.sqrt(
        (R[..., 2, 1] - R[..., 1, 2]) ** 2 + (R[..., 0, 2] - R[..., 2, 0]) ** 2 + (R[..., 1, 0] - R[..., 0, 1]) ** 2
    )
    twice_cos = R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2] - 1.0
    return np.asarray(np.arctan2(twice_sin, twice_cos))


def pose(position: ArrayLike, direction: ArrayLike) -> NDArray[np.float64]:
    """Rigid transform of a tool at `position` whose +z axis points along `direction`.

    The rotation about `direction` is free; it is fixed by taking +x as near as can be to the coordinate axis that is
    most perpendicular to `direction`.

    Parameters
    ----------
    position : (3,) array_like
        Origin of the tool in the target frame, mm.
    direction : (3,) array_like
        Any length > 0.

    Returns
    -------
    (4, 4) ndarray
        T_target_tool, mm.

    Raises
    ------
    InputError
        Where a value is not finite or the direction has no length.
    """
    p = np.asarray(position, dtype=np.float64)
    z = np.asarray(direction, dtype=np.float64)
    if p.shape != (3,) or z.shape != (3,) or not np.isfinite(p).all() or not np.isfinite(z).all():
        raise InputError(f"pose: expected a finite (3,) position and direction, got {position!r} and {direction!r}")
    largest = np.abs(z).max()
    if largest == 0.0:
        raise InputError("pose: the direction has no length; give two different points to define it")
    z = z / largest
    z = z / np.linalg.norm(z)
    x = np.zeros(3)
    x[np.argmin(np.abs(z))] = 1.0
    x -= (x @ z) * z
    x /= np.linalg.norm(x)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2], T[:3, 3] = x, np.cross(z, x), z, p
    return T
