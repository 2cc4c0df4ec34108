"""Charts, intervals, polygons and proven ranges: sampled values never leave what is claimed of them."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hhsr.kernels import cell, interval, norm_bounds, polygon
from hhsr.kernels.spline import clamped_coefficients, exponent_and_slope, periodic_coefficients
from hhsr.kernels.superquadric import superquadric_norm
from tests.kernels.small_solids import arithmetic_of_c  # noqa: F401

AXES = np.array([10.0, 8.0, 7.0, 9.0, 8.5, 6.5])
PLAIN = np.zeros((0, 4))


def room(corners: list[list[float]]) -> tuple[np.ndarray, int]:
    out = np.zeros((polygon.ROOM, 3))
    out[: len(corners)] = corners
    return out, len(corners)


def test_intervals_hold_products_and_widen() -> None:
    rng = np.random.default_rng(0)
    for a, b in rng.normal(size=(20, 2, 2)):
        a, b = np.sort(a), np.sort(b)
        lo, hi = interval.product(*a, *b)
        corners = np.outer(a, b)
        assert (lo, hi) == (corners.min(), corners.max())
    assert interval.signed(-1.0, 3.0, 1.0) == (-1.0, 3.0)
    assert interval.signed(-1.0, 3.0, -1.0) == (-3.0, 1.0)
    lo, hi = interval.widened(-1.0, 2.0)
    assert lo < -1.0
    assert hi > 2.0
    assert hi - lo < 3.0 + 1e-9


def test_charts_invert_on_every_face() -> None:
    points = np.random.default_rng(1).normal(size=(60, 3))
    seen = set()
    for p in points:
        face, a, b, m = cell.face_of(*p)
        seen.add(face)
        assert m == np.abs(p).max()
        assert max(abs(a), abs(b)) <= 1.0
        np.testing.assert_allclose(m * np.array(cell.direction_of(face, a, b)), p, rtol=1e-14)
        np.testing.assert_allclose(cell.chart_of(face, *p), (a, b, m), rtol=1e-14)
        assert 0 <= cell.block_of(face, a, b) - 64 * face < 64
    assert seen == set(range(6))
    assert cell.block_of(0, -1.0, -1.0) == 0
    assert cell.block_of(5, 1.0, 1.0) == 6 * 64 - 1


def test_clipping_a_square() -> None:
    square = [[0.0, 0, 0], [2, 0, 0], [2, 2, 0], [0, 2, 0]]
    spare = np.empty((polygon.ROOM, 3))
    corners, count = room(square)
    assert polygon.clip_polygon(corners, count, spare, 1.0, 0.0, 0.0, 3.0) == 4
    np.testing.assert_array_equal(corners[:4], square)
    assert polygon.clip_polygon(corners, 4, spare, 1.0, 0.0, 0.0, -1.0) == 0
    assert polygon.clip_polygon(corners, 4, spare, 1.0, 1.0, 0.0, 3.0) == 5  # a corner is cut off
    x, y = corners[:5, 0], corners[:5, 1]
    area = 0.5 * abs(np.dot(x, np.roll(y, 1)) - np.dot(y, np.roll(x, 1)))
    assert area == pytest.approx(3.5)
    assert (x + y <= 3.0 + 1e-12).all()


def test_segments_to_segments_by_search() -> None:
    rng = np.random.default_rng(2)
    t = np.linspace(0, 1, 201)
    for k in range(40):
        p, d, a, b = rng.normal(size=(4, 3)) * [[2.0], [1.0], [1.0], [1.0]]
        if k % 5 == 0:
            d = np.zeros(3)
        if k % 7 == 0:
            b = np.zeros(3)
        if k % 11 == 10:
            b = 2.0 * d
        d2, u, v = polygon.segment_to_segment(*p, *d, *a, *b)
        gaps = (p + t[:, None] * d)[:, None] - (a + t[:, None] * b)[None]
        best = (gaps**2).sum(axis=2).min()
        assert d2 == pytest.approx(((p + u * d - a - v * b) ** 2).sum(), abs=1e-12)
        assert best - 0.02 * (math.sqrt(best) + 0.02) <= d2 <= best + 1e-12
        assert 0 <= u <= 1
        assert 0 <= v <= 1


def test_segments_to_polygons_by_search() -> None:
    corners = np.array([[0.0, 0, 1], [3, 0, 1], [3, 2, 1], [0, 2, 1]])
    share = np.linspace(0, 1, 61)
    grid = np.stack(np.meshgrid(3 * share, 2 * share, [1.0]), axis=-1).reshape(-1, 3)
    rng = np.random.default_rng(3)
    for k in range(40):
        p, d = rng.uniform(-3, 5, 3), rng.normal(size=3) * 3.0
        if k % 4 == 0:
            d = np.zeros(3)
        if k % 4 == 1:
            d[2] = 0.0
        full, count = room(corners.tolist())
        distance, t, *q = polygon.polygon_to_segment(full, count, 0.0, 0.0, 1.0, *p, *d)
        along = p + share[:, None] * d
        best = np.sqrt(((along[:, None] - grid[None]) ** 2).sum(axis=2).min())
        assert distance <= best + 1e-9
        assert distance >= best - 0.2
        assert distance == pytest.approx(np.linalg.norm(p + t * d - q), abs=1e-9)
        assert (np.array(q) >= [-1e-9, -1e-9, 1 - 1e-9]).all()
        assert (np.array(q) <= [3 + 1e-9, 2 + 1e-9, 1 + 1e-9]).all()


def test_exponents_stay_in_their_range() -> None:
    rng = np.random.default_rng(4)
    for coefficients in (periodic_coefficients(rng.normal(size=5)), clamped_coefficients(rng.normal(size=4) * 3.0)):
        for _ in range(10):
            s0, s1 = np.sort(rng.random(2))
            lo, hi, slope_lo, slope_hi = norm_bounds.exponent_range(coefficients, s0, s1)
            found = np.array([exponent_and_slope(coefficients, s) for s in np.linspace(s0, s1, 40)])
            assert (found[:, 0] >= lo - 1e-12).all()
            assert (found[:, 0] <= hi + 1e-12).all()
            assert (found[:, 1] >= slope_lo - 1e-9).all()
            assert (found[:, 1] <= slope_hi + 1e-9).all()


@pytest.mark.parametrize("knots", [False, True])
def test_the_norm_and_its_gradient_stay_in_their_ranges(knots: bool) -> None:
    rng = np.random.default_rng(5)
    azimuth = periodic_coefficients(np.array([1.5, -1.0, 0.5, 0.2])) if knots else PLAIN
    elevation = clamped_coefficients(np.array([0.5, -0.7, 0.4])) if knots else PLAIN
    for k in range(24):
        low = rng.uniform(0.05, 0.9, 3)
        if k % 4 == 0:
            low[k % 3] = 0.0  # against a coordinate plane
        if k % 8 == 7:
            low[:2] = 0.0  # against a pole
        high = low + rng.uniform(0.01, 0.1, 3)
        signs = rng.choice([-1.0, 1.0], 3)
        box = [v for pair in zip(low, high, strict=True) for v in pair]
        with np.errstate(all="ignore"):
            found = norm_bounds.norm_range(*box, *signs, AXES, azimuth, elevation)
        for p in rng.uniform(low + 1e-4, high - 1e-4, (20, 3)):
            at = superquadric_norm(*(signs * p), AXES, azimuth, elevation)
            assert found[0] * (1 - 1e-11) <= at <= found[1] * (1 + 1e-11)
            for axis in range(3):
                h = 1e-6 * np.eye(3)[axis]
                ahead = superquadric_norm(*(signs * p + h), AXES, azimuth, elevation)
                back = superquadric_norm(*(signs * p - h), AXES, azimuth, elevation)
                rate = (ahead - back) / 2e-6
                assert found[2 + 2 * axis] - 1e-6 <= rate <= found[3 + 2 * axis] + 1e-6
