"""A band's strips: no sampled radius leaves its proven model, nor is the model much thicker than what it holds."""

from __future__ import annotations

import math
from functools import cache

import numpy as np
import pytest

from hhsr.compiled import Compiled
from hhsr.kernels import layout as at
from hhsr.kernels import slab as slab_at
from hhsr.kernels.slab import lobe_contour, lobe_radius
from hhsr.kernels.slab_bounds import STEP, lobe_model, lobe_range
from hhsr.model import Contour, Tree, frozen
from tests.kernels.small_solids import Z, arithmetic_of_c, ball, band, coarse  # noqa: F401

AXES = np.array([9.0, 6.0, 7.5, 8.0])
WAVES = np.array([0.05, -0.1, 0.02, 0.0, 0.08, 0.03, -0.06, 0.04])
KINDS = {
    "round": Contour(frozen([0.0, 0.0]), frozen(np.full(4, 6.0)), frozen([]), frozen([])),
    "wavy": Contour(frozen([0.4, -0.3]), frozen(AXES), frozen([]), frozen(WAVES)),
    "squarish": Contour(frozen([0.4, -0.3]), frozen(AXES), frozen([0.8, -1.2, 0.5]), frozen(WAVES)),
    "capped": Contour(frozen([0.0, 0.0]), frozen(AXES), frozen([]), frozen(30.0 * WAVES)),
}


@cache
def compiled_lobe(kind: str) -> tuple[Compiled, int]:
    """Return a compiled band with one lobe of a kind, and the lobe's record."""
    tree = Tree(band(Z, 0.0, 1.5, (KINDS[kind],), ball(8.0, (0.5, 0, -3)), ball(7.0, (0, 0.4, 3))), frozen(np.zeros(6)))
    compiled = coarse(tree).compiled
    ints = compiled.blob.view(np.int64)
    owners = [ints[at.OWNER_INTS] + at.OWNER_INT_SIZE * k for k in range(ints[at.OWNER_COUNT])]
    (slab,) = [ints[o + at.OWNER_RECORD] for o in owners if ints[o + at.OWNER_KIND] == at.SLAB]
    return compiled, int(ints[slab + slab_at.LOBES])


def pieces(rng: np.random.Generator, count: int) -> list[tuple[int, float, float, float, float]]:
    """Return (segment, angle, t, half, half_t) of pieces within one segment and [0, 1]: whole ones too."""
    out = []
    for k in range(count):
        segment = int(rng.integers(slab_at.TABLE))
        half, half_t = (0.5, 0.5) if k % 5 == 0 else (0.5 * rng.random() ** 2, 0.5 * rng.random() ** 2)
        x, t = rng.uniform(half, 1.0 - half), rng.uniform(half_t, 1.0 - half_t)
        out.append((segment, (segment + x) * STEP - math.pi, t, half * STEP, half_t))
    return out


@pytest.mark.parametrize("kind", KINDS)
def test_a_strips_model_holds_what_is_sampled(kind: str) -> None:
    compiled, lobe = compiled_lobe(kind)
    blob, ints, rng = compiled.blob, compiled.blob.view(np.int64), np.random.default_rng(3)
    ratios = []
    for segment, angle, t, half, half_t in pieces(rng, 60):
        value, slope_a, slope_t, error, low, high = lobe_model(blob, ints, lobe, segment, angle, t, half, half_t)
        found = lobe_range(blob, ints, lobe, angle - half, angle + half, t - half_t, t + half_t)
        worst = 0.0
        for da, dt in np.vstack([rng.uniform(-1, 1, (30, 2)), [[-1, -1], [-1, 1], [1, -1], [1, 1]]]):
            da, dt = da * half, dt * half_t
            r = lobe_radius(blob, ints, lobe, math.cos(angle + da), math.sin(angle + da), t + dt)
            if r == 0.0:
                assert low <= 1e-12
                continue
            away = abs(r - value - slope_a * da - slope_t * dt)
            assert away <= error + 1e-12
            assert low - 1e-12 <= r <= high + 1e-12
            assert found[0] - 1e-9 <= r <= found[1] + 1e-9
            worst = max(worst, away)
        ratios.append(error / max(worst, 1e-9))
    if kind in ("round", "wavy"):
        assert np.median(ratios) < 6.0


@pytest.mark.parametrize("kind", KINDS)
def test_a_contours_bend_is_bounded(kind: str) -> None:
    """By second differences; no bound where there are exponents, or where the field may be capped."""
    compiled, lobe = compiled_lobe(kind)
    blob, ints, rng = compiled.blob, compiled.blob.view(np.int64), np.random.default_rng(4)
    start = int(ints[lobe + slab_at.LOBE_SPHERES])
    most = blob[start : start + slab_at.ENCLOSURE * slab_at.TABLE].reshape(slab_at.TABLE, slab_at.ENCLOSURE)[:, 6]
    assert (most == np.inf).any() == (kind in ("squarish", "capped"))
    step, ratios = 1e-3, []
    for segment in rng.integers(slab_at.TABLE, size=60):
        if most[segment] == np.inf:
            continue
        angles = (segment + rng.uniform(0.05, 0.95, 20)) * STEP - math.pi
        c = [
            [lobe_contour(blob, ints, lobe, math.cos(x), math.sin(x)) for x in (a - step, a, a + step)] for a in angles
        ]
        bend = np.abs(np.array(c) @ [1.0, -2.0, 1.0]) / step**2
        assert (bend <= most[segment] * (1.0 + 1e-6) + 1e-6).all()
        ratios.append(most[segment] / max(float(bend.max()), 1e-3))
    if kind == "wavy":
        assert np.median(ratios) < 2.5
