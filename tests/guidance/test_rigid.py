"""Rigid transforms against scipy's rotations."""

from __future__ import annotations

import hypothesis.extra.numpy as hnp
import hypothesis.strategies as st
import numpy as np
import pytest
from hypothesis import given
from scipy.spatial.transform import Rotation

from guidance.errors import InputError
from guidance.rigid import check_rigid, invert, is_rigid, pose, rotation_angle_rad, transform_points

coordinates = st.floats(-1e4, 1e4, allow_nan=False)
vectors = hnp.arrays(np.float64, 3, elements=coordinates)


@st.composite
def rigid_transforms(draw: st.DrawFn) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = Rotation.from_rotvec(draw(hnp.arrays(np.float64, 3, elements=st.floats(-4, 4)))).as_matrix()
    T[:3, 3] = draw(vectors)
    return T


@given(rigid_transforms(), vectors)
def test_the_inverse_brings_points_back(T: np.ndarray, point: np.ndarray) -> None:
    there = transform_points(T, point)
    np.testing.assert_allclose(transform_points(invert(T), there), point, atol=1e-10 * 2e4)
    np.testing.assert_allclose(there, (T @ np.append(point, 1.0))[:3], atol=1e-8)


@given(rigid_transforms())
def test_check_returns_an_equal_copy(T: np.ndarray) -> None:
    checked = check_rigid(T, "T_a_b")
    assert checked is not T
    np.testing.assert_array_equal(checked, T)
    assert is_rigid(T)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-4, 1.0, np.pi - 1e-7, np.pi])
def test_the_angle_is_exact_at_both_ends(angle: float) -> None:
    axis = np.array([0.6, -0.48, 0.64])
    R = Rotation.from_rotvec(angle * axis).as_matrix()
    assert rotation_angle_rad(R) == pytest.approx(angle, abs=1e-14)


def test_batches_are_mapped_one_by_one() -> None:
    generator = np.random.default_rng(3)
    T = np.tile(np.eye(4), (5, 1, 1))
    T[:, :3, :3] = Rotation.random(5, rng=generator).as_matrix()
    T[:, :3, 3] = generator.normal(size=(5, 3))
    np.testing.assert_allclose(invert(T) @ T, np.tile(np.eye(4), (5, 1, 1)), atol=1e-14)
    assert rotation_angle_rad(T).shape == (5,)


@given(vectors, vectors.filter(lambda v: np.abs(v).max() > 1e-300))
def test_a_pose_points_where_it_is_told(position: np.ndarray, direction: np.ndarray) -> None:
    T = check_rigid(pose(position, direction), "pose", tolerance=1e-12)
    scaled = direction / np.abs(direction).max()
    np.testing.assert_allclose(T[:3, 2], scaled / np.linalg.norm(scaled), atol=1e-12)
    np.testing.assert_array_equal(T[:3, 3], position)


@pytest.mark.parametrize(
    ("spoil", "message"),
    [
        (lambda T: T[:3], "shape"),
        (lambda T: T * np.nan, "NaN"),
        (lambda T: T.T, "transposed"),
        (lambda T: T @ np.diag([1.0, 1.0, -1.0, 1.0]), "mirrored"),
        (lambda T: T @ np.diag([1.01, 1.01, 1.01, 1.0]), "not a rotation"),
    ],
)
def test_what_is_not_rigid_is_refused_by_name(spoil: object, message: str) -> None:
    T = pose([1.0, 2.0, 3.0], [0.0, 1.0, 1.0])
    bad = spoil(T)  # type: ignore[operator]
    assert not is_rigid(bad)
    with pytest.raises(InputError, match=f"T_patient_tracker.*{message}"):
        check_rigid(bad, "T_patient_tracker")


def test_nonsense_is_refused() -> None:
    assert not is_rigid(None)
    assert not is_rigid("pose")
    with pytest.raises(InputError, match="no length"):
        pose([0, 0, 0], [0, 0, 0])
    with pytest.raises(InputError, match=r"\(\.\.\., 3\)"):
        transform_points(np.eye(4), [1.0, 2.0])
