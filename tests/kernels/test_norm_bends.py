"""Second derivatives of the norm with exponents: by differences, and never out of their ranges over a box."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from hhsr.kernels.norm_bends import norm_bends
from hhsr.kernels.p_norm_bends import p_norm_bends
from hhsr.kernels.spline import clamped_coefficients, periodic_coefficients
from hhsr.kernels.superquadric import p_norm, superquadric_norm
from tests.kernels.small_solids import arithmetic_of_c  # noqa: F401

AXES = np.array([10.0, 8.0, 7.0, 9.0, 8.5, 6.5])
NONE = np.zeros((0, 4))
AZIMUTH = periodic_coefficients(np.array([-0.2, -1.0, 1.1, -0.5, 0.0, -0.8]))
ELEVATION = clamped_coefficients(np.array([-0.6, -1.3, 1.3, -0.2]))
EXPONENTS = {
    "both": (AZIMUTH, ELEVATION), "azimuth": (AZIMUTH, NONE), "elevation": (NONE, ELEVATION), "none": (NONE, NONE),
    "constant": (periodic_coefficients(np.array([-0.7])), clamped_coefficients(np.array([0.9]))),
}  # fmt: skip


def differences(f: Any, *at: float, step: float = 1e-4) -> list[float]:
    """Return the value, first and second derivatives of a function, the second row by row of the upper triangle."""
    n, unit = len(at), np.eye(len(at)) * step
    here = np.array(at)
    first = [(f(*(here + e)) - f(*(here - e))) / (2 * step) for e in unit]
    second = [
        (f(*(here + p + q)) - f(*(here + p - q)) - f(*(here - p + q)) + f(*(here - p - q))) / (4 * step**2)
        for i, p in enumerate(unit)
        for q in unit[i:]
    ]
    assert len(second) == n * (n + 1) // 2
    return [f(*at), *first, *second]


def part(rng: np.random.Generator, size: float, low: float) -> tuple[float, float]:
    """Return a range of [0, 1], now and then from 0 on."""
    start = 0.0 if rng.random() < 0.2 and low == 0.0 else rng.uniform(low, 1)
    return start, start + size * rng.random() + 1e-9


def test_a_p_norms_derivatives_by_differences() -> None:
    rng = np.random.default_rng(0)
    for _ in range(60):
        x, y, k = *rng.uniform(0.05, 1, 2), rng.uniform(1.1, 6)
        m, mx, my, mk, mxx, mxy, myy, mxk, myk, mkk = p_norm_bends((x, x), (y, y), (k, k))
        found = [m, mx, my, mk, mxx, mxy, mxk, myy, myk, mkk]
        assert all(lo == hi for lo, hi in found)
        expected = differences(lambda a, b, c: p_norm(a, b, 2.0 / c), x, y, k)
        np.testing.assert_allclose([lo for lo, _ in found], expected, rtol=2e-4, atol=2e-5)


def test_a_p_norms_derivatives_keep_to_their_ranges() -> None:
    """Coordinate planes too: only ∂² across one may be infinite there, and only where the exponent says so."""
    rng = np.random.default_rng(1)
    for _ in range(150):
        size = 10 ** rng.uniform(-4, -0.5)
        x, y, start = part(rng, size, 0.0), part(rng, size, 0.02), rng.uniform(1.06, 5)
        if rng.random() < 0.5:
            x, y = y, x
        k = (start, start + size * rng.random())
        ranges = p_norm_bends(x, y, k)
        for i, (lo, hi) in enumerate(ranges):
            assert lo <= hi
            singular = i in (4, 6) and k[0] < 2.0 and (x if i == 4 else y)[0] == 0.0
            assert math.isfinite(lo)
            assert math.isfinite(hi) or singular
        for share in [*rng.random((6, 3)), *rng.integers(2, size=(4, 3))]:
            point = [p[0] + s * (p[1] - p[0]) for p, s in zip((x, y, k), share, strict=True)]
            if max(point[:2]) == 0.0:
                continue
            for (a, b), (lo, hi) in zip(p_norm_bends(*((p, p) for p in point)), ranges, strict=True):
                slack = 1e-10 * (1.0 + abs(a)) if math.isfinite(a) else 0.0
                assert lo - slack <= a <= b <= hi + slack


def box_of(face: int, a: float, b: float, half: float) -> tuple[Any, ...]:
    """Return |x|, |y|, |z| as ranges, and their signs, of the square about (a, b) of a face."""
    m = (1.0 if face % 2 == 0 else -1.0), (1.0, 1.0)
    pa, pb = ((math.copysign(1.0, c), (max(abs(c) - half, 0.0), abs(c) + half)) for c in (a, b))
    x, y, z = ((m, pa, pb), (pb, m, pa), (pa, pb, m))[face // 2]
    return x[1], y[1], z[1], x[0], y[0], z[0]


@pytest.mark.parametrize("kind", EXPONENTS)
def test_the_norms_second_derivatives(kind: str) -> None:
    """By differences at points of all faces; over squares, by coordinate planes too, they are in their ranges."""
    rng = np.random.default_rng(2)
    azimuth, elevation = EXPONENTS[kind]
    close, known = [], 0
    for _ in range(60):
        face, half = int(rng.integers(6)), 0.5 ** int(rng.integers(5, 9))
        a, b = (2 * rng.integers(0, int(1 / half), 2) + 1) * half - 1.0

        def norm(u: float, v: float, face: int = face) -> float:
            m = 1.0 if face % 2 == 0 else -1.0
            return superquadric_norm(*((m, u, v), (v, m, u), (u, v, m))[face // 2], AXES, azimuth, elevation)

        found = norm_bends(*box_of(face, a, b, 0.0), AXES, azimuth, elevation, face)
        expected = differences(norm, a, b)[1:]
        exact = np.array([lo for lo, _ in found])
        np.testing.assert_allclose(exact, expected, rtol=1e-2 if half < 0.005 else 3e-3, atol=1e-4)
        ranges = np.array(norm_bends(*box_of(face, a, b, half), AXES, azimuth, elevation, face))
        if not np.isfinite(ranges).all():
            assert kind != "none"
            continue
        known += 1
        inside = []
        for u, v in half * rng.uniform(-1, 1, (8, 2)):
            inner = np.array(norm_bends(*box_of(face, a + u, b + v, 0.0), AXES, azimuth, elevation, face))
            slack = 1e-10 * (1.0 + np.abs(inner))
            assert (inner >= ranges[:, :1] - slack).all()
            assert (inner <= ranges[:, 1:] + slack).all()
            inside.append(inner[:, 0])
        close.append(np.ptp(ranges, axis=1) / np.maximum(np.ptp(inside, axis=0), 1e-9))
    assert known > 45
    assert (np.median(close, axis=0) < 40.0).all()
