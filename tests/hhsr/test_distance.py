"""Distances and clearances: never nearer or farther than the surface, by sampling balls and by closed forms."""

from __future__ import annotations

import numpy as np
import pytest

from hhsr.errors import InputError
from hhsr.model import Cut, ModelLeaf, RetainedPart, ScaleField, Superquadric, Tree, frozen, normal_angles_of
from hhsr.shape import Shape
from hhsr.shape_set import ShapeSet
from tests.strategies import random_tree

KINDS = [(0, False, False), (2, False, False), (2, True, False), (2, True, True), (4, False, False)]


def ball(radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> ModelLeaf:
    return ModelLeaf(frozen(centre), frozen([]), Superquadric(frozen([radius] * 6)), ScaleField.none())


def box() -> Shape:
    """Return the cube |x|∞ ≤ 10 as six cuts of one large ball: every face of it is a step face."""
    node: object = ball(100.0)
    empty = RetainedPart(frozen(np.zeros((0, 3))), frozen(np.zeros((0, 3)), np.int64))
    for axis in range(3):
        normal = np.eye(3)[axis]
        node = Cut(normal_angles_of(normal), 10.0, 0.0, (), node, empty)  # type: ignore[arg-type]
        node = Cut(normal_angles_of(-normal), 10.0, 0.0, (), node, empty)
    return Shape(Tree(node, frozen(np.zeros(6))))  # type: ignore[arg-type]


@pytest.mark.parametrize(("depth", "bands", "parts"), KINDS)
def test_no_surface_is_nearer_and_the_foot_is_surface(depth: int, bands: bool, parts: bool) -> None:
    shape = Shape(random_tree(20 + depth, depth, bands, parts))
    rng = np.random.default_rng(depth)
    points = rng.uniform(shape.bounds[0] - 20, shape.bounds[1] + 20, (250, 3))
    foot, distance = shape.closest_point(points)
    points = np.concatenate([points, foot + rng.normal(size=foot.shape)])
    foot, distance = shape.closest_point(points)
    inside = shape.contains(points)
    assert np.array_equal(distance < 0, inside)
    np.testing.assert_allclose(np.sqrt(((points - foot) ** 2).sum(axis=1)), np.abs(distance), atol=1e-9)
    surface = np.zeros(len(foot), dtype=bool)
    for _ in range(60):
        way = rng.normal(size=foot.shape)
        way /= np.sqrt((way**2).sum(axis=1))[:, None]
        surface |= shape.contains(foot + 1e-4 * way) != shape.contains(foot - 1e-4 * way)
        reach = np.maximum(np.abs(distance) - 0.01, 0.0)[:, None] * rng.uniform(0.5, 1.0, (len(foot), 1)) ** 0.2
        assert np.array_equal(shape.contains(points + reach * way), inside)
    # In a sharp concave or convex corner few directions see both sides.
    assert surface.mean() > 0.98


def test_a_box_of_step_faces_has_faces_edges_and_corners() -> None:
    shape = box()
    rng = np.random.default_rng(0)
    points = np.concatenate([rng.uniform(-25, 25, (300, 3)), rng.uniform(-10, 10, (100, 3)), [[1e6, 2e5, -3e5]]])
    q = np.abs(points) - 10
    truth = np.sqrt((np.maximum(q, 0) ** 2).sum(axis=1)) + np.minimum(q.max(axis=1), 0)
    np.testing.assert_allclose(shape.signed_distance(points), truth, atol=0.01)
    np.testing.assert_allclose(shape.bounds, [[-10] * 3, [10] * 3], atol=1e-5)
    # Capsules against the box, sampled: the distance to a convex body is convex along a segment.
    starts, ends = rng.uniform(-40, 40, (2, 60, 3))
    t = np.linspace(0, 1, 4001)[:, None]
    for start, end, value in zip(starts, ends, shape.clearance(starts, ends, 1.5), strict=True):
        q = np.abs(start + t * (end - start)) - 10
        low = (np.sqrt((np.maximum(q, 0) ** 2).sum(axis=1)) + np.minimum(q.max(axis=1), 0)).min() - 1.5
        step = np.sqrt(((end - start) ** 2).sum()) / 8000
        assert low - step - 0.01 - 1e-6 <= value <= low + 1e-6


def test_a_ball_in_closed_form() -> None:
    shape = Shape(Tree(ball(20.0), frozen([0, 0, 0, 1, 2, 3])))
    rng = np.random.default_rng(0)
    centre = np.array([1.0, 2.0, 3.0])
    points = centre + rng.normal(size=(300, 3)) * rng.choice([1.0, 20.0, 1e3, 1e6], (300, 1))
    truth = np.sqrt(((points - centre) ** 2).sum(axis=1)) - 20
    np.testing.assert_allclose(shape.signed_distance(points), truth, atol=0.01)
    starts, ends = centre + rng.normal(size=(2, 200, 3)) * 30
    along = ends - starts
    share = np.clip(((centre - starts) * along).sum(axis=1) / (along**2).sum(axis=1), 0, 1)
    near = np.sqrt(((starts + share[:, None] * along - centre) ** 2).sum(axis=1)) - 20
    value = shape.clearance(starts, ends, 0.9)
    assert (value <= near - 0.9 + 1e-9).all()
    assert (value >= near - 0.9 - 0.01 - 1e-9).all()
    pair = shape.closest_approach(starts, ends, 0.9)
    gap = np.sqrt(((pair.on_axis - pair.on_surface) ** 2).sum(axis=1))
    np.testing.assert_allclose(gap, np.abs(near), atol=0.03)
    assert ((pair.t >= 0) & (pair.t <= 1)).all()


@pytest.mark.parametrize(("depth", "bands", "parts"), KINDS[:4])
def test_clearance_is_never_optimistic(depth: int, bands: bool, parts: bool) -> None:
    shape = Shape(random_tree(30 + depth, depth, bands, parts))
    rng = np.random.default_rng(depth)
    starts = rng.uniform(shape.bounds[0] - 20, shape.bounds[1] + 20, (25, 3))
    ends = starts + rng.normal(size=starts.shape) * 25
    value = shape.clearance(starts, ends)
    for start, end, low in zip(starts, ends, value, strict=True):
        length = float(np.sqrt(((end - start) ** 2).sum()))
        samples = start + np.linspace(0, 1, 150)[:, None] * (end - start)
        distance = shape.signed_distance(samples, tolerance_mm=0.002)
        # The truth lies in (least sample − half a step, least sample + the samples' tolerance].
        assert low <= distance.min() + 0.002
        assert low >= distance.min() - 0.002 - length / 149 / 2 - 0.01
    assert shape.clearance(starts[0], ends[0]) == value[0]
    assert shape.clearance(starts[0], ends[0], 2.0) == value[0] - 2.0


@pytest.mark.parametrize("seed", range(6))
def test_distance_has_the_sign_of_contains_about_the_surface(seed: int) -> None:
    rng = np.random.default_rng(seed)
    shape = Shape(random_tree(seed, depth=seed % 4, bands=False, parts=False))
    low, high = shape.bounds
    foot, _ = shape.closest_point(rng.uniform(low, high, (2000, 3)))
    near = foot + rng.normal(size=foot.shape) * rng.choice([1e-9, 1e-3, 0.02, 0.5], (2000, 1))
    np.testing.assert_array_equal(shape.signed_distance(near) <= 0.0, shape.contains(near))


def test_the_deeper_of_two_stretches() -> None:
    """Two balls of all but one depth on one segment: neither bound is loosened by the other."""
    rng = np.random.default_rng(8)
    for more in (0.0, 1e-3, 3e-3, 8e-3, 0.05):
        radii = rng.permutation([10.0, 10.0 + more])
        tree = Tree(
            Cut(frozen([0.0, 0.0]), 0.0, 0.0, (), ball(radii[0], (-20.0, 0.0, 0.0)), ball(radii[1], (20.0, 0.0, 0.0))),
            frozen(np.zeros(6)),
        )
        shape = Shape(tree)
        for y in (0.0, 1.3, 7.7):
            value = shape.clearance(np.array([-45.0, y, 0.0]), np.array([44.0, y, 0.0]), 0.5)
            truth = -(10.0 + more - y) - 0.5
            assert truth - 0.01 <= value <= truth + 1e-9


def test_a_finer_tolerance_is_kept() -> None:
    shape = Shape(random_tree(3, 1))
    points = np.random.default_rng(0).uniform(shape.bounds[0], shape.bounds[1], (50, 3))
    coarse, fine = shape.signed_distance(points), shape.signed_distance(points, tolerance_mm=1e-4)
    assert np.abs(coarse - fine).max() <= 0.0101
    assert (np.abs(coarse) >= np.abs(fine) - 1e-4).all()
    with pytest.raises(InputError, match="tolerance_mm"):
        shape.signed_distance(points, tolerance_mm=-1.0)
    with pytest.raises(InputError, match="radius"):
        shape.clearance(points, points, -1.0)


def test_a_set_answers_as_its_shapes() -> None:
    shapes = {f"organ {seed}": Shape(random_tree(seed, 1)) for seed in range(4)}
    together = ShapeSet(shapes)
    assert together.names == tuple(shapes)
    rng = np.random.default_rng(0)
    points = rng.uniform(-100, 100, (2000, 3))
    starts, ends = rng.uniform(-100, 100, (2, 40, 3))
    inside, found = together.contains(points), together.crossings(starts, ends)
    clearance, nearest = together.clearance(starts, ends, 1.0), together.nearest(starts, ends, 1.0)
    for k, shape in enumerate(shapes.values()):
        assert np.array_equal(inside[k], shape.contains(points))
        alone = shape.crossings(starts, ends)
        assert np.array_equal(found[together.names[k]].t, alone.t)
        assert np.array_equal(found[together.names[k]].offsets, alone.offsets)
        assert np.array_equal(clearance[k], shape.clearance(starts, ends, 1.0))
    assert np.array_equal(nearest.clearance, clearance.min(axis=0))
    assert np.array_equal(nearest.which, clearance.argmin(axis=0))
    assert together.nearest(starts[0], ends[0], 1.0) == (nearest.which[0], nearest.clearance[0])
    with pytest.raises(InputError, match="at least one"):
        ShapeSet({})
