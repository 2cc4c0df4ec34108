"""Runs of walks: more of them than there is room for, on one segment and on many."""

from __future__ import annotations

import numpy as np
import pytest

from hhsr.compiled import proofs
from hhsr.model import Cut, ModelLeaf, Node, ScaleField, Superquadric, Tree, frozen
from hhsr.segments import _cross_alone
from hhsr.shape import Shape
from tests.strategies import random_tree

RADIUS, APART, BALLS = 3.0, 8.0, 64


def row_of_balls(first: int, count: int) -> Node:
    """Return balls of RADIUS along x, APART from each other, each between two cutting planes."""
    if count == 1:
        size = frozen(np.full(6, RADIUS))
        return ModelLeaf(frozen([APART * first, 0.0, 0.0]), frozen([]), Superquadric(size), ScaleField.none())
    half = count // 2
    middle = APART * (first + half - 0.5)
    return Cut(frozen([0.0, 0.0]), middle, 0.0, (), row_of_balls(first, half), row_of_balls(first + half, count - half))


@pytest.fixture(scope="module")
def balls() -> Shape:
    """64 balls in a row: a segment along it has 128 crossings, more runs than one walk keeps at a time."""
    return Shape(Tree(row_of_balls(0, BALLS), frozen(np.zeros(6))))


def along_the_row(rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return segments past both ends of the row, and where each crosses the balls, t (count, 128)."""
    starts, ends = np.zeros((count, 3)), np.zeros((count, 3))
    starts[:, 0], ends[:, 0] = -9.0, APART * BALLS + 9.0
    starts[:, 1:] = ends[:, 1:] = rng.uniform(-1.5, 1.5, (count, 2))
    half = np.sqrt(RADIUS**2 - (starts[:, 1:] ** 2).sum(axis=1))[:, None]
    centres = APART * np.arange(BALLS)
    at = np.stack([centres - half, centres + half], axis=-1).reshape(count, -1)
    return starts, ends, (at + 9.0) / (APART * BALLS + 18.0)


def test_a_walk_settles_its_runs_and_goes_on(balls: Shape) -> None:
    starts, ends, true = along_the_row(np.random.default_rng(0), 3)
    for k in range(3):
        inside, t = _cross_alone(balls.compiled.blob, starts[k], ends[k], 0.01, 0.001)
        assert not inside
        assert t == pytest.approx(true[k], abs=0.001 / (APART * BALLS))


def test_many_segments_have_more_runs_than_expected(balls: Shape) -> None:
    starts, ends, true = along_the_row(np.random.default_rng(1), 300)
    found = balls.crossings(starts, ends)
    assert np.array_equal(np.diff(found.offsets), np.full(300, 2 * BALLS))
    assert np.allclose(found.t.reshape(300, -1), true, rtol=0, atol=0.001 / (APART * BALLS))
    first = balls.first_crossing(starts, ends)
    assert np.array_equal(first, found.t[found.offsets[:-1]])
    for k in range(0, 300, 50):
        one = balls.crossings(starts[k], ends[k])
        assert np.array_equal(one.t, found.t[found.offsets[k] : found.offsets[k + 1]])
        inside, alone = _cross_alone(balls.compiled.blob, starts[k], ends[k], 0.01, 0.001)
        assert not inside
        assert np.array_equal(alone, one.t)


def test_leaves_with_exponents_have_runs_of_unknown_bend(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fewer voxels than a leaf has blocks of directions: a run's key is its surfels' then."""
    monkeypatch.setattr(proofs, "VOXELS_TOTAL", 600)
    shape = Shape(random_tree(0, 0))
    rng = np.random.default_rng(4)
    low, high = shape.bounds
    starts, ends = rng.uniform(low - 5, high + 5, (2, 500, 3))
    found = shape.crossings(starts, ends)
    assert len(found.t) > 200
    for k in range(500):
        one = shape.crossings(starts[k], ends[k])
        assert np.array_equal(one.t, found.t[found.offsets[k] : found.offsets[k + 1]])
    odd = np.diff(found.offsets) % 2 == 1
    assert np.array_equal(odd, shape.contains(starts) != shape.contains(ends))
    assert np.abs(shape.field(found.points)).max() < 1e-3


def test_a_touch_of_two_runs_is_none() -> None:
    """Two half balls on one cut: the surface is whole, and no segment through the cut has a crossing there."""
    size = frozen(np.full(6, 10.0))
    ball = ModelLeaf(frozen(np.zeros(3)), frozen([]), Superquadric(size), ScaleField.none())
    shape = Shape(Tree(Cut(frozen([0.3, 0.2]), 0.5, 0.0, (), ball, ball), frozen(np.zeros(6))))
    rng = np.random.default_rng(2)
    starts, ends = rng.normal(size=(2, 500, 3))
    starts *= 20.0 / np.sqrt((starts**2).sum(axis=1))[:, None]
    ends *= 20.0 / np.sqrt((ends**2).sum(axis=1))[:, None]
    way = ends - starts
    middle = -(starts * way).sum(axis=1) / (way**2).sum(axis=1)
    nearest = np.sqrt(((starts + middle[:, None] * way) ** 2).sum(axis=1))
    clear = np.abs(nearest - 10.0) > 0.01
    counts = np.diff(shape.crossings(starts, ends).offsets)
    assert np.array_equal(counts[clear], np.where(nearest < 10.0, 2, 0)[clear])
    assert (counts % 2 == 0).all()
