"""Centres chosen by greed against the slow, obvious way; the ellipsoid; one budget over leaves."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hhsr.evaluate import leaf_radius
from hhsr.fitting.rows import Rows
from hhsr.fitting.samples import turned_fibonacci
from hhsr.fitting.scale_field import (
    RIDGE,
    costs_of_dropping,
    dictionary,
    fit_ellipsoid,
    grid_for,
    leaf_of,
    select_centres,
)
from hhsr.fitting.spend import counts_within
from hhsr.kernels.refinement import ellipsoid_radii
from hhsr.model import CentreGrid, ModelLeaf, ScaleField, Superquadric, frozen, subset_numbers


def bumpy_rows(count: int, seed: int) -> tuple[Rows, np.ndarray]:
    """Rows of a bumpy ellipsoid about its centre, and the axes of the ellipsoid."""
    random = np.random.default_rng(seed)
    axes = random.uniform(10.0, 30.0, 6)
    directions = turned_fibonacci(count, seed)
    bumps = sum(a * np.cos(directions @ random.normal(0.0, 3.0, 3)) for a in (0.05, 0.03, 0.02))
    radii = ellipsoid_radii(axes, directions) * (1.0 + bumps)
    return Rows(directions, radii, random.uniform(0.2, 1.0, count), np.zeros(count, dtype=bool)), axes


def dense_dictionary(grid: CentreGrid, directions: np.ndarray) -> np.ndarray:
    """(n, M) of λ, one by one from the formula."""
    h = (1.0 - directions @ grid.centres.T) / grid.extents
    return np.where(h < 1.0, np.exp(-4.0 * h) * (1.0 - h) ** 2, 0.0)


@pytest.mark.parametrize("sizes", [(20,), (20, 300), (7, 31, 2000)])
def test_sparse_rows_of_the_dictionary_are_the_formula(sizes: tuple[int, ...]) -> None:
    grid = CentreGrid(sizes, 3.3)
    poles = [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]]
    directions = np.vstack([turned_fibonacci(200, 2), poles])
    pointer, index, value = dictionary(grid, directions)
    dense = np.zeros((directions.shape[0], grid.size))
    for i in range(directions.shape[0]):
        dense[i, index[pointer[i] : pointer[i + 1]]] = value[pointer[i] : pointer[i + 1]]
    assert np.abs(dense - dense_dictionary(grid, directions)).max() < 1e-7


def slow_selection(a: np.ndarray, target: np.ndarray, count: int, ridge: float) -> tuple[list[int], np.ndarray]:
    """Orthogonal least squares as one would write it down: every atom tried, every time, by a full solve."""

    def cost(chosen: list[int]) -> tuple[float, np.ndarray]:
        part = a[:, chosen]
        w = np.linalg.solve(part.T @ part + ridge * np.eye(len(chosen)), part.T @ target)
        return float(((part @ w - target) ** 2).sum() + ridge * (w**2).sum()), w

    chosen: list[int] = []
    for _ in range(count):
        left = [j for j in range(a.shape[1]) if j not in chosen]
        chosen.append(min(left, key=lambda j: cost([*chosen, j])[0]))
    return chosen, cost(chosen)[1]


def test_greedy_choice_is_that_of_the_slow_way() -> None:
    rows, _ = bumpy_rows(400, 3)
    axes = np.full(6, 20.0)
    grid = CentreGrid((20, 60), 2.5)
    selection = select_centres(rows, axes, grid, 8)
    a = dense_dictionary(grid, rows.directions) * (rows.weights * 20.0)[:, None]
    ridge = RIDGE * (a**2).sum(axis=0).mean()
    chosen, weights = slow_selection(a, rows.weights * (20.0 - rows.radii), 8, ridge)
    assert selection.atoms.tolist() == chosen
    field = selection.field(8)
    assert np.allclose(field.weights, weights[np.argsort(chosen)], rtol=1e-4, atol=1e-6)
    assert (np.diff(field.index) > 0).all()


def test_held_centres_are_kept_and_come_first() -> None:
    rows, axes = bumpy_rows(1500, 4)
    grid = grid_for(300)
    held = np.array([5, 99, 17])
    selection = select_centres(rows, axes, grid, 20, held)
    assert selection.atoms[:3].tolist() == held.tolist()
    assert (selection.held, selection.atoms.size) == (3, 20)
    assert len(set(selection.atoms.tolist())) == 20


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 10_000))
def test_a_longer_choice_never_fits_worse(seed: int) -> None:
    rows, axes = bumpy_rows(900, seed)
    selection = select_centres(rows, axes, grid_for(120), 40)
    misses = []
    for count in (1, 5, 20, selection.atoms.size):
        leaf = leaf_of(np.zeros(3), axes, selection.field(count))
        misses.append(float(((rows.weights * (leaf_radius(leaf, rows.directions) - rows.radii)) ** 2).sum()))
    assert (np.diff(misses) <= 1e-3 * misses[0]).all()


def test_cost_of_dropping_a_centre_is_what_the_rest_then_misses_more() -> None:
    rows, axes = bumpy_rows(800, 6)
    grid = CentreGrid((20, 80), 2.5)
    leaf = leaf_of(np.zeros(3), axes, select_centres(rows, axes, grid, 10).field(10))
    costs = costs_of_dropping(rows, leaf)
    q = ellipsoid_radii(axes, rows.directions) * rows.weights
    a = dense_dictionary(grid, rows.directions)[:, leaf.scale_field.index] * q[:, None]
    target = q - rows.weights * rows.radii
    ridge = RIDGE * (a**2).sum(axis=0).mean()

    def cost(columns: np.ndarray) -> float:
        part = a[:, columns]
        w = np.linalg.solve(part.T @ part + ridge * np.eye(part.shape[1]), part.T @ target)
        return float(((part @ w - target) ** 2).sum() + ridge * (w**2).sum())

    everything = np.arange(10)
    slow = [cost(np.delete(everything, j)) - cost(everything) for j in range(10)]
    assert np.allclose(costs, slow, rtol=1e-2, atol=1e-3 * max(slow))


@settings(max_examples=20, deadline=None)
@given(st.lists(st.floats(5.0, 50.0), min_size=6, max_size=6))
def test_an_ellipsoid_of_six_half_axes_is_found_again(axes: list[float]) -> None:
    true = np.array(axes)
    directions = turned_fibonacci(600, 1)
    radii = ellipsoid_radii(true, directions)
    leaf = ModelLeaf(np.zeros(3), np.zeros(0), Superquadric(frozen(true)), ScaleField.none())
    assert np.allclose(radii, leaf_radius(leaf, directions))
    found = fit_ellipsoid(Rows(directions, radii, np.ones(600), np.zeros(600, dtype=bool)))
    assert np.abs(ellipsoid_radii(found, directions) - radii).mean() < 0.01 * true.mean()


def test_a_bound_that_is_kept_costs_nothing_and_one_that_is_broken_pulls() -> None:
    directions = turned_fibonacci(600, 1)
    up = directions[:, 2] > 0.0
    kept = fit_ellipsoid(Rows(directions, np.where(up, 5.0, 10.0), np.ones(600), up))
    assert abs(ellipsoid_radii(kept, directions[~up]).mean() - 10.0) < 0.1
    broken = fit_ellipsoid(Rows(directions, np.where(up, 20.0, 10.0), np.ones(600), up))
    assert broken[4] > 15.0


@settings(max_examples=50, deadline=None)
@given(
    st.lists(st.lists(st.floats(0.0, 100.0), max_size=30), min_size=1, max_size=4),
    st.integers(0, 60),
)
def test_one_budget_over_leaves_is_kept_and_used_up(gains: list[list[float]], budget: int) -> None:
    counts = counts_within([np.array(g) for g in gains], 500, budget)
    spent = sum(k + subset_numbers(500, k) for k in counts)
    assert spent <= budget
    assert all(k <= len(g) for k, g in zip(counts, gains, strict=True))
    left = [k + 1 + subset_numbers(500, k + 1) - k - subset_numbers(500, k) for k in counts]
    assert all(k == len(g) or spent + cost > budget for k, g, cost in zip(counts, gains, left, strict=True))


def test_centres_go_where_they_bring_most() -> None:
    rich, poor = np.full(40, 10.0), np.full(40, 1.0)
    assert counts_within([poor, rich], 1000, 30)[1] > 20
    late = np.concatenate([np.zeros(5), np.full(10, 50.0)])
    assert counts_within([late, poor], 1000, 20)[0] == 15
    assert counts_within([poor, poor], 1000, 20, held=[10, 0])[0] >= 10
