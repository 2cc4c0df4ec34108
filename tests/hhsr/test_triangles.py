"""TriangleTree against brute force, closed forms, and inputs made to hit vertices, edges and planes."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st

from hhsr.errors import InputError
from hhsr.kernels import predicates
from hhsr.triangle_tree import TriangleTree


def voxel_surface(filled: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return the closed triangles around the filled unit voxels; all corners on integers."""
    corners, faces = [], []
    padded = np.pad(filled, 1)
    for axis in range(3):
        for sign in (1, -1):
            open_side = padded & ~np.roll(padded, -sign, axis)
            u, v = (axis + 1) % 3, (axis + 2) % 3
            if sign < 0:
                u, v = v, u
            for cell in np.argwhere(open_side) - 1:
                base = cell.astype(float)
                base[axis] += sign > 0
                eu, ev = np.eye(3)[u], np.eye(3)[v]
                k = len(corners)
                corners += [base, base + eu, base + eu + ev, base + ev]
                faces += [[k, k + 1, k + 2], [k, k + 2, k + 3]]
    return np.array(corners), np.array(faces)


@pytest.fixture(scope="module")
def lumpy() -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(4, radius=30.0)
    mesh.vertices *= 1.0 + 0.3 * np.sin(mesh.vertices[:, :1] / 5.0)
    return mesh


def test_closest_matches_brute_force(lumpy: trimesh.Trimesh) -> None:
    rng = np.random.default_rng(1)
    points = rng.uniform(-45, 45, (60, 3))
    distance, nearest, face = TriangleTree(lumpy.vertices, lumpy.faces).closest(points)
    _, expected, _ = trimesh.proximity.closest_point_naive(lumpy, points)
    np.testing.assert_allclose(distance, expected, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(points - nearest, axis=1), distance, atol=1e-12)
    on_face = trimesh.triangles.closest_point(lumpy.triangles[face], nearest)
    np.testing.assert_allclose(on_face, nearest, atol=1e-12)


def test_closest_on_needles_and_points() -> None:
    vertices = np.array([[0, 0, 0], [10, 0, 0], [10, 1e-9, 0], [3, 3, 3], [20, 0, 0]], dtype=float)
    tree = TriangleTree(vertices, [[0, 1, 2], [3, 3, 3], [0, 1, 4]])
    distance, nearest, _ = tree.closest([[5, 2, 0], [3, 3, 4], [25, 0, 0], [5, 0, 0]])
    np.testing.assert_allclose(distance, [2, 1, 5, 0], atol=1e-8)
    np.testing.assert_allclose(nearest, [[5, 0, 0], [3, 3, 3], [20, 0, 0], [5, 0, 0]], atol=1e-8)


def test_inside_matches_winding_number(lumpy: trimesh.Trimesh) -> None:
    rng = np.random.default_rng(2)
    points = rng.uniform(-40, 40, (300, 3))
    inside = TriangleTree(lumpy.vertices, lumpy.faces).contains(points)
    np.testing.assert_array_equal(inside, winding_number(lumpy.triangles, points) > 0.5)


def winding_number(triangles: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Return the generalised winding number by the sum of solid angles (Van Oosterom and Strackee 1983)."""
    a, b, c = (triangles[None, :, k] - points[:, None] for k in range(3))
    la, lb, lc = (np.linalg.norm(x, axis=-1) for x in (a, b, c))
    numerator = np.einsum("ijk,ijk->ij", a, np.cross(b, c))
    denominator = (
        la * lb * lc
        + np.einsum("ijk,ijk->ij", a, b) * lc
        + np.einsum("ijk,ijk->ij", b, c) * la
        + np.einsum("ijk,ijk->ij", c, a) * lb
    )
    return np.arctan2(numerator, denominator).sum(axis=1) / (2.0 * np.pi)


@settings(max_examples=60, deadline=None)
@given(st.integers(0, 2**27 - 1), st.integers(0, 2**32 - 1))
def test_voxels_through_vertices_and_edges(bits: int, seed: int) -> None:
    filled = np.array([(bits >> i) & 1 for i in range(27)], dtype=bool).reshape(3, 3, 3)
    if not filled.any():
        filled[1, 1, 1] = True
    tree = TriangleTree(*voxel_surface(filled))
    rng = np.random.default_rng(seed)
    middles = np.argwhere(np.ones((5, 5, 5), dtype=bool)) - 0.5 - 1.0 + 1e-300
    cell = np.floor(middles).astype(int)
    within = ((cell >= 0) & (cell < 3)).all(axis=1)
    expected = np.zeros(len(middles), dtype=bool)
    expected[within] = filled[tuple(cell[within].T)]
    np.testing.assert_array_equal(tree.contains(middles), expected)
    # Segments on the lattice run along edges, through vertices, within faces; half steps add the diagonals' middles.
    starts = rng.integers(-2, 10, (100, 3)) / 2.0
    ends = rng.integers(-2, 10, (100, 3)) / 2.0
    starts[:, rng.integers(3)] = -1.5
    ends[::2, rng.integers(3)] = 4.5
    crossings = tree.crossings(starts, ends)
    count = np.diff(crossings.offsets)
    free = ~on_lattice_surface(starts) & ~on_lattice_surface(ends)
    odd = tree.contains(starts) ^ tree.contains(ends)
    np.testing.assert_array_equal((count % 2 == 1)[free], odd[free])
    for i in range(len(starts)):
        t = crossings.t[crossings.offsets[i] : crossings.offsets[i + 1]]
        assert (np.diff(t) >= 0).all()


def on_lattice_surface(points: np.ndarray) -> np.ndarray:
    """Return which points might lie on a voxel's boundary: some coordinate is an integer."""
    return (points == np.round(points)).any(axis=1)


def test_lattice_point_on_the_surface_is_inside() -> None:
    tree = TriangleTree(*voxel_surface(np.ones((1, 1, 1), dtype=bool)))
    on = [[0, 0, 0], [1, 1, 1], [0.5, 0.5, 1], [0.5, 0, 0], [0.25, 0.75, 0]]
    assert tree.contains(on).all()
    assert not tree.contains([[0, 0, 1.0000001], [-1e-300, 0.5, 0.5], [2, 0, 0]]).any()


def test_crossings_are_complete_and_alternate(lumpy: trimesh.Trimesh) -> None:
    rng = np.random.default_rng(3)
    tree = TriangleTree(lumpy.vertices, lumpy.faces)
    vertices = lumpy.vertices
    # Through two vertices of the mesh, so that every segment meets vertices exactly (up to rounding of the ends).
    a, b = vertices[rng.integers(0, len(vertices), (2, 500))]
    far = np.linalg.norm(b - a, axis=1) > 1.0
    a, b = a[far], b[far]
    direction = (b - a) / np.linalg.norm(b - a, axis=1, keepdims=True)
    crossings = tree.crossings(a - 200 * direction, b + 200 * direction)
    assert (np.diff(crossings.offsets) % 2 == 0).all()
    for i in range(len(a)):
        entering = crossings.entering[crossings.offsets[i] : crossings.offsets[i + 1]]
        np.testing.assert_array_equal(entering, np.arange(len(entering)) % 2 == 0)


def test_first_hit_is_the_first_crossing(lumpy: trimesh.Trimesh) -> None:
    rng = np.random.default_rng(4)
    tree = TriangleTree(lumpy.vertices, lumpy.faces)
    origins, directions = rng.uniform(-60, 60, (400, 3)), rng.normal(size=(400, 3))
    t, face = tree.first_hit(origins, directions)
    crossings = tree.crossings(origins, origins + 300 * directions)
    some = np.diff(crossings.offsets) > 0
    np.testing.assert_array_equal(face >= 0, some)
    np.testing.assert_allclose(t[some], 300 * crossings.t[crossings.offsets[:-1][some]], rtol=1e-9, atol=1e-9)
    assert np.isnan(t[~some]).all()
    near, _ = tree.first_hit(origins, directions, max_t=5.0)
    np.testing.assert_array_equal(np.isnan(near[some]), t[some] > 5.0)


def test_threads_change_nothing(lumpy: trimesh.Trimesh, monkeypatch: pytest.MonkeyPatch) -> None:
    points = np.random.default_rng(5).uniform(-45, 45, (6000, 3))
    tree = TriangleTree(lumpy.vertices, lumpy.faces)
    monkeypatch.setattr("hhsr.batches.numba.get_num_threads", lambda: 1)
    one = tree.closest(points)[0], tree.contains(points)
    monkeypatch.setattr("hhsr.batches.numba.get_num_threads", lambda: 2)
    two = tree.closest(points)[0], tree.contains(points)
    np.testing.assert_array_equal(one[0], two[0])
    np.testing.assert_array_equal(one[1], two[1])


def test_skewed_sizes_keep_the_tree_shallow() -> None:
    base = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0]], dtype=float)
    scale = 2.0 ** np.arange(-100, 100, 0.1)
    vertices = np.concatenate([base * s + s for s in scale])
    tree = TriangleTree(vertices, np.arange(len(vertices)).reshape(-1, 3))
    distance, _, face = tree.closest(scale[::100, None] * (base.mean(axis=0) + 1))
    assert (distance <= 1e-12 * scale[::100]).all()
    np.testing.assert_array_equal(face, np.arange(0, len(scale), 100))


def test_bad_input_is_named() -> None:
    with pytest.raises(InputError, match="faces"):
        TriangleTree(np.zeros((3, 3)), np.zeros((2, 4), dtype=int))
    with pytest.raises(InputError, match="indices 0 … 3"):
        TriangleTree(np.eye(3), [[0, 1, 3]])
    with pytest.raises(InputError, match="not finite"):
        TriangleTree(np.full((3, 3), np.nan), [[0, 1, 2]])
    tree = TriangleTree(np.eye(3), [[0, 1, 2]])
    with pytest.raises(InputError, match="one end for each"):
        tree.crossings(np.zeros((2, 3)), np.zeros((3, 3)))
    assert tree.closest(np.zeros((0, 3)))[0].shape == (0,)
    assert tree.closest(np.zeros((4, 2, 3)))[1].shape == (4, 2, 3)


def test_no_triangles_hold_and_meet_nothing() -> None:
    tree = TriangleTree(np.zeros((0, 3)), np.zeros((0, 3), dtype=int))
    assert not tree.contains(np.eye(3)).any()
    assert (tree.closest(np.eye(3))[0] == np.inf).all()
    assert len(tree.crossings(np.eye(3), -np.eye(3)).t) == 0
    assert np.isnan(tree.first_hit(np.eye(3), np.eye(3))[0]).all()


# Exact as long as no product of three underflows: coordinates are 0 or at least 1e-30 mm.
coordinates = st.integers(-3, 3).map(lambda i: i * 0.1) | st.floats(-1e3, 1e3).map(
    lambda x: x if abs(x) > 1e-30 else 0.0
)


@settings(max_examples=200, deadline=None)
@given(st.lists(coordinates, min_size=12, max_size=12))
def test_determinant_signs_are_exact(numbers: list[float]) -> None:
    a, b, c, o = np.array(numbers).reshape(4, 3)
    d = c * 0.5 + b * 0.5 if numbers[0] > 0 else c  # nearly, and often exactly, flat
    exact = [[Fraction(x) - Fraction(y) for x, y in zip(row, o, strict=True)] for row in (a, b, d)]
    det = (
        exact[0][0] * (exact[1][1] * exact[2][2] - exact[1][2] * exact[2][1])
        - exact[0][1] * (exact[1][0] * exact[2][2] - exact[1][2] * exact[2][0])
        + exact[0][2] * (exact[1][0] * exact[2][1] - exact[1][1] * exact[2][0])
    )
    assert predicates.det3_sign(a, b, d, o) == (det > 0) - (det < 0)
    minor = exact[0][1] * exact[1][2] - exact[0][2] * exact[1][1]
    assert predicates.det2_sign(a, o, b, o, 1, 2) == (minor > 0) - (minor < 0)
