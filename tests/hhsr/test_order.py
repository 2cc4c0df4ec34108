"""What stands or is asked in an order of its own: facets under their discs, batches of points and of segments."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from hhsr.batches import FEW, by_middles, neighbours_first
from hhsr.compiled import compile_tree
from hhsr.kernels import layout as at
from hhsr.kernels.descent import onto_surface
from hhsr.kernels.disc_bounds import WIDE
from hhsr.kernels.disc_order import order_facets
from hhsr.kernels.distance import set_search
from hhsr.kernels.layout import integers, tables
from hhsr.kernels.nearest import seed_point
from hhsr.kernels.patch import BEST, FAR, FOOT, SEARCH_SIZE, SPOT
from hhsr.kernels.tree import into_tree, out_of_tree
from hhsr.kernels.voxels import settled_about, solid_contains
from hhsr.model import FloatArray
from hhsr.shape import Shape
from tests.strategies import random_tree


def ordered(points: FloatArray) -> NDArray[np.int64]:
    order = np.empty(len(points), dtype=np.int64)
    order_facets(points.copy(), order)
    return order


@pytest.mark.parametrize("count", [0, 1, 15, 16, 17, 255, 256, 257, 4097, 5000])
def test_facets_in_order_are_all_there_once(count: int) -> None:
    assert sorted(ordered(np.random.default_rng(count).normal(size=(count, 3)))) == list(range(count))


def test_facets_of_one_place_are_all_there_once() -> None:
    points = np.random.default_rng(0).integers(0, 2, (3000, 3)).astype(float)
    order = ordered(points)
    assert sorted(order) == list(range(3000))
    assert sorted(ordered(np.zeros((3000, 3)))) == list(range(3000))
    # Eight places of some 375 each: whole runs of them are of one place.
    runs = points[order][: 3000 // WIDE * WIDE].reshape(-1, WIDE, 3)
    assert (np.ptp(runs, axis=1).max(axis=1) == 0).mean() > 0.9


def test_runs_of_facets_in_order_lie_close_together() -> None:
    """On a sphere, against runs along its latitudes: a sixteenth of an even patch is a quarter as wide."""
    rng = np.random.default_rng(1)
    points = rng.normal(size=(16**3, 3))
    points /= np.linalg.norm(points, axis=1, keepdims=True)
    order = ordered(points)
    for run in (WIDE, WIDE**2):
        wide = np.linalg.norm(np.ptp(points[order].reshape(-1, run, 3), axis=1), axis=1)
        even = np.sqrt(4 * np.pi * run / len(points))  # a square's side
        assert np.median(wide) < 2.0 * even
        assert wide.max() < 4.0 * even


def test_neighbours_first_is_an_order_of_all_points() -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-100, 100, (5000, 3))
    order = neighbours_first(points)
    assert sorted(order) == list(range(5000))
    steps = np.linalg.norm(np.diff(points[order], axis=0), axis=1)
    assert steps.mean() < 0.25 * np.linalg.norm(np.diff(points, axis=0), axis=1).mean()
    points[7] = np.nan
    points[9] = [np.inf, 0, -np.inf]
    points[11] = 1e300
    assert sorted(neighbours_first(points)) == list(range(5000))
    assert neighbours_first(np.empty((0, 3))).shape == (0,)
    assert list(neighbours_first(np.ones((3, 3)))) == [0, 1, 2]


@pytest.fixture(scope="module")
def shape() -> Shape:
    return Shape(random_tree(5, depth=2))


def test_segments_in_order_keep_their_rows(shape: Shape) -> None:
    """A batch long enough to be put in order, with rows that are not finite: as each segment alone."""
    rng = np.random.default_rng(2)
    low, high = shape.bounds
    starts, ends = rng.uniform(low - 20, high + 20, (2, FEW + 500, 3))
    starts[7], ends[11, 2], starts[FEW] = np.nan, np.inf, [0, -np.inf, 0]
    ends[13] = starts[13]
    assert sorted(by_middles(starts, ends)) == list(range(len(starts)))
    found = shape.crossings(starts, ends, on_invalid="mark")
    t, valid = shape.first_crossing(starts, ends, on_invalid="mark")
    near = shape.closest_approach(starts, ends, 1.0, on_invalid="mark")
    assert list(np.flatnonzero(~found.valid)) == [7, 11, FEW]
    assert np.array_equal(valid, found.valid)
    assert np.isnan(near.clearance[[7, 11, FEW]]).all()
    assert found.offsets[-1] == len(found.t) == len(found.points) == len(found.entering)
    for i in [*range(300), *range(FEW - 50, FEW + 50)]:
        own = slice(found.offsets[i], found.offsets[i + 1])
        if not valid[i]:
            assert own.start == own.stop
            continue
        one = shape.crossings(starts[i], ends[i])
        assert np.array_equal(found.t[own], one.t)
        assert np.array_equal(found.points[own], one.points)
        assert np.array_equal(found.entering[own], one.entering)
        assert np.array_equal(t[i], shape.first_crossing(starts[i], ends[i]), equal_nan=True)
        assert near.clearance[i] == shape.clearance(starts[i], ends[i], 1.0)
        on_axis = starts[i] + near.t[i] * (ends[i] - starts[i])
        assert near.on_axis[i] == pytest.approx(on_axis, abs=1e-9)


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_about_a_settled_point_all_is_of_one_state(seed: int) -> None:
    """Within 1e-6 mm along each axis; points by the thousand, some on the borders of voxels, some off the grid."""
    rng = np.random.default_rng(seed)
    blob = compile_tree(random_tree(seed, depth=2)).blob
    ints, tab = integers(blob), tables(blob)
    c, f = ints[at.VOXELS], ints[at.VOXEL_FRAME]
    counts = np.array([ints[c + k] for k in range(3)])
    cells = rng.uniform(-2, 4 * counts + 2, (3000, 3))
    cells[:1000] = np.round(cells[:1000])
    points = blob[f : f + 3] + blob[f + 3] * cells
    settled = 0
    for p in points:
        if not settled_about(blob, ints, *p):
            continue
        settled += 1
        state = solid_contains(blob, ints, tab, np.int64(0), *p)
        for shift in 1e-6 * np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1], [1, 1, 1]]):
            assert solid_contains(blob, ints, tab, np.int64(0), *(p + shift)) == state
    assert settled > 1500


@pytest.mark.parametrize("seed", [3, 4])
def test_feet_by_the_table_are_no_nearer_than_the_surface(seed: int) -> None:
    """What a way down offers is an upper bound; put on to the surface it is exact, and no farther."""
    shape = Shape(random_tree(seed, depth=1))
    blob = shape.compiled.blob
    ints, tab = integers(blob), tables(blob)
    low, high = shape.bounds
    search, by_table = np.empty(SEARCH_SIZE), 0
    for p in np.random.default_rng(seed).uniform(low - 10, high + 10, (400, 3)):
        set_search(search, *into_tree(blob, ints, *p), 0.0, 0.0, 0.0, 0.01)
        seed_point(blob, ints, tab, search)
        if search[BEST] == FAR:
            continue
        before, own = search[BEST], search[SPOT] >= 0
        by_table += own
        onto_surface(blob, ints, search)
        assert search[BEST] <= before
        assert search[BEST] >= abs(shape.signed_distance(p)) - 0.01
        foot = np.array(out_of_tree(blob, ints, *search[FOOT : FOOT + 3]))
        assert np.linalg.norm(foot - p) == pytest.approx(search[BEST], abs=1e-9)
        assert not own or abs(shape.field(foot)) < 1e-12
    assert by_table > 100
