"""The little algebra that poses need: quaternions (w, x, y, z), rigid 4 × 4 matrices, interpolation. Plain numpy."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

__all__ = [
    "interpolate",
    "is_rigid",
    "pose_from_quaternion",
    "quaternion_from_rotation",
    "rotation_from_quaternion",
    "rotation_from_vector",
    "vector_from_rotation",
]


def is_rigid(T: object, tolerance: float = 1e-3) -> bool:
    """Tell whether `T` is a finite rigid transform; never raises.

    Parameters
    ----------
    T : (4, 4) array_like or None
        Anything; what is not a finite (4, 4) matrix of numbers is not rigid.
    tolerance : float
        Largest allowed entry of ``|R @ R.T - 1|``. The default accepts what trackers send in text (1e-4 per quaternion
        component) and refuses scalings of 0.1 %.
    """
    try:
        matrix = np.asarray(T, dtype=np.float64)
    except (TypeError, ValueError):
        return False
    if matrix.shape != (4, 4):
        return False
    # plain floats: at sixteen numbers numpy costs five times as much, and this runs for every pose of every frame
    (a, b, c, x), (d, e, f, y), (g, h, i, z), last = matrix.tolist()
    if last != [0.0, 0.0, 0.0, 1.0] or not math.isfinite(x + y + z):
        return False
    # written so that a NaN fails
    return bool(
        abs(a * a + b * b + c * c - 1.0) <= tolerance
        and abs(d * d + e * e + f * f - 1.0) <= tolerance
        and abs(g * g + h * h + i * i - 1.0) <= tolerance
        and abs(a * d + b * e + c * f) <= tolerance
        and abs(a * g + b * h + c * i) <= tolerance
        and abs(d * g + e * h + f * i) <= tolerance
        and a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g) > 0.0
    )


def rotation_from_quaternion(quaternion: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) of a quaternion (w, x, y, z) of any length > 0 (it is normalised)."""
    w, x, y, z = (float(c) for c in np.asarray(quaternion, dtype=np.float64))
    length = math.sqrt(w * w + x * x + y * y + z * z)
    w, x, y, z = w / length, x / length, y / length, z / length
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


def quaternion_from_rotation(R: ArrayLike) -> NDArray[np.float64]:
    """Unit quaternion (w, x, y, z), w ≥ 0, of a rotation matrix (3, 3).

    The largest of the four squared components is found first, so no division by a small number occurs.
    """
    m = np.asarray(R, dtype=np.float64)
    xx, yy, zz = float(m[0, 0]), float(m[1, 1]), float(m[2, 2])
    squares = (1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz, 1 - xx - yy + zz)
    k = max(range(4), key=squares.__getitem__)
    wx, wy, wz = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    xy, xz, yz = m[0, 1] + m[1, 0], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    row = [(squares[0], wx, wy, wz), (wx, squares[1], xy, xz), (wy, xy, squares[2], yz), (wz, xz, yz, squares[3])][k]
    q = np.array(row)
    q /= np.linalg.norm(q)
    return -q if q[0] < 0.0 else q


def rotation_from_vector(vector: ArrayLike) -> NDArray[np.float64]:
    """Rotation matrix (3, 3) about `vector` (3,) by its length in rad."""
    v = np.asarray(vector, dtype=np.float64)
    angle = float(np.linalg.norm(v))
    # sin(a/2)/a → 1/2: the series keeps tiny rotations exact
    scale = 0.5 if angle < 1e-8 else math.sin(0.5 * angle) / angle
    return rotation_from_quaternion(np.append(math.cos(0.5 * angle), scale * v))


def vector_from_rotation(R: ArrayLike) -> NDArray[np.float64]:
    """Axis times angle, rad, (3,) of a rotation matrix (3, 3); the angle lies in [0, π]."""
    q = quaternion_from_rotation(R)
    sine = float(np.linalg.norm(q[1:]))
    if sine < 1e-12:
        return np.asarray(2.0 * q[1:])
    return np.asarray(2.0 * math.atan2(sine, float(q[0])) / sine * q[1:])


def pose_from_quaternion(quaternion: ArrayLike, position: ArrayLike) -> NDArray[np.float64]:
    """Rigid (4, 4) matrix, mm, from a quaternion (w, x, y, z) and a position (3,) in mm."""
    T = np.eye(4)
    T[:3, :3] = rotation_from_quaternion(quaternion)
    T[:3, 3] = position
    return T


def interpolate(T_start: ArrayLike, T_end: ArrayLike, fraction: float) -> NDArray[np.float64]:
    """Pose between two poses: straight in position, slerp along the shorter arc in rotation.

    Parameters
    ----------
    T_start, T_end : (4, 4) array_like
        Rigid poses, mm.
    fraction : float
        0 gives `T_start`, 1 gives `T_end`; outside [0, 1] the motion is continued at constant velocity.

    Returns
    -------
    (4, 4) ndarray
    """
    a, b = np.asarray(T_start, dtype=np.float64), np.asarray(T_end, dtype=np.float64)
    if fraction == 0.0:
        return a.copy()
    if fraction == 1.0:
        return b.copy()
    T = np.eye(4)
    turn = vector_from_rotation(a[:3, :3].T @ b[:3, :3])
    T[:3, :3] = a[:3, :3] @ rotation_from_vector(fraction * turn)
    T[:3, 3] = (1.0 - fraction) * a[:3, 3] + fraction * b[:3, 3]
    return T
