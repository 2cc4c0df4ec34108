"""Plane sections, contour maps and mutex pairs on solids whose sections are known in closed form."""

from __future__ import annotations

import math

import numpy as np
import pytest

from hhsr.kernels import section

QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
FACES = np.array([f for a, b, c, d in QUADS for f in ((a, b, c), (a, c, d))])
X, Y, Z = np.eye(3)


def boxes(*spans: tuple[tuple[float, float], tuple[float, float], tuple[float, float]]) -> tuple[np.ndarray, ...]:
    """Return vertices, faces and caps (none) of boxes of given spans along x, y and z."""
    vertices = np.array([[x, y, z] for sx, sy, sz in spans for x in sx for y in sy for z in sz], dtype=float)
    faces = np.concatenate([FACES + 8 * k for k in range(len(spans))])
    return vertices, faces, np.zeros(len(faces), dtype=bool)


CUBE = boxes(((-1, 1), (-1, 1), (-1, 1)))
PAIR = boxes(((-5, -1), (-1, 1), (-2, 2)), ((2, 6), (-1, 1), (-2, 2)))
BETWEEN = boxes(((-5, -3), (-1, 1), (-2, 2)), ((3, 5), (-1, 1), (-2, 2)), ((-1, 1), (-1.5, 1.5), (-2, 2)))


def test_a_section_of_a_cube_is_a_square() -> None:
    vertices, faces, capped = CUBE
    points, keys, face = section.plane_segments(vertices, faces, vertices @ Z, 0.25)
    assert len(points) == 8  # two triangles on each of four sides
    np.testing.assert_allclose(points[..., 2], 0.25)
    assert np.linalg.norm(points[:, 1] - points[:, 0], axis=1).sum() == pytest.approx(8.0)
    assert set(np.unique(keys, return_counts=True)[1]) == {2}
    assert len(set(face.tolist())) == 8
    walk, offsets = section.chain_segments(keys)
    assert offsets.tolist() == [0, 8]
    assert sorted(walk >> 1) == list(range(8))
    ends = points.reshape(-1, 3)
    np.testing.assert_allclose(ends[walk ^ 1], ends[np.roll(walk, -1)], atol=1e-15)  # each ends where the next begins
    ring, starts, on_cap = section.resample_chains(points, face, capped, walk, offsets, 0.5)
    assert starts.tolist() == [0, 16]
    np.testing.assert_allclose(np.abs(ring[:, :2]).max(axis=1), 1.0)
    assert (np.linalg.norm(ring - np.roll(ring, 1, axis=0), axis=1) <= 0.5 + 1e-12).all()
    assert not on_cap.any()
    assert len(section.plane_segments(vertices, faces, vertices @ Z, 5.0)[0]) == 0


def test_an_open_mesh_gives_an_open_chain_and_caps_are_known() -> None:
    vertices, faces, _ = CUBE
    opened = np.delete(faces, [4, 5], axis=0)  # without the side y = −1
    points, keys, _ = section.plane_segments(vertices, opened, vertices @ Z, 0.25)
    walk, offsets = section.chain_segments(keys)
    assert offsets.tolist() == [0, 6]
    ends = points.reshape(-1, 3)
    assert {float(ends[walk[0], 1]), float(ends[walk[-1] ^ 1, 1])} == {-1.0}
    np.testing.assert_allclose(ends[walk[:-1] ^ 1], ends[walk[1:]])
    capped = (vertices[opened][:, :, 0] == 1.0).all(axis=1)
    ring, starts, on_cap = section.contour_map(vertices, opened, capped, vertices @ Z, 0.25, 0.2)
    assert starts[-1] == 30
    np.testing.assert_array_equal(on_cap[(np.abs(ring[:, 1]) < 0.99)], ring[np.abs(ring[:, 1]) < 0.99, 0] == 1.0)
    assert on_cap.any()


def test_a_chain_of_no_length_stays_in_place() -> None:
    points = np.ones((1, 2, 3))
    ring, starts, _ = section.resample_chains(
        points, np.zeros(1, np.int64), np.zeros(1, bool), np.zeros(1, np.int64), np.array([0, 1]), 0.5
    )
    assert starts.tolist() == [0, 3]
    np.testing.assert_array_equal(ring, 1.0)


def test_nearest_points_and_components_of_two_boxes() -> None:
    vertices, faces, capped = PAIR
    points, starts, _ = section.contour_map(vertices, faces, capped, vertices @ Z, 0.1, 0.25)
    least, nearest = section.nearest_between(points, starts)
    gaps = np.linalg.norm(points[: starts[1], None] - points[None, starts[1] :], axis=2)
    assert least[0, 1] == least[1, 0] == pytest.approx(gaps.min() ** 2)
    assert least[0, 1] == pytest.approx(9.0, abs=0.1)
    assert np.linalg.norm(points[nearest[0, 1]] - points[nearest[1, 0]]) == pytest.approx(math.sqrt(least[0, 1]))
    assert section.merge_chains(least, 2.0)[1] == 2
    label, count = section.merge_chains(least, 3.5)
    assert (label.tolist(), count) == ([0, 0], 1)
    far = np.array([[np.inf, 9, 1], [9, np.inf, 16], [1, 16, np.inf]])
    assert section.merge_chains(far, 2.0)[0].tolist() == [0, 1, 0]


def test_pairs_join_the_nearest_points_unless_something_lies_between() -> None:
    vertices, faces, capped = PAIR
    pairs = section.section_pairs(vertices, faces, capped, vertices @ Z, 0.1, X, Y, 0.75)
    assert pairs.shape == (1, 2, 3)
    np.testing.assert_allclose(np.sort(pairs[0, :, 0]), [-1.0, 2.0], atol=1e-12)
    on_cap = (vertices[faces][:, :, 0] == 2.0).all(axis=1)
    assert len(section.section_pairs(vertices, faces, on_cap, vertices @ Z, 0.1, X, Y, 0.75)) == 0
    assert len(section.section_pairs(*CUBE, CUBE[0] @ Z, 0.1, X, Y, 0.75)) == 0
    vertices, faces, capped = BETWEEN
    pairs = section.section_pairs(vertices, faces, capped, vertices @ Z, 0.1, X, Y, 0.75)
    assert len(pairs) == 2  # of three, the outer two see each other only through the middle one
    assert (np.abs(pairs[:, :, 0]).min(axis=1) == 1.0).all()


def test_stacks_of_planes_find_the_same_pair_in_each() -> None:
    vertices, faces, capped = PAIR
    normals, first, second = np.array([Z, X]), np.array([X, Y]), np.array([Y, Z])
    pairs, direction, found = section.stack_pairs(vertices, faces, capped, normals, first, second, 1.0, 0.75, 10)
    assert found == len(pairs) == 4  # four planes over 4 mm of height; planes across x never meet both boxes
    assert (direction == 0).all()
    np.testing.assert_allclose(pairs[:, 0, 2], [-1.5, -0.5, 0.5, 1.5], atol=1e-12)
    kept, _, found = section.stack_pairs(vertices, faces, capped, normals, first, second, 1.0, 0.75, 3)
    assert (len(kept), found) == (3, 4)


def test_turning_of_a_circle_is_its_curvature_and_caps_are_left_out() -> None:
    angles = 2 * math.pi * np.arange(120) / 120
    ring = 4.0 * np.stack([np.cos(angles), np.sin(angles), 0 * angles], axis=1)
    starts, label, none = np.array([0, 120]), np.zeros(1, np.int64), np.zeros(120, bool)
    spacing = 2 * 4.0 * math.sin(math.pi / 120)
    turning = section.loop_curvature(ring, starts, none, label, 0, 3, 3 * spacing)
    assert turning == pytest.approx(1 / 4.0, rel=1e-3)
    assert section.loop_curvature(ring, starts, ~none, label, 0, 3, 3 * spacing) == 0.0
    assert section.loop_curvature(ring, starts, none, label, 1, 3, 3 * spacing) == 0.0
    assert section.loop_curvature(ring[:6], np.array([0, 6]), none[:6], label, 0, 3, 1.0) == 0.0


def test_a_pair_weighs_by_the_bend_that_joins_it() -> None:
    # A torus about y: sections across z give two discs, and the plane of the ring joins them by a circle.
    long, short, turns, sides = 5.0, 1.5, 48, 12
    t, s = np.meshgrid(2 * math.pi * np.arange(turns) / turns, 2 * math.pi * np.arange(sides) / sides, indexing="ij")
    reach = long + short * np.cos(s)
    vertices = np.stack([reach * np.cos(t), short * np.sin(s), reach * np.sin(t)], axis=-1).reshape(-1, 3)
    i, j = np.meshgrid(np.arange(turns), np.arange(sides), indexing="ij")
    a, b = i * sides + j, i * sides + (j + 1) % sides
    c, d = (i + 1) % turns * sides + j, (i + 1) % turns * sides + (j + 1) % sides
    faces = np.concatenate([np.stack([a, b, c], -1), np.stack([b, d, c], -1)]).reshape(-1, 3)
    capped = np.zeros(len(faces), bool)
    pair = np.array([[[-3.5, 0, 0.3], [3.5, 0, 0.3]]])
    # Across the plane that found it, p₂ holds both circles of the ring's section; the inner one, radius 3.5, holds it.
    weight = section.pair_weights(vertices, faces, capped, pair, np.array([Z]), 1.2)
    assert weight[0] == pytest.approx(1 / 3.5, rel=0.1)
    # Two boxes are joined nowhere; a pair along the normal has no p₂; a pair above all has no section.
    vertices, faces, capped = PAIR
    pairs = np.array([[[-1.0, 0, 0], [2, 0, 0]], [[0, 0, 0], [0, 0, 1]], [[-1.0, 9, 0], [2, 9, 0]]])
    weights = section.pair_weights(vertices, faces, capped, pairs, np.array([Z, Z, Z]), 0.75)
    assert weights.tolist() == [0.0, 0.0, 0.0]
