"""The compiled bounds hold: sampled values never leave what was proven, on every kind of leaf."""

from __future__ import annotations

import numpy as np
import pytest

from hhsr.compiled import compile_tree
from hhsr.evaluate import leaf_radius
from hhsr.kernels import layout as at
from hhsr.kernels.cell import cell_model, direction_of, face_of
from hhsr.kernels.layout import integers, tables
from hhsr.kernels.maps import cell_at, spreads_of
from hhsr.model import CentreGrid, ModelLeaf, ScaleField, Superquadric, Tree, frozen
from tests.strategies import random_leaf


def spiky_leaf(rng: np.random.Generator) -> ModelLeaf:
    """Return a leaf as real fits make them: fine centres, large weights, and the cap of 0.95 in places."""
    grid = CentreGrid((30, 190, 1200, 8000), 2.5)
    index = np.sort(rng.choice(grid.size, 300, replace=False))
    return ModelLeaf(
        frozen(np.zeros(3)),
        frozen([]),
        Superquadric(frozen(rng.uniform(40, 110, 6))),
        ScaleField(grid, frozen(index, np.int64), frozen(rng.normal(size=300) * 0.6)),
    )


def leaves() -> list[ModelLeaf]:
    rng = np.random.default_rng(5)
    plain = [random_leaf(rng, np.zeros(3)) for _ in range(4)]
    knots = Superquadric(frozen(rng.uniform(20, 50, 6)), frozen(rng.normal(size=5) * 4), frozen(rng.normal(size=6) * 4))
    return [*plain, spiky_leaf(rng), ModelLeaf(frozen(np.zeros(3)), frozen([]), knots, ScaleField.none())]


def inverse_radii(leaf: ModelLeaf, directions: np.ndarray) -> np.ndarray:
    return np.sqrt((directions**2).sum(axis=1)) / leaf_radius(leaf, directions)


@pytest.mark.parametrize("leaf", leaves())
def test_every_cell_of_the_map_holds_what_it_promises(leaf: ModelLeaf) -> None:
    blob = compile_tree(Tree(leaf, frozen(np.zeros(6)))).blob
    ints, tab = integers(blob), tables(blob)
    record = ints[ints[at.OWNER_INTS] + at.OWNER_RECORD]
    rng = np.random.default_rng(1)
    count = 20_000
    face, u, v = rng.integers(6, size=count), *rng.uniform(-1, 1, (2, count))
    a, b = rng.uniform(-1, 1, (2, count))
    found = [cell_at(ints, record, f, x, y) for f, x, y in zip(face, a, b, strict=True)]
    slot = np.array([f[0] for f in found])
    ca, cb, half = np.array([f[1:] for f in found]).T
    assert (np.maximum(np.abs(a - ca), np.abs(b - cb)) <= half * (1 + 1e-9)).all()
    u[:4000], v[2000:6000] = np.sign(u[:4000]), np.sign(v[2000:6000])  # edges and corners of cells, poles, seams
    a, b = ca + half * u, cb + half * v
    directions = np.array([direction_of(f, x, y) for f, x, y in zip(face, a, b, strict=True)])
    exact = inverse_radii(leaf, directions)
    cell = tab[slot[:, None] + np.arange(at.CELL_SIZE)].astype(np.float64)
    guess = cell[:, at.VALUE] + cell[:, at.SLOPE_A] * half * u + cell[:, at.SLOPE_B] * half * v
    assert (np.abs(exact - guess) <= cell[:, at.ERROR]).all()
    assert (cell[:, at.KINK] >= 0).all()
    assert (cell[:, at.THIRD] >= 0).all()
    # The slopes' spread, by differences along both axes within the cell.
    spreads = np.array([spreads_of(tab, o, h) for o, h in zip(slot, half, strict=True)])
    for axis, slope in ((0, at.SLOPE_A), (1, at.SLOPE_B)):
        step = 1e-4 * half
        sign = -np.sign(u if axis == 0 else v)
        other = np.array(
            [
                direction_of(f, x + d * (axis == 0), y + d * (axis == 1))
                for f, x, y, d in zip(face, a, b, step * sign, strict=True)
            ]
        )
        rate = (inverse_radii(leaf, other) - exact) / (step * sign)
        noise = 1e-13 / step * exact
        assert (np.abs(rate - cell[:, slope]) <= spreads[:, axis] + noise + 1e-9 * np.abs(rate)).all()


@pytest.mark.parametrize("half", [0.1, 1e-2, 1e-4, 1e-7])
def test_models_of_any_rectangle_hold(half: float) -> None:
    rng = np.random.default_rng(3)
    for leaf in leaves():
        blob = compile_tree(Tree(leaf, frozen(np.zeros(6)))).blob
        ints = integers(blob)
        record = ints[ints[at.OWNER_INTS] + at.OWNER_RECORD]
        for k in range(40):
            face = int(rng.integers(6))
            block = rng.integers(8, size=2)
            ca, cb = (
                -1 + (block + rng.uniform(0.5, 0.5, 2)) / 4
                if half > 0.05
                else -1 + (block + rng.uniform(0.1, 0.9, 2)) / 4
            )
            by_ranges = np.bool_(k % 2 == 0)
            value, ga, gb, error, _, _, low, high = cell_model(blob, ints, record, face, ca, cb, half, half, by_ranges)[
                :8
            ]
            da, db = half * rng.uniform(-1, 1, (2, 30))
            directions = np.array([direction_of(face, ca + x, cb + y) for x, y in zip(da, db, strict=True)])
            exact = inverse_radii(leaf, directions)
            assert (np.abs(exact - value - ga * da - gb * db) <= error + 1e-14 * exact).all()
            assert (exact >= low * (1 - 1e-14)).all()
            assert (exact <= high * (1 + 1e-14)).all()


def test_the_chart_of_a_direction_inverts() -> None:
    rng = np.random.default_rng(0)
    for p in rng.normal(size=(200, 3)):
        face, a, b, m = face_of(*p)
        np.testing.assert_allclose(m * np.array(direction_of(face, a, b)), p, rtol=1e-15)
        assert max(abs(a), abs(b)) <= 1
