"""Contours of cuts, and superquadrics by Levenberg–Marquardt, on shapes whose answer is known."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hhsr.evaluate import contour_radius
from hhsr.fitting.contour import Lobe, fit_contour, inside_loop, loop_area, star_centre
from hhsr.fitting.superquadric import Start, fit_superquadric, norm_gradients
from hhsr.kernels.spline import clamped_coefficients, periodic_coefficients
from hhsr.kernels.superquadric import superquadric_norm
from hhsr.model import fibonacci_sphere

ANGLES = np.linspace(-math.pi, math.pi, 300, endpoint=False)
CIRCLE = np.stack([np.cos(ANGLES), np.sin(ANGLES)], axis=1)


@given(st.tuples(*[st.floats(5.0, 40.0)] * 4))
@settings(max_examples=30, deadline=None)
def test_quadrants_of_ellipses_come_back(half_axes: tuple[float, ...]) -> None:
    chosen = np.where(CIRCLE >= 0, np.array(half_axes)[[0, 2]], np.array(half_axes)[[1, 3]])
    radius = 1.0 / np.sqrt(((CIRCLE / chosen) ** 2).sum(axis=1))
    loop = np.array([3.0, -2.0]) + radius[:, None] * CIRCLE
    contour = fit_contour(Lobe(loop, np.ones(300, dtype=bool)), np.array([3.0, -2.0]), 0.5)
    assert contour is not None
    assert np.abs(contour_radius(contour, ANGLES) - radius).mean() < 0.5


def test_a_waved_loop_needs_weights_and_meets_its_goal() -> None:
    radius = 20.0 + 2.0 * np.cos(3 * ANGLES) + np.sin(5 * ANGLES)
    contour = fit_contour(Lobe(radius[:, None] * CIRCLE, np.ones(300, dtype=bool)), np.zeros(2), 0.1)
    assert contour is not None
    assert contour.weights.size > 0
    assert np.abs(contour_radius(contour, ANGLES) - radius).mean() <= 0.1


def test_an_arc_is_followed_where_it_is_seen_and_stays_sane_elsewhere() -> None:
    radius = 20.0 + 2.0 * np.cos(3 * ANGLES)
    seen = ANGLES > 0
    contour = fit_contour(Lobe(radius[:, None] * CIRCLE, seen), np.zeros(2), 0.2)
    assert contour is not None
    fitted = contour_radius(contour, ANGLES)
    assert np.abs(fitted - radius)[seen].mean() <= 0.2
    assert fitted.min() > 1.0
    assert fitted.max() < 80.0


def test_too_few_points_give_no_contour() -> None:
    assert fit_contour(Lobe(CIRCLE[:5], np.ones(5, dtype=bool)), np.zeros(2), 0.1) is None


def test_star_centre_sees_a_banana_less_than_a_disc() -> None:
    disc = 10.0 * CIRCLE
    centre, hidden = star_centre([disc, 8.0 * CIRCLE], disc)
    assert hidden == 0.0
    assert np.hypot(*centre) < 3.0
    outer, inner = ANGLES[ANGLES > -1.5], ANGLES[ANGLES > -1.5][::-1]
    banana = np.concatenate(
        [
            10.0 * np.stack([np.cos(outer), np.sin(outer)], axis=1),
            7.0 * np.stack([np.cos(inner), np.sin(inner)], axis=1),
        ]
    )
    assert star_centre([banana], banana)[1] > 0.1
    assert inside_loop(disc, np.array([[0.0, 0.0], [11.0, 0.0]])).tolist() == [True, False]
    assert loop_area(disc) == pytest.approx(100.0 * math.pi, rel=1e-3)


def test_norm_and_its_derivatives_are_the_kernels() -> None:
    random = np.random.default_rng(1)
    points = random.normal(size=(40, 3))
    axes, azimuth, elevation = np.exp(0.3 * random.normal(size=6)), random.normal(size=4), random.normal(size=3)
    norm, by_point, by_axes, by_azimuth, by_elevation = norm_gradients(points, axes, azimuth, elevation)
    exact = [
        superquadric_norm(*p, axes, periodic_coefficients(azimuth), clamped_coefficients(elevation)) for p in points
    ]
    assert np.allclose(norm, exact, atol=1e-8)
    step = 1e-6

    def slope(move: int, change: np.ndarray) -> np.ndarray:
        arguments = [points, np.log(axes), azimuth, elevation]
        sides = []
        for sign in (1.0, -1.0):
            moved = list(arguments)
            moved[move] = arguments[move] + sign * step * change
            sides.append(norm_gradients(moved[0], np.exp(moved[1]), moved[2], moved[3])[0])
        return np.asarray((sides[0] - sides[1]) / (2 * step))

    for i in range(3):
        assert np.allclose(by_point[:, i], slope(0, np.eye(3)[i]), atol=1e-5)
    for i in range(6):
        assert np.allclose(by_axes[:, i], slope(1, np.eye(6)[i]), atol=1e-5)
    for i in range(4):
        assert np.allclose(by_azimuth[:, i], slope(2, np.eye(4)[i]), atol=1e-5)
    for i in range(3):
        assert np.allclose(by_elevation[:, i], slope(3, np.eye(3)[i]), atol=1e-5)


def test_an_ellipsoid_of_six_half_axes_comes_back() -> None:
    axes = np.array([30.0, 22.0, 18.0, 25.0, 12.0, 15.0])
    directions = fibonacci_sphere(400)
    chosen = np.where(directions >= 0, axes[::2], axes[1::2])
    points = directions / np.sqrt(((directions / chosen) ** 2).sum(axis=1))[:, None] + np.array([5.0, 6.0, 7.0])
    fit = fit_superquadric(points, Start(np.array([5.0, 6.0, 7.0]), np.zeros(3)), rotate=False, leash=1e3)
    assert fit.rms_mm < 0.3
    assert np.allclose(fit.superquadric.half_axes, axes, rtol=0.05)


@pytest.mark.parametrize("numbers", [6, 8, 12, 20])
def test_knots_keep_to_what_they_may_take(numbers: int) -> None:
    directions = fibonacci_sphere(300)
    points = directions / np.abs(directions).max(axis=1, keepdims=True) * 20.0
    fit = fit_superquadric(points, Start(np.zeros(3), np.zeros(3)), most_numbers=numbers)
    assert fit.superquadric.parameters <= numbers
    if numbers >= 8:
        bare = fit_superquadric(points, Start(np.zeros(3), np.zeros(3)), knots=False)
        assert fit.rms_mm < 0.7 * bare.rms_mm
