"""Comparators: exact where they can be, within their budget, measured by the same rule as a fit."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.special import sph_harm_y

import hhsr
from hhsr.baselines import METHODS, fit_baseline
from hhsr.baselines.compare import Row, draw
from hhsr.baselines.distances import mesh_error
from hhsr.baselines.spherical_harmonics import harmonics
from hhsr.errors import FitError, InputError


@pytest.fixture(scope="module")
def bean() -> hhsr.Surface:
    """Return a smooth, star-shaped, lopsided body of some 40 mm."""
    body = trimesh.creation.icosphere(subdivisions=4, radius=16.0)
    x, y, z = body.vertices.T
    vertices = np.stack([1.3 * x + 0.01 * x * x, 0.9 * y, 0.7 * z + 0.008 * x * y + 0.012 * y * y], axis=1)
    return hhsr.Surface.from_mesh(vertices, body.faces)


def test_harmonics_are_those_of_scipy() -> None:
    directions = np.random.default_rng(0).normal(size=(50, 3))
    directions /= np.linalg.norm(directions, axis=1, keepdims=True)
    found = harmonics(directions, 6)
    polar, azimuth = np.arccos(directions[:, 2]), np.arctan2(directions[:, 1], directions[:, 0])
    for order in range(7):
        for m in range(-order, order + 1):
            complex_value = sph_harm_y(order, abs(m), polar, azimuth) * (-1.0) ** m
            wanted = complex_value.real if m >= 0 else complex_value.imag
            wanted = wanted * (np.sqrt(2) if m else 1)
            assert np.allclose(found[:, order * order + order + m], wanted, atol=1e-12)


def test_the_distance_of_parallel_spheres() -> None:
    one, other = (trimesh.creation.icosphere(subdivisions=5, radius=r) for r in (20.0, 20.5))
    error = mesh_error(one.vertices, one.faces, other.vertices, other.faces, samples=2000)
    assert error.mean_mm == pytest.approx(0.5, rel=0.01)
    assert error.max_mm == pytest.approx(0.5, rel=0.02)
    nothing = mesh_error(one.vertices, one.faces[:0], other.vertices, other.faces)
    assert nothing.mean_mm > 40


@pytest.mark.parametrize("method", METHODS)
def test_a_comparator_keeps_its_budget_and_is_near(bean: hhsr.Surface, method: str) -> None:
    found = fit_baseline(method, bean, 160, 900)
    assert found.parameters <= (160 if method != "draco" else np.inf)
    if method == "draco":
        assert found.bytes <= 900
    surface = hhsr.Surface.from_mesh(found.vertices, found.faces)
    assert surface.quality.bodies == 1
    assert surface.quality.volume_ml == pytest.approx(bean.quality.volume_ml, rel=0.05)
    assert found.error(bean, samples=4000).mean_mm < 0.6
    again = fit_baseline(method, bean, 160, 900)
    assert np.array_equal(again.vertices, found.vertices)


@pytest.mark.parametrize("method", ["spherical_harmonics", "decimated_mesh", "rbf_isosurface"])
def test_more_numbers_smaller_errors(bean: hhsr.Surface, method: str) -> None:
    errors = [fit_baseline(method, bean, budget).error(bean, samples=4000).mean_mm for budget in (40, 120, 360)]
    assert all(after < 0.8 * before for before, after in pairwise(errors))


@pytest.mark.parametrize("method", ["spherical_harmonics", "decimated_mesh", "rbf_isosurface"])
def test_too_small_a_budget_is_refused(bean: hhsr.Surface, method: str) -> None:
    with pytest.raises(FitError, match="got 3"):
        fit_baseline(method, bean, 3)


def test_an_unknown_method_is_refused(bean: hhsr.Surface) -> None:
    with pytest.raises(InputError, match="spherical_harmonics"):
        fit_baseline("nurbs", bean, 300)


def test_the_picture_is_written(tmp_path: Path) -> None:
    rows = [Row(m, n, n, 4 * n, 30 / n, 60 / n, 200 / n, 1.0) for m in ("hhsr", "draco") for n in (100, 200)]
    draw(rows, tmp_path / "compare.png", "organ")
    assert (tmp_path / "compare.png").read_bytes()[:4] == b"\x89PNG"
