"""F and its change along a line, from those of the scale field."""

from __future__ import annotations

import numpy as np
import pytest

from hhsr.kernels.along import excess_of, ray_along


def test_f_and_its_change_are_those_of_the_formula() -> None:
    """F = N/(1 − s), with a change of s that is told: against its difference a little farther on."""
    rng = np.random.default_rng(3)
    for _ in range(20):
        half_axes, s, ds = rng.uniform(20.0, 60.0, 6), rng.uniform(-0.3, 0.3), rng.normal() * 0.1
        place, way = rng.normal(size=(2, 3)) * 40
        unit, tangent = ray_along(*place, *way)
        assert np.dot(unit, tangent) == pytest.approx(0.0, abs=1e-9)
        f, change = excess_of(half_axes, 0, *place, *way, s, ds)
        sides = np.where(place > 0.0, half_axes[::2], half_axes[1::2])
        norms = [np.sqrt(np.sum(((place + step * way) / sides) ** 2)) for step in (0.0, 1e-6, -1e-6)]
        assert f == pytest.approx(norms[0] / (1.0 - s) - 1.0, abs=1e-12)
        ahead, behind = norms[1] / (1.0 - s - 1e-6 * ds), norms[2] / (1.0 - s + 1e-6 * ds)
        assert change == pytest.approx((ahead - behind) / 2e-6, abs=1e-6)
