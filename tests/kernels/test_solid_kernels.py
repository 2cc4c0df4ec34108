"""Every query's kernels on small solids: closed forms, the slow twins of tests/oracles.py, what must always hold."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hhsr.model import leaves, rotation_matrix
from tests import oracles
from tests.kernels.small_solids import POSE, TREES, arithmetic_of_c, solid  # noqa: F401

SOLIDS = [name for name in TREES if name != "empty"]
SMOOTH = [name for name in SOLIDS if name != "pitted"]  # steep cells take half a minute without the compiler
DISTANCE_MM = 0.01


def around(name: str, seed: int, count: int) -> np.ndarray:
    """Return LPS points about a solid, in its box grown by 4 mm."""
    low, high = solid(name).bounds
    return np.random.default_rng(seed).uniform(low - 4.0, high + 4.0, (count, 3))


def in_ball(points: np.ndarray) -> np.ndarray:
    """Return the signed distance of LPS points to "ball"."""
    return np.linalg.norm(points - POSE[3:], axis=-1) - 10.0


def lobes_hold(points: np.ndarray) -> np.ndarray:
    """Return whether "lobes" holds points, from its definition: exact square sections, and circles between them."""
    height = points[:, 2]
    t = (height / 2.0 + 1.0) / 2.0
    inside = np.zeros(len(points), dtype=bool)
    angles = -math.pi + 2 * math.pi * np.arange(257) / 256
    box = np.zeros(len(points), dtype=bool)
    square = 3.0 / np.maximum(np.abs(np.cos(angles)), np.abs(np.sin(angles)))
    for centre, radius in ((-4.0, 2.5), (4.0, 2.0)):
        d = points[:, :2] - [centre, 0.0]
        end = np.interp(np.arctan2(d[:, 1], d[:, 0]), angles, square)
        weight = 4 * t * (1 - t)
        inside |= np.hypot(*d.T) <= (1 - weight) * end + weight * radius
        box |= (np.abs(d) <= 3.0).all(axis=1) & (np.abs(height) <= 5.0)
    return np.where(np.abs(height) < 2.0, inside, box)


def holds(name: str, points: np.ndarray) -> np.ndarray:
    """Return whether a solid holds points, by a slow twin."""
    if name == "lobes":
        return lobes_hold(points)
    return oracles.shape_contains(solid(name).tree, points)


@pytest.mark.parametrize("name", SOLIDS)
def test_contains_is_the_definition(name: str) -> None:
    points = around(name, 0, 400)
    expected = holds(name, points)
    assert 0 < expected.sum() < len(points)
    np.testing.assert_array_equal(solid(name).contains(points), expected)
    assert [solid(name).contains(p) for p in points[:5]] == expected[:5].tolist()


@pytest.mark.parametrize("name", ["lumpy", "pitted"])
def test_points_close_to_a_surface_and_at_poles_get_the_exact_answer(name: str) -> None:
    tree = solid(name).tree
    rng = np.random.default_rng(1)
    u = np.concatenate([rng.normal(size=(40, 3)), np.eye(3), -np.eye(3), [[0.0, 0.0, 0.0]]])
    u[:-1] /= np.linalg.norm(u[:-1], axis=1)[:, None]
    (leaf,) = leaves(tree.root)
    for share in (1 - 1e-4, 1 - 1e-7, 1 + 1e-7, 1 + 1e-4):
        q = u * 5.0
        with np.errstate(all="ignore"):
            # N is homogeneous: the radius is (1 − s) / N(u), from the implicit value at 5 mm.
            s = oracles.leaf_implicit(leaf, leaf.centre + 1e-9 * u @ rotation_matrix(leaf.rotation).T) + 1.0
            n = (oracles.leaf_implicit(leaf, leaf.centre + q @ rotation_matrix(leaf.rotation).T) + 1.0 - s) / 5.0
            radius = np.where(n > 0, (1.0 - s) / n, 1.0)
        local = leaf.centre + (radius * share)[:, None] * u @ rotation_matrix(leaf.rotation).T
        points = local @ rotation_matrix(tree.pose[:3]).T + tree.pose[3:]
        np.testing.assert_array_equal(solid(name).contains(points)[:-1], share < 1)
        assert solid(name).contains(points[-1])


def test_points_that_are_not_finite_are_marked_and_an_empty_solid_holds_none() -> None:
    points = np.array([[7.0, -3.0, 2.0], [np.nan, 0.0, 0.0], [90.0, 0.0, 0.0], [np.inf, -np.inf, 0.0]])
    ends = points[::-1].copy()
    shape = solid("ball")
    with np.errstate(invalid="ignore"):  # ∞ − ∞ on the way, of which only Python warns
        assert shape.contains(points, on_invalid="mark").tolist() == [1, -1, 0, -1]
    np.testing.assert_array_equal(np.isnan(shape.field(points, on_invalid="mark")), [0, 1, 0, 1])
    foot, distance = shape.closest_point(points, on_invalid="mark")
    assert np.isnan(distance).tolist() == [False, True, False, True]
    assert np.isnan(foot[1]).all()
    assert not shape.crossings(points, ends, on_invalid="mark").valid.any()
    assert not shape.first_crossing(points, ends, on_invalid="mark")[1].any()
    assert np.isnan(shape.clearance(points, ends, on_invalid="mark")).all()
    empty = solid("empty")
    assert not empty.contains(points[:1]).any()
    assert empty.field(points[0]) == 1.0
    assert empty.signed_distance(points[0]) == np.inf
    assert len(empty.crossings(points[:1], points[2:3]).t) == 0
    assert np.isnan(empty.bounds).all()


def test_field_is_the_formula_of_the_owner() -> None:
    for name in ("ball", "lumpy", "pitted"):
        points, tree = around(name, 2, 60), solid(name).tree
        expected = oracles.leaf_implicit(tree.root, oracles.into_tree(tree, points))
        np.testing.assert_allclose(solid(name).field(points), expected, rtol=1e-9, atol=1e-9)
    cube = solid("corner")
    np.testing.assert_allclose(
        cube.field(np.array([[3.0, 3.0, 1.0], [9.0, 2.0, 0.0], [-1.0, 0.0, 0.0]])), [-0.2, 0.4, 1.0], atol=1e-12
    )
    middle = np.array([[1.0, 0.0, 0.0], [-4.0, 1.5, 0.0], [4.5, 0.0, 0.0], [-4.0, 0.0, 0.0]])
    np.testing.assert_allclose(solid("lobes").field(middle), [0.5, -0.4, -0.75, -1.0], atol=1e-12)


@pytest.mark.parametrize("name", SMOOTH)
def test_distance_is_of_a_surface_point_and_none_is_nearer(name: str) -> None:
    points = around(name, 3, 12)
    shape = solid(name)
    foot, distance = shape.closest_point(points)
    np.testing.assert_allclose(np.linalg.norm(points - foot, axis=1), np.abs(distance), atol=1e-6)
    np.testing.assert_array_equal(distance <= 0, holds(name, points))
    rng = np.random.default_rng(4)
    for p, f, d in zip(points, foot, distance, strict=True):
        beside = shape.contains(f + rng.normal(size=(200, 3)) * 1e-4)
        assert beside.any()
        assert not beside.all()
        u = rng.normal(size=(200, 3))
        reach = max(abs(d) - 2 * DISTANCE_MM, 0.0)
        free = shape.contains(p + reach * u / np.linalg.norm(u, axis=1)[:, None])
        assert (free == (d <= 0)).all()


def test_distances_in_closed_form() -> None:
    points = around("ball", 5, 30)
    np.testing.assert_allclose(solid("ball").signed_distance(points), in_ball(points), atol=DISTANCE_MM)
    # A step face between half balls of 10 and of 6 mm, its rim, both round sides, and from within.
    at = np.array([[2.0, 8.0, 0], [3.0, 12.0, 0], [-12.0, 0, 0], [9.0, 0, 1.0], [-0.5, 0, 8.0], [-9.0, 0, 0]])
    expected = [2.0, math.hypot(3, 2), 2.0, math.sqrt(82) - 6, -0.5, -1.0]
    np.testing.assert_allclose(solid("halves").signed_distance(at), expected, atol=DISTANCE_MM)
    # The quarter of a cube: a step face, the straight edge where both meet, a corner of it, a face, and within.
    at = np.array([[-2.0, 2, 0], [-3.0, -4, 0], [-3.0, -4, 17.0], [6.5, 2, 0], [1.0, 2, 0.5], [4.5, 4, 0]])
    expected = [2.0, 5.0, 13.0, 1.5, -1.0, -0.5]
    np.testing.assert_allclose(solid("corner").signed_distance(at), expected, atol=DISTANCE_MM)
    np.testing.assert_allclose(solid("corner").bounds, [[0, 0, -5], [5, 5, 5]], atol=1e-5)


@pytest.mark.parametrize("name", SOLIDS)
def test_crossings_part_inside_from_outside(name: str) -> None:
    shape = solid(name)
    starts, ends = around(name, 6, 25), around(name, 7, 25)
    found = shape.crossings(starts, ends)
    assert len(found.t) > 10
    first = shape.first_crossing(starts, ends)
    for i, (a, b) in enumerate(zip(starts, ends, strict=True)):
        rows = slice(found.offsets[i], found.offsets[i + 1])
        t, entering = found.t[rows], found.entering[rows]
        assert (np.diff(t) >= 0).all()
        assert (entering[1:] != entering[:-1]).all()
        assert len(t) % 2 == (shape.contains(a) != shape.contains(b))
        stops = np.concatenate([[0.0], t, [1.0]])
        length = np.linalg.norm(b - a)
        wide = np.diff(stops) * length > 0.02
        middles = (a + (stops[:-1] + 0.5 * np.diff(stops))[:, None] * (b - a))[wide]
        begins = shape.contains(a)
        states = begins ^ (np.arange(len(stops) - 1) % 2 == 1)
        np.testing.assert_array_equal(holds(name, middles), states[wide])
        off = 0.002 / length
        for share, into in zip(t, entering, strict=True):
            if off < share < 1 - off:
                sides = shape.contains(a + np.array([[share - off], [share + off]]) * (b - a))
                assert sides.tolist() == [not into, into] or sides.all() == sides.any()  # or a touch of 0.002 mm
        if len(t):
            assert first[i] == pytest.approx(t[0], abs=1e-6)
        else:
            assert np.isnan(first[i])


def test_crossings_of_a_ball_in_closed_form_along_axes_and_through_the_centre() -> None:
    shape = solid("ball")
    rotation = rotation_matrix(POSE[:3])
    starts = np.array([[-20.0, 0, 0], [0, -20, 0], [0, 0, 20], [-20, 6, 0], [-20, 11, 0], [0, 0, 0], [-20, 20, 0]])
    ends = np.array([[20.0, 0, 0], [0, 20, 0], [0, 0, -20], [20, 6, 0], [20, 11, 0], [0, 0, 0], [20, -20, 0]])
    found = shape.crossings(starts @ rotation.T + POSE[3:], ends @ rotation.T + POSE[3:])
    np.testing.assert_array_equal(np.diff(found.offsets), [2, 2, 2, 2, 0, 0, 2])
    edge = 10.0 / math.sqrt(2.0) / 40.0
    expected = [0.25, 0.75] * 3 + [0.3, 0.7, 0.5 - edge, 0.5 + edge]
    np.testing.assert_allclose(found.t, expected, atol=1e-4)
    np.testing.assert_allclose(in_ball(found.points), 0.0, atol=2e-3)


def test_segments_in_a_cutting_plane_and_along_edges() -> None:
    halves, corner, lobes = solid("halves"), solid("corner"), solid("lobes")
    within = halves.crossings(np.array([[0.0, -20, 0], [-20.0, 8, 0]]), np.array([[0.0, 20, 0], [20.0, 8, 0]]))
    np.testing.assert_array_equal(np.diff(within.offsets), [2, 2])
    np.testing.assert_allclose(within.t, [0.35, 0.65, 0.35, 0.5], atol=1e-4)  # h = 0 belongs to the right, of 6 mm
    found = corner.crossings(np.array([[-8.0, 2, 1], [2, -8, 6.0]]), np.array([[8.0, 2, 1], [2, 8, 6.0]]))
    np.testing.assert_allclose(found.t, [0.5, 13 / 16], atol=1e-4)
    flat = lobes.crossings(np.array([[-20.0, 0, 0]]), np.array([[20.0, 0, 0]]))
    np.testing.assert_allclose(flat.t, np.array([13.5, 18.5, 22.0, 26.0]) / 40, atol=1e-4)
    assert lobes.first_crossing(np.array([4.0, 0, 20]), np.array([4.0, 0, -20])) == pytest.approx(15 / 40, abs=1e-4)


def test_clearance_in_closed_form() -> None:
    offsets = np.array([[[0.0, 15, 0], [8, 15, 0]], [[-20, 12, 0], [20, 12, 0]], [[12, 0, 0], [4, 0, 0]]])
    segments = offsets + POSE[3:]
    clearance = solid("ball").clearance(segments[:, 0], segments[:, 1], radius=1.0)
    expected = np.array([5.0, 2.0, -6.0]) - 1.0
    assert (clearance <= expected + 1e-9).all()
    np.testing.assert_allclose(clearance, expected, atol=DISTANCE_MM)
    # Through the whole ball, 3 mm off its centre: the deepest point is the one next to that.
    through = solid("ball").closest_approach(
        POSE[3:] + np.array([-20.0, 3, 0]), POSE[3:] + np.array([20.0, 3, 0]), tolerance_mm=0.1
    )
    assert through.clearance == pytest.approx(-7.0, abs=0.1)
    assert through.t == pytest.approx(0.5, abs=0.05)
    edge = solid("corner").clearance(np.array([-3.0, -4, -2]), np.array([-3.0, -4, 2]))
    assert edge == pytest.approx(5.0, abs=DISTANCE_MM)


@pytest.mark.parametrize("name", ["lumpy", "corner", "lobes"])
def test_clearance_is_the_least_distance_along_a_segment(name: str) -> None:
    shape = solid(name)
    starts, ends = around(name, 8, 4), around(name, 9, 4)
    found = shape.closest_approach(starts, ends, tolerance_mm=0.5)
    gap = np.linalg.norm(found.on_axis - found.on_surface, axis=1)
    np.testing.assert_allclose(np.abs(found.clearance), gap, atol=0.5)
    for a, b, clearance in zip(starts, ends, found.clearance, strict=True):
        along = shape.signed_distance(a + np.linspace(0, 1, 9)[:, None] * (b - a))
        assert clearance <= along.min() + DISTANCE_MM


@pytest.mark.parametrize("name", SMOOTH)
def test_bounds_hold_the_solid_and_little_more(name: str) -> None:
    shape = solid(name)
    low, high = shape.bounds
    points = around(name, 10, 1500)
    inside = points[shape.contains(points)]
    assert (inside >= low).all()
    assert (inside <= high).all()
    foot = shape.closest_point(np.concatenate([[low - 3.0], [high + 3.0]]))[0]
    assert (foot >= low - 1e-6).all()
    assert (foot <= high + 1e-6).all()
