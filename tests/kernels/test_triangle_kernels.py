"""The kernels over triangles on inputs small enough to run without compilation."""

from __future__ import annotations

from fractions import Fraction
from itertools import pairwise

import numpy as np
import pytest

from hhsr.kernels import predicates, triangles
from hhsr.kernels.mesh_edges import number_edges
from hhsr.kernels.triangle_build import STACK, build

OCTAHEDRON = np.array([[1, 0, 0], [-1, 0, 0], [0, 1, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1]], dtype=float) * 8
OCTANTS = np.array([[0, 2, 4], [2, 1, 4], [1, 3, 4], [3, 0, 4], [2, 0, 5], [1, 2, 5], [3, 1, 5], [0, 3, 5]])


def shells(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Return octahedra of radius 8 side by side along x, 20 apart."""
    vertices = np.concatenate([OCTAHEDRON + np.array([20.0 * i, 0, 0]) for i in range(count)])
    return vertices, np.concatenate([OCTANTS + 6 * i for i in range(count)])


def exact_sign(rows: list[list[Fraction]]) -> int:
    (a, b, c), (d, e, f), (g, h, i) = rows
    det = a * (e * i - f * h) - b * (d * i - f * g) + c * (d * h - e * g)
    return (det > 0) - (det < 0)


@pytest.mark.parametrize("seed", range(8))
def test_signs_of_flat_and_nearly_flat_corners(seed: int) -> None:
    rng = np.random.default_rng(seed)
    o, a, b = rng.normal(size=(3, 3)) * 10
    c = o + 0.3 * (a - o) + 0.7 * (b - o)
    for bump in (0.0, 1e-16, -1e-15, 1e-3, -1e-3):
        d = c + bump
        rows = [[Fraction(x) - Fraction(y) for x, y in zip(p, o, strict=True)] for p in (a, b, d)]
        assert predicates.det3_sign(a, b, d, o) == exact_sign(rows)
        minor = rows[0][0] * rows[2][1] - rows[0][1] * rows[2][0]
        assert predicates.det2_sign(a, o, d, o, 0, 1) == (minor > 0) - (minor < 0)
    on_line = o + 3.0 * (a - o)
    expected = [[Fraction(x) - Fraction(y) for x, y in zip(p, o, strict=True)] for p in (a, on_line)]
    minor = expected[0][0] * expected[1][1] - expected[0][1] * expected[1][0]
    assert predicates.det2_sign(a, o, on_line, o, 0, 1) == (minor > 0) - (minor < 0)


def test_ties_have_a_side_unless_parallel() -> None:
    o, x, y, z = np.zeros(3), *np.eye(3)
    assert predicates.det3_sign(x, y, x + y, o) == 0
    assert predicates.plane_side(o, x, y, x + y) == 1  # moved by (ε, ε², ε³): above z = 0
    assert predicates.plane_side(o, y, z, y + z) == 1
    assert predicates.plane_side(o, x, x, y) == 0
    assert predicates.line_side(o, x, y, y + x) == 0
    assert {predicates.line_side(o, x, a, b) for a, b in ((o, y), (y, o))} == {-1, 1}
    assert predicates.column_side(x, y, o) == 1
    assert predicates.column_side(y, x, o) == -1
    assert predicates.column_side(-y, y, o) == -1
    assert predicates.column_side(y, -y, o) == 1
    assert predicates.column_side(-x, x, o) == 1
    assert predicates.column_side(x, -x, o) == -1
    assert predicates.column_side(z, -z, o) == 0
    assert predicates.column_side(np.array([0.1, 0.1, 0]), np.array([0.3, 0.3, 0]), np.array([0.2, 0.2, 0])) != 0


def test_tree_holds_every_triangle_once_within_its_boxes() -> None:
    vertices, faces = shells(5)
    boxes, links, corners, order = build(vertices, faces)
    assert sorted(order) == list(range(40))
    np.testing.assert_array_equal(corners, vertices[faces[order]])
    seen = 0
    for box, (first, count) in zip(boxes, links, strict=True):
        seen += count
        inside = corners[first : first + count].reshape(-1, 3)
        assert (inside >= box[:3]).all()
        assert (inside <= box[3:]).all()
    assert seen == 40
    # Triangles that all coincide cannot be told apart by any plane.
    boxes, links, _, _ = build(vertices, np.repeat(faces[:1], 9, axis=0))
    assert links[:, 1].sum() == 9
    assert len(build(vertices, faces[:0])[3]) == 0


def test_nearest_by_brute_force() -> None:
    tree = build(*shells(3))
    rng = np.random.default_rng(0)
    points = rng.uniform(-12, 52, (25, 3)) * [1, 0.3, 0.3]
    distance, nearest, face = np.empty(25), np.empty((25, 3)), np.empty(25, dtype=np.int64)
    triangles.nearest_points(*tree, points, distance, nearest, face)
    all_pairs = [[triangles.triangle_distance2(c, *p)[0] for c in tree[2]] for p in points]
    np.testing.assert_allclose(distance**2, np.min(all_pairs, axis=1))
    np.testing.assert_allclose(np.linalg.norm(points - nearest, axis=1), distance)
    stack, keys = np.empty(STACK, dtype=np.int64), np.empty(STACK)
    assert triangles.nearest_triangle(*tree[:3], 0.0, 0.0, 30.0, 1.0, -1, stack, keys)[0] == -1
    flat = np.array([[0, 0, 0], [4, 0, 0], [2, 0, 0]], dtype=float)
    assert triangles.triangle_distance2(flat, 1.0, 2.0, 0.0)[0] == pytest.approx(4.0)
    point = np.ones((3, 3))
    assert triangles.triangle_distance2(point, 1.0, 1.0, 3.0)[0] == pytest.approx(4.0)


def test_parity_inside_outside_and_on() -> None:
    tree = build(*shells(3))
    points = np.array([[0, 0, 0], [20, 1, 1], [10, 0, 0], [0, 0, 8], [0, 0, 8.1], [0, 0, -9], [4, 4, 0], [40, 0, -7.9]])
    inside = np.empty(8, dtype=np.bool_)
    triangles.inside_points(*tree[:3], points.astype(float), inside)
    np.testing.assert_array_equal(inside, [True, True, False, True, False, False, True, True])


def test_crossings_through_vertices_edges_and_faces() -> None:
    tree = build(*shells(9))
    starts = np.array([[-20, 0, 0], [0, 0, -20], [-20, 4, 0], [0, 20, 0.5], [1, 1, 20], [2, -20, 0], [0, 0, 0]], float)
    ends = np.array([[200, 0, 0], [0, 0, 20], [200, 4, 0], [0, -20, 0.5], [1, 1, 20.5], [2, 20, 0], [0, 0, 20]], float)
    offsets, t, face, out = triangles.all_crossings(*tree, starts, ends)
    np.testing.assert_array_equal(np.diff(offsets), [18, 2, 18, 2, 0, 2, 1])
    for first, last in pairwise(offsets):
        assert (np.diff(t[first:last]) >= 0).all()
        assert (out[first:last][1:] != out[first:last][:-1]).all()
    assert (face < 72).all()
    hit, where = np.empty(7), np.empty(7, dtype=np.int64)
    triangles.first_crossings(*tree, starts, ends, hit, where)
    for i in range(7):
        if offsets[i] == offsets[i + 1]:
            assert np.isnan(hit[i])
            assert where[i] == -1
        else:
            assert hit[i] == pytest.approx(t[offsets[i]], abs=1e-12)
    # Forty shells: more crossings than the first scratch has room for.
    many = triangles.all_crossings(*build(*shells(40)), np.array([[-20.0, 0.1, 0.2]]), np.array([[900.0, 0.1, 0.2]]))
    assert many[0][1] == 80


def test_tied_crossings_are_ordered_to_alternate() -> None:
    for out, expected in (([1, -1, -1, 1], [-1, 1, -1, 1]), ([1, 1, -1], [1, -1, 1]), ([1, 1], [1, 1])):
        t, signs = np.array([0.2, 0.2, 0.4, 0.5])[: len(out)], np.array(out, dtype=np.int8)
        if out == [1, 1, -1]:
            t = np.array([0.2, 0.5, 0.5])
        triangles.sort_crossings(t, np.arange(len(out)), signs, len(out))
        np.testing.assert_array_equal(signs, expected)


def test_edges_are_numbered_once() -> None:
    edges, of_face = number_edges(OCTANTS, 6)
    assert len(edges) == 12
    assert (edges[:, 0] < edges[:, 1]).all()
    for face, numbers in zip(OCTANTS, of_face, strict=True):
        for k in range(3):
            assert set(edges[numbers[k]]) == {face[k], face[(k + 1) % 3]}
