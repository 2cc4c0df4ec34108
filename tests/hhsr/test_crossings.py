"""Crossings: complete, in order, even between outside points, right to the tolerance; and against small steps."""

from __future__ import annotations

import numpy as np
import pytest

from hhsr.errors import InputError
from hhsr.model import ModelLeaf, ScaleField, Superquadric, Tree, cuts, frozen, leaves, rotation_matrix
from hhsr.shape import Shape
from tests.strategies import random_tree

KINDS = [(0, False, False), (2, False, False), (2, True, False), (2, True, True), (5, False, False)]


def hard_segments(shape: Shape, rng: np.random.Generator, count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return LPS segments: long, in cutting planes, through leaves' centres, along poles, tangent to the surface."""
    low, high = shape.bounds[0] - 10, shape.bounds[1] + 10
    rotation, shift = rotation_matrix(shape.tree.pose[:3]), shape.tree.pose[3:]
    starts, ends = [rng.uniform(low, high, (count, 3))], [rng.uniform(low, high, (count, 3))]
    for cut in cuts(shape.tree.root):
        pair = [rng.uniform(-80, 80, (8, 3)) for _ in range(2)]
        for part, group in zip(pair, (starts, ends), strict=True):
            flat = part - (part @ cut.normal - cut.offset - rng.choice([0.0, cut.half_width]))[:, None] * cut.normal
            group.append(flat @ rotation.T + shift)
    for leaf in leaves(shape.tree.root):
        if isinstance(leaf, ModelLeaf):
            frame = rotation @ rotation_matrix(leaf.rotation)
            axes = np.concatenate([np.eye(3), rng.normal(size=(3, 3)), [[1, 1, 1], [1, -1, 0]]]) * 300.0
            centre = rotation @ leaf.centre + shift
            starts.append(centre - axes @ frame.T)
            ends.append(centre + axes @ frame.T)
    foot, distance = shape.closest_point(rng.uniform(low, high, (count, 3)))
    foot = foot[np.abs(distance) > 0.5]
    along = rng.normal(size=foot.shape)
    starts.append(foot - 20 * along)
    ends.append(foot + 20 * along)
    return np.concatenate(starts), np.concatenate(ends)


@pytest.mark.parametrize(("depth", "bands", "parts"), KINDS)
def test_states_alternate_and_places_are_right(depth: int, bands: bool, parts: bool) -> None:
    shape = Shape(random_tree(7 + depth, depth, bands, parts))
    rng = np.random.default_rng(depth)
    starts, ends = hard_segments(shape, rng, 300)
    found = shape.crossings(starts, ends)
    counts = np.diff(found.offsets)
    first, last = shape.contains(starts), shape.contains(ends)
    assert ((counts % 2 == 1) == (first != last)).all()
    row = np.repeat(np.arange(len(starts)), counts)
    assert (np.diff(found.t)[row[1:] == row[:-1]] > 0).all()
    # 0.002 mm before and after, the states are the ones reported, unless another crossing is that near.
    length = np.sqrt(((ends - starts) ** 2).sum(axis=1))[row]
    step = 2e-3 / length
    gap = np.full(len(found.t), np.inf)
    same = row[1:] == row[:-1]
    gap[1:][same] = np.diff(found.t)[same]
    gap[:-1][same] = np.minimum(gap[:-1][same], np.diff(found.t)[same])
    alone = (gap > 2 * step) & (found.t > step) & (found.t < 1 - step)
    along = (ends - starts)[row]
    before = shape.contains(starts[row] + (found.t - step)[:, None] * along)
    after = shape.contains(starts[row] + (found.t + step)[:, None] * along)
    # A segment within a cutting plane may pass along a step face, where rounding of the sample picks the side.
    wrong = alone & ((after != found.entering) | (before == found.entering))
    assert wrong.sum() <= 0.02 * len(wrong)
    if depth == 0:
        assert wrong.sum() == 0
    np.testing.assert_allclose(found.points, starts[row] + found.t[:, None] * along, atol=1e-9)


@pytest.mark.parametrize(("depth", "bands", "parts"), KINDS[:4])
def test_nothing_is_missed_or_invented_against_small_steps(depth: int, bands: bool, parts: bool) -> None:
    shape = Shape(random_tree(depth, depth, bands, parts))
    rng = np.random.default_rng(1)
    foot, _ = shape.closest_point(rng.uniform(shape.bounds[0], shape.bounds[1], (150, 3)))
    starts = foot + rng.normal(size=foot.shape) * 0.5
    ends = foot + rng.normal(size=foot.shape) * 0.5
    found = shape.crossings(starts, ends)
    for i, (start, end) in enumerate(zip(starts, ends, strict=True)):
        length = float(np.sqrt(((end - start) ** 2).sum()))
        shares = np.linspace(0, 1, int(length / 0.002) + 2)
        states = shape.contains(start + shares[:, None] * (end - start))
        flips = shares[1:][states[1:] != states[:-1]]
        t = found.t[found.offsets[i] : found.offsets[i + 1]]
        slim = 0.0101 / length
        # Every pair of flips farther apart than the resolution is there, and every wide pair reported is real.
        if len(flips) != len(t):
            both = np.sort(np.concatenate([flips, t]))
            assert np.diff(both).min() < slim
            assert abs(len(flips) - len(t)) % 2 == 0
        else:
            assert np.abs(flips - t).max(initial=0.0) * length <= 0.0035


def test_first_crossing_is_the_first_of_all() -> None:
    shape = Shape(random_tree(3, 3, bands=True))
    starts, ends = hard_segments(shape, np.random.default_rng(0), 500)
    found = shape.crossings(starts, ends)
    has = np.diff(found.offsets) > 0
    first = shape.first_crossing(starts, ends)
    assert np.array_equal(np.isnan(first), ~has)
    np.testing.assert_array_equal(first[has], found.t[found.offsets[:-1][has]])
    assert shape.first_crossing(starts[0], ends[0]) == pytest.approx(first[0], nan_ok=True)


def test_one_segment_and_a_batch_on_two_threads_are_bit_identical() -> None:
    shape = Shape(random_tree(3, 2, bands=True))
    starts, ends = hard_segments(shape, np.random.default_rng(4), 300)
    many = np.tile(starts, (60, 1)), np.tile(ends, (60, 1))
    batch = shape.crossings(*many)
    alone = shape.crossings(starts, ends)
    assert np.array_equal(batch.t, np.tile(alone.t, 60))
    for i in range(40):
        one = shape.crossings(starts[i], ends[i])
        assert np.array_equal(one.t, alone.t[alone.offsets[i] : alone.offsets[i + 1]])
        assert one.offsets.tolist() == [0, len(one.t)]


def test_a_segment_of_no_length_has_no_crossings() -> None:
    shape = Shape(random_tree(3, 2))
    foot, _ = shape.closest_point(shape.bounds[1])
    assert len(shape.crossings(foot, foot).t) == 0
    assert np.isnan(shape.first_crossing(foot, foot))


def test_a_sphere_is_crossed_where_it_should_be() -> None:
    ball = ModelLeaf(frozen(np.zeros(3)), frozen([]), Superquadric(frozen([20.0] * 6)), ScaleField.none())
    shape = Shape(Tree(ball, frozen([0.3, 0.1, -0.2, 5, 5, 5])))
    rng = np.random.default_rng(0)
    for far in (30.0, 1e3, 1e6):
        way = rng.normal(size=(200, 3))
        way /= np.sqrt((way**2).sum(axis=1))[:, None]
        miss = np.cross(way, rng.normal(size=(200, 3)))
        miss *= (rng.uniform(0, 25, 200) / np.sqrt((miss**2).sum(axis=1)))[:, None]
        starts, ends = 5 + miss - far * way, 5 + miss + far * way
        offset = np.sqrt((miss**2).sum(axis=1))
        found = shape.crossings(starts, ends)
        assert np.array_equal(np.diff(found.offsets), np.where(offset < 20, 2, 0))
        half = np.sqrt(400 - offset[offset < 20] ** 2)
        places = found.t.reshape(-1, 2) * 2 * far - far
        np.testing.assert_allclose(places, np.stack([-half, half], axis=1), atol=1e-3 + 1e-9 * far)
    profile = shape.profile([-35.0, 5, 5], [45.0, 5, 5], n=5)
    assert profile.inside_mm == pytest.approx(40.0, abs=2e-3)
    np.testing.assert_allclose(profile.distance, [20, 0, -20, 0, 20], atol=0.01)


def test_a_curve_is_its_segments() -> None:
    shape = Shape(random_tree(3, 2))
    angle = np.linspace(0, 3, 40)
    curve = shape.tree.pose[3:] + np.stack([30 * np.cos(angle), 30 * np.sin(angle), 20 * angle - 30], axis=1)
    found = shape.polyline_crossings(curve)
    assert len(found.offsets) == 40
    assert (len(found.t) % 2 == 1) == (shape.contains(curve[0]) != shape.contains(curve[-1]))
    assert shape.polyline_clearance(curve, 0.5) == shape.clearance(curve[:-1], curve[1:], 0.5).min()
    with pytest.raises(InputError, match="k ≥ 2"):
        shape.polyline_crossings(curve[:1])
