"""Registration by landmarks and by surface points, against constructed truth and Monte Carlo."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from guidance.errors import InputError
from guidance.registration import RegistrationError, match_landmarks, register_landmarks, register_surface
from guidance.rigid import invert, rotation_angle_rad, transform_points
from hhsr.model import ModelLeaf, ScaleField, Superquadric, Tree
from hhsr.shape import Shape

LANDMARKS = np.array(
    [[104.3, 5, 20], [104.3, 45, 20], [104.3, 45, 0], [104.3, -5, 0], [-34.3, 45, 15], [-34.3, -5, 20], [-30, -5, 0]]
)


def motion(seed: int) -> np.ndarray:
    generator = np.random.default_rng(seed)
    T = np.eye(4)
    T[:3, :3] = Rotation.random(rng=generator).as_matrix()
    T[:3, 3] = generator.uniform(-500, 500, 3)
    return T


@given(st.integers(0, 10_000))
def test_exact_landmarks_give_the_exact_motion(seed: int) -> None:
    T = motion(seed)
    result = register_landmarks(LANDMARKS, transform_points(T, LANDMARKS))
    np.testing.assert_allclose(result.T_target_source, T, atol=1e-9)
    assert result.fiducial_registration_error_mm < 1e-9


def test_flat_sets_are_never_mirrored() -> None:
    flat = LANDMARKS * [1, 1, 0]
    T = motion(3)
    result = register_landmarks(flat, transform_points(T, flat))
    np.testing.assert_allclose(result.T_target_source, T, atol=1e-9)


def test_the_predicted_errors_are_the_real_ones() -> None:
    generator = np.random.default_rng(1)
    target = np.array([[30.0, 20.0, -90.0], [35.0, 20.0, 10.0]])
    fle, squares, fre, tre = 0.6, [], [], []
    for seed in range(400):
        T = motion(seed)
        noisy = transform_points(T, LANDMARKS) + fle / np.sqrt(3) * generator.standard_normal(LANDMARKS.shape)
        result = register_landmarks(LANDMARKS, noisy)
        miss = transform_points(result.T_target_source, target) - transform_points(T, target)
        squares.append((miss**2).sum(axis=1))
        fre.append(result.fiducial_localisation_error_mm**2)
        tre.append(result.target_registration_error_mm(target) ** 2)
    assert np.sqrt(np.mean(fre)) == pytest.approx(fle, rel=0.05)
    np.testing.assert_allclose(np.sqrt(np.mean(tre, axis=0)), np.sqrt(np.mean(squares, axis=0)), rtol=0.12)


def test_an_outlier_is_refused_and_named() -> None:
    T = motion(8)
    target = transform_points(T, LANDMARKS) + 0.2 * np.random.default_rng(0).standard_normal(LANDMARKS.shape)
    target[4] += [0.0, 12.0, 5.0]
    assert register_landmarks(LANDMARKS, target).fiducial_registration_error_mm > 3.0
    result = register_landmarks(LANDMARKS, target, outlier_mm=3.0)
    assert np.flatnonzero(~result.used).tolist() == [4]
    assert result.fiducial_registration_error_mm < 0.6
    assert result.residuals_mm[4] == pytest.approx(13.0, abs=1.0)
    target[[0, 2]] += [9.0, 9.0, -14.0]
    with pytest.raises(RegistrationError, match="more than 2 of 7"):
        register_landmarks(LANDMARKS, target, outlier_mm=1.0)


def test_a_mirrored_side_is_refused() -> None:
    with pytest.raises(RegistrationError, match="LPS"):
        register_landmarks(LANDMARKS, LANDMARKS * [1, 1, -1])
    # both axes of RAS negated is a turn, not a mirror image: nobody can tell, and it fits
    assert register_landmarks(LANDMARKS, LANDMARKS * [-1, -1, 1]).fiducial_registration_error_mm < 1e-9


@pytest.mark.parametrize(
    ("source", "target", "error", "message"),
    [
        (LANDMARKS[:2], LANDMARKS[:2], RegistrationError, "at least 3"),
        (LANDMARKS, LANDMARKS[:5], InputError, "pairs"),
        (np.outer(np.arange(5.0), [1, 2, 3]), LANDMARKS[:5], RegistrationError, "one line"),
        (LANDMARKS[:5], np.ones((5, 3)), RegistrationError, "one line"),
        (LANDMARKS * np.nan, LANDMARKS, InputError, "NaN"),
        (LANDMARKS[:, :2], LANDMARKS, InputError, "shape"),
        ("abc", LANDMARKS, InputError, "numbers"),
    ],
)
def test_what_fixes_nothing_is_refused(source: object, target: object, error: type, message: str) -> None:
    with pytest.raises(error, match=message):
        register_landmarks(source, target)


@given(st.integers(0, 10_000))
def test_the_order_is_found(seed: int) -> None:
    generator = np.random.default_rng(seed)
    order = generator.permutation(len(LANDMARKS))
    target = transform_points(motion(seed), LANDMARKS) + 0.3 * generator.standard_normal(LANDMARKS.shape)
    found = match_landmarks(LANDMARKS, target[order])
    assert order[found].tolist() == list(range(len(LANDMARKS)))


def test_a_symmetric_arrangement_is_ambiguous() -> None:
    square = np.array([[0.0, 0, 0], [50, 0, 0], [50, 50, 0], [0, 50, 0]])
    with pytest.raises(RegistrationError, match="ambiguous"):
        match_landmarks(square, square)
    with pytest.raises(RegistrationError, match="no triangle"):
        match_landmarks(LANDMARKS, 25.4 * LANDMARKS)


class Ellipsoid:
    """A surface with an exact closest point (Newton on the multiplier), in the frame of its axes."""

    def __init__(self, *radii: float) -> None:
        self.radii = np.array(radii)

    def closest_point(self, points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        squares = self.radii**2
        multiplier = np.full(len(points), -0.5 * squares.min())
        low, high = -squares.min() * np.ones(len(points)) + 1e-9, np.full(len(points), 1e6)
        for _ in range(80):
            multiplier = 0.5 * (low + high)
            value = (squares * points**2 / (squares + multiplier[:, None]) ** 2).sum(axis=1) - 1.0
            low, high = np.where(value > 0, multiplier, low), np.where(value > 0, high, multiplier)
        closest = squares * points / (squares + multiplier[:, None])
        distance = np.linalg.norm(points - closest, axis=1)
        inside = ((points / self.radii) ** 2).sum(axis=1) < 1.0
        return closest, np.where(inside, -distance, distance)


def digitised(shape: Ellipsoid, n: int, seed: int, noise_mm: float) -> np.ndarray:
    generator = np.random.default_rng(seed)
    directions = generator.standard_normal((n, 3))
    points = shape.radii * directions / np.linalg.norm(directions, axis=1)[:, None]
    return points + noise_mm * generator.standard_normal((n, 3))


@pytest.mark.parametrize(("noise_mm", "limit_mm"), [(0.0, 0.05), (0.3, 0.4)])
def test_surface_points_find_their_place(noise_mm: float, limit_mm: float) -> None:
    shape = Ellipsoid(60.0, 42.0, 30.0)
    T = motion(5)
    truth = digitised(shape, 150, 2, noise_mm)
    points = transform_points(invert(T), truth)
    start = np.eye(4)
    start[:3, :3] = Rotation.from_rotvec([0.1, -0.12, 0.08]).as_matrix()
    start[:3, 3] = [5.0, -4.0, 3.0]
    result = register_surface(points, shape, start @ T)
    assert result.converged
    miss = transform_points(result.T_target_source, points) - truth
    assert np.sqrt((miss**2).sum(axis=1).mean()) < limit_mm
    assert result.rms_mm < max(noise_mm, 0.02)


def test_trimming_keeps_strays_out() -> None:
    shape = Ellipsoid(60.0, 42.0, 30.0)
    truth = digitised(shape, 200, 4, 0.2)
    truth[:15] *= 1.3
    result = register_surface(truth, shape, np.eye(4), trim=0.1)
    assert not result.used[:15].any()
    assert rotation_angle_rad(result.T_target_source) < np.deg2rad(0.3)
    assert np.linalg.norm(result.T_target_source[:3, 3]) < 0.1
    untrimmed = register_surface(truth, shape, np.eye(4), trim=0.0)
    assert np.linalg.norm(untrimmed.T_target_source[:3, 3]) > np.linalg.norm(result.T_target_source[:3, 3])


def test_a_sphere_leaves_its_turn_free() -> None:
    ball, egg = Ellipsoid(40.0, 40.0, 40.0), Ellipsoid(60.0, 42.0, 30.0)
    free = register_surface(digitised(ball, 100, 1, 0.3), ball, np.eye(4))
    fixed = register_surface(digitised(egg, 100, 1, 0.3), egg, np.eye(4))
    assert free.weakest_mm > 100.0 > 10.0 > fixed.weakest_mm


def test_surface_registration_refuses_nonsense() -> None:
    egg = Ellipsoid(60.0, 42.0, 30.0)
    with pytest.raises(RegistrationError, match="at least 6"):
        register_surface(np.eye(3), egg, np.eye(4))
    with pytest.raises(InputError, match="trim"):
        register_surface(digitised(egg, 10, 0, 0), egg, np.eye(4), trim=1.0)
    with pytest.raises(InputError, match="T_target_source"):
        register_surface(digitised(egg, 10, 0, 0), egg, 2.0 * np.eye(4))


def test_points_on_an_organ_find_its_shape() -> None:
    """The real thing: digitised points against an `hhsr.Shape` and its own closest point."""
    half_axes = np.array([60.0, 52.0, 42.0, 42.0, 30.0, 24.0])
    leaf = ModelLeaf(np.zeros(3), np.zeros(0), Superquadric(half_axes), ScaleField.none())
    shape = Shape(Tree(leaf, np.zeros(6)))
    generator = np.random.default_rng(6)
    directions = generator.standard_normal((120, 3))
    truth = (
        directions
        / np.linalg.norm(directions / np.where(directions > 0, half_axes[::2], half_axes[1::2]), axis=1)[:, None]
    )
    assert np.abs(shape.signed_distance(truth)).max() < 0.03
    truth += 0.2 * generator.standard_normal(truth.shape)
    T = motion(9)
    points = transform_points(invert(T), truth)
    start = np.eye(4)
    start[:3, :3] = Rotation.from_rotvec([0.08, -0.06, 0.1]).as_matrix()
    start[:3, 3] = [3.0, -2.0, 2.0]
    result = register_surface(points, shape, start @ T)
    assert result.converged
    miss = transform_points(result.T_target_source, points) - truth
    assert np.sqrt((miss**2).sum(axis=1).mean()) < 0.4
    assert result.rms_mm < 0.2
