"""The formulas of a leaf on tiny inputs, against closed forms, numpy and scipy; runs with and without the compiler."""

from __future__ import annotations

import math

import numpy as np
import pytest
from scipy.interpolate import CubicSpline

from hhsr.kernels.leaf import contour_radii, leaf_radii, leaf_radius, leaf_value
from hhsr.kernels.sphere_rbf import wendland_gaussian
from hhsr.kernels.spline import clamped_coefficients, exponent_and_slope, periodic_coefficients
from hhsr.kernels.superquadric import p_norm, superellipse_norm, superquadric_norm

NO_KNOTS = np.zeros((0, 4))
AXES = np.array([40.0, 35.0, 30.0, 28.0, 22.0, 25.0])
NO_CENTRES = (np.zeros((0, 3)), np.zeros(0), np.zeros(0))


def test_splines_are_those_of_scipy() -> None:
    values = np.array([0.3, -1.0, 0.7, 0.2, 0.9])
    periodic = CubicSpline(np.arange(6), np.append(values, values[0]), bc_type="periodic")
    np.testing.assert_allclose(periodic_coefficients(values)[:, ::-1].T, periodic.c, atol=1e-12)
    clamped = CubicSpline(np.arange(5), values, bc_type="clamped")
    np.testing.assert_allclose(clamped_coefficients(values)[:, ::-1].T, clamped.c, atol=1e-12)
    assert periodic_coefficients(values[:1]).tolist() == clamped_coefficients(values[:1]).tolist()
    assert clamped_coefficients(values[:2]).shape == (1, 4)
    with pytest.raises(ValueError, match="got 2"):
        periodic_coefficients(values[:2])


def test_exponent_is_one_without_knots_and_stays_in_range() -> None:
    assert exponent_and_slope(NO_KNOTS, 0.3) == (1.0, 0.0)
    steep = periodic_coefficients(np.array([300.0, -300.0, 300.0, -300.0]))
    shares = np.linspace(0, 1, 50)
    assert all(0.1 - 1e-15 <= exponent_and_slope(steep, s)[0] <= 1.9 for s in shares)
    smooth = periodic_coefficients(np.array([0.5, -0.5, 0.1, 0.0]))
    for s in (0.1, 0.37, 0.8):
        low, high = exponent_and_slope(smooth, s - 1e-6)[0], exponent_and_slope(smooth, s + 1e-6)[0]
        assert exponent_and_slope(smooth, s)[1] == pytest.approx((high - low) / 2e-6, rel=1e-5)


@pytest.mark.parametrize("exponent", [0.1, 0.5, 1.0, 1.9])
def test_p_norm_is_the_textbook_one(exponent: float) -> None:
    for x, y in ((3.0, 2.0), (2.0, 3.0), (1.0, 1e-30), (0.0, 2.0), (0.0, 0.0)):
        expected = (x ** (2 / exponent) + y ** (2 / exponent)) ** (exponent / 2)
        assert p_norm(x, y, exponent) == pytest.approx(expected, rel=1e-12)


def test_norm_is_homogeneous_and_knows_its_half_axes() -> None:
    azimuth = periodic_coefficients(np.array([0.5, -0.5, 0.1]))
    elevation = clamped_coefficients(np.array([0.4, -0.3, 0.2]))
    for axis, half in enumerate(AXES.reshape(3, 2)):
        for sign, length in ((1.0, half[0]), (-1.0, half[1])):
            point = np.zeros(3)
            point[axis] = sign * length
            assert superquadric_norm(*point, AXES, azimuth, elevation) == pytest.approx(1.0, abs=1e-12)
    once = superquadric_norm(3.0, -4.0, 5.0, AXES, azimuth, elevation)
    assert superquadric_norm(21.0, -28.0, 35.0, AXES, azimuth, elevation) == pytest.approx(7 * once, rel=1e-13)
    assert superquadric_norm(0.0, 0.0, 0.0, AXES, azimuth, elevation) == 0.0
    assert superellipse_norm(0.0, -28.0, AXES[:4], azimuth) == pytest.approx(1.0)


def test_ellipsoid_in_closed_form_and_value_zero_on_the_surface() -> None:
    directions = np.array([[1.0, 2.0, 2.0], [-1.0, 0.5, -2.0], [0.0, 0.0, 1.0]])
    signed = np.where(directions >= 0, AXES[::2], AXES[1::2])
    expected = np.linalg.norm(directions, axis=1) / np.sqrt(((directions / signed) ** 2).sum(axis=1))
    np.testing.assert_allclose(leaf_radii(directions, AXES, NO_KNOTS, NO_KNOTS, *NO_CENTRES), expected, rtol=1e-13)
    field = (np.array([[0.0, 0.6, 0.8]]), np.array([2.0]), np.array([0.2]))
    for d in directions / np.linalg.norm(directions, axis=1)[:, None]:
        rho = leaf_radius(*d, AXES, NO_KNOTS, NO_KNOTS, *field)
        assert leaf_value(*(rho * d), AXES, NO_KNOTS, NO_KNOTS, *field) == pytest.approx(0.0, abs=1e-12)
    assert leaf_value(0.0, 0.0, 0.0, AXES, NO_KNOTS, NO_KNOTS, *field) < 0


def test_scale_is_capped_so_that_the_radius_stays_positive() -> None:
    deep = (np.array([[0.0, 0.0, 1.0]]), np.array([1.0]), np.array([50.0]))
    assert leaf_radius(0.0, 0.0, 1.0, AXES, NO_KNOTS, NO_KNOTS, *deep) == pytest.approx(0.05 * AXES[4])
    assert wendland_gaussian(0.0) == 1.0
    assert wendland_gaussian(1.0) == wendland_gaussian(3.0) == 0.0
    assert wendland_gaussian(0.5) == pytest.approx(math.exp(-2) / 4)


def test_contour_is_the_leaf_one_dimension_down() -> None:
    angles = np.array([0.0, 1.0, -2.5, math.pi])
    plain = contour_radii(angles, AXES[:4], NO_KNOTS, np.zeros((0, 2)), 1.0, np.zeros(0))
    flat = np.stack([np.cos(angles), np.sin(angles), np.zeros(4)], axis=1)
    np.testing.assert_allclose(plain, leaf_radii(flat, AXES, NO_KNOTS, NO_KNOTS, *NO_CENTRES), rtol=1e-13)
    bumped = contour_radii(angles, AXES[:4], NO_KNOTS, np.array([[1.0, 0.0]]), 2.0, np.array([0.1]))
    assert bumped[0] == pytest.approx(0.9 * AXES[0])
    assert bumped[2] == plain[2]
