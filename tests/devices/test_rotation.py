"""Quaternions and interpolation against scipy."""

from __future__ import annotations

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from scipy.spatial.transform import Rotation, Slerp

from devices.rotation import (
    interpolate,
    is_rigid,
    pose_from_quaternion,
    quaternion_from_rotation,
    rotation_from_quaternion,
    rotation_from_vector,
)

turns = hnp.arrays(np.float64, 3, elements=st.floats(-4, 4))
places = hnp.arrays(np.float64, 3, elements=st.floats(-1e4, 1e4))


@given(turns)
def test_a_rotation_survives_the_quaternion(turn: np.ndarray) -> None:
    R = Rotation.from_rotvec(turn).as_matrix()
    np.testing.assert_allclose(rotation_from_vector(turn), R, atol=1e-14)
    q = quaternion_from_rotation(R)
    assert q[0] >= 0.0
    np.testing.assert_allclose(rotation_from_quaternion(3.0 * q), R, atol=1e-14)


@given(turns, turns, places, places, st.floats(0, 1))
def test_interpolation_is_slerp_and_straight(
    a: np.ndarray, b: np.ndarray, p: np.ndarray, q: np.ndarray, fraction: float
) -> None:
    ends = Rotation.from_rotvec([a, b])
    if (ends[0].inv() * ends[1]).magnitude() > np.pi - 1e-6:
        return  # both ways round are equally short
    Ta = pose_from_quaternion(np.roll(ends[0].as_quat(), 1), p)
    Tb = pose_from_quaternion(np.roll(ends[1].as_quat(), 1), q)
    T = interpolate(Ta, Tb, fraction)
    np.testing.assert_allclose(T[:3, :3], Slerp([0, 1], ends)(fraction).as_matrix(), atol=1e-8)
    np.testing.assert_allclose(T[:3, 3], (1 - fraction) * p + fraction * q, atol=1e-9)
    assert is_rigid(T, 1e-12)


def test_interpolation_meets_its_ends_exactly() -> None:
    Ta = pose_from_quaternion([0.3, -0.1, 0.2, 0.9], [1, 2, 3])
    Tb = pose_from_quaternion([0.5, 0.5, -0.5, 0.5], [4, 5, 6])
    assert np.array_equal(interpolate(Ta, Tb, 0.0), Ta)
    assert np.array_equal(interpolate(Ta, Tb, 1.0), Tb)


@pytest.mark.parametrize(
    "T",
    [
        None,
        "pose",
        np.eye(3),
        np.full((4, 4), np.nan),
        np.diag([1.0, 1.0, -1.0, 1.0]),
        1.01 * np.eye(4),
        np.zeros((4, 4)),
    ],
)
def test_what_is_no_pose_is_seen(T: object) -> None:
    assert not is_rigid(T)
