"""The least-squares kernels of the fit against numpy on systems of a few rows."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numba import config

from hhsr.kernels import field_rows, lookahead, plane_moves, refinement, selection
from hhsr.kernels import greedy as greedy_kernels
from hhsr.kernels.sphere_rbf import wendland_gaussian
from hhsr.kernels.triangle_build import build
from hhsr.model import CentreGrid

GRID = CentreGrid((12, 40), 2.0)
EDGE = 3
RIDGE = np.full(GRID.size, 1e-3)


def rows_of(u: np.ndarray, grid: CentreGrid = GRID) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the compressed rows of a dictionary."""
    levels = np.concatenate([[0], np.cumsum(grid.sizes)])
    cells = selection.atoms_of_cells(grid.centres, levels, grid.extents[levels[:-1]].copy(), EDGE)
    rows: tuple[np.ndarray, np.ndarray, np.ndarray] = selection.dictionary_rows(
        u, grid.centres, 1.0 / grid.extents, EDGE, *cells
    )
    return rows


def directions(count: int, seed: int = 0) -> np.ndarray:
    u = np.random.default_rng(seed).normal(size=(count, 3))
    u /= np.linalg.norm(u, axis=1)[:, None]
    u[:2] = [[0.0, 0.0, 1.0], [0.0, 0.0, -1.0]]
    return u


def dense_rows(u: np.ndarray, centres: np.ndarray, extents: np.ndarray) -> np.ndarray:
    """Return (n, k) λ of every direction and centre."""
    h = (1.0 - u @ centres.T) / extents
    return np.where(h < 1.0, np.exp(-4.0 * h) * (1.0 - h) ** 2, 0.0)


def dense_of(pointer: np.ndarray, index: np.ndarray, value: np.ndarray, columns: int) -> np.ndarray:
    out = np.zeros((len(pointer) - 1, columns))
    for i in range(len(out)):
        np.add.at(out[i], index[pointer[i] : pointer[i + 1]], value[pointer[i] : pointer[i + 1]])
    return out


def test_three_ways_to_the_same_rows() -> None:
    u = directions(25)
    expected = dense_rows(u, GRID.centres, GRID.extents)
    found = rows_of(u)
    np.testing.assert_allclose(dense_of(*found, GRID.size), expected, atol=1e-7)
    found = field_rows.sparse_rows(u, GRID.centres, 1.0 / GRID.extents)
    np.testing.assert_allclose(dense_of(*found, GRID.size), expected, atol=1e-12)
    found = refinement.chosen_rows(u, GRID.centres, GRID.extents)
    np.testing.assert_allclose(dense_of(*found, GRID.size), expected, atol=1e-12)
    weights = np.random.default_rng(1).normal(size=GRID.size)
    np.testing.assert_allclose(field_rows.row_products(*found, weights), expected @ weights, atol=1e-12)
    np.testing.assert_allclose(refinement.field_values(*found, weights), expected @ weights, atol=1e-12)
    squares = field_rows.column_squares(*found, GRID.size)
    np.testing.assert_allclose(squares, (expected**2).sum(axis=0), atol=1e-12)


def test_rows_grow_beyond_the_first_room() -> None:
    u = directions(3)
    wide = CentreGrid((200,), 40.0)  # every support is the whole sphere
    expected = dense_rows(u, wide.centres, wide.extents)
    found = rows_of(u, wide)
    assert len(found[2]) > 64 * len(u)
    np.testing.assert_allclose(dense_of(*found, 200), expected, atol=1e-7)
    found = field_rows.sparse_rows(u, wide.centres, 1.0 / wide.extents)
    np.testing.assert_allclose(dense_of(*found, 200), expected, atol=1e-12)


def test_columns_are_the_transposed_rows() -> None:
    found = rows_of(directions(9))
    columns = selection.transposed(*found, GRID.size)
    np.testing.assert_array_equal(dense_of(*columns, 9).T, dense_of(*found, GRID.size))


def test_normal_equations_are_those_of_numpy() -> None:
    rng = np.random.default_rng(2)
    rows = refinement.chosen_rows(directions(20), GRID.centres[:12], GRID.extents[:12])
    a = dense_of(*rows, 12)
    weight, target, slope, dense = rng.random(20), rng.normal(size=20), rng.normal(size=20), rng.normal(size=(20, 3))
    weight[::4] = 0.0
    gram, right = np.zeros((12, 12)), np.zeros(12)
    field_rows.add_normal_equations(*rows, weight, target, gram, right)
    np.testing.assert_allclose(gram, a.T @ (weight[:, None] * a), atol=1e-12)
    np.testing.assert_allclose(right, a.T @ (weight * target), atol=1e-12)
    jacobian = np.concatenate([slope[:, None] * a, dense], axis=1)
    matrix, right = refinement.normal_equations(*rows, slope, dense, target, weight, 12)
    np.testing.assert_allclose(matrix, jacobian.T @ (weight[:, None] * jacobian), atol=1e-12)
    np.testing.assert_allclose(right, -jacobian.T @ (weight * target), atol=1e-12)


@pytest.mark.parametrize("size", [1, 3, 8, 13])
def test_the_upper_factor_is_cholesky_and_solves(size: int) -> None:
    rng = np.random.default_rng(size)
    a = rng.normal(size=(size + 3, size))
    matrix, right = a.T @ a, rng.normal(size=size)
    upper = selection.upper_factor(matrix)
    np.testing.assert_allclose(upper, np.linalg.cholesky(matrix).T, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(selection.solve_upper(upper, right), np.linalg.solve(matrix, right), rtol=1e-8)


def test_solving_and_dropping_are_those_of_numpy() -> None:
    rng = np.random.default_rng(3)
    a = rng.normal(size=(12, 5))
    matrix, right = a.T @ a, rng.normal(size=5)
    np.testing.assert_allclose(selection.solve_normal(matrix, right), np.linalg.solve(matrix, right), rtol=1e-9)
    triangle = np.linalg.cholesky(matrix)
    y = np.linalg.solve(triangle, right)
    np.testing.assert_allclose(
        selection.back_substituted(triangle, y, 3), np.linalg.solve(triangle[:3, :3].T, y[:3]), rtol=1e-9
    )
    # What a dropped unknown costs, by solving again without it: the form wᵀGw − 2 rᵀw, less its least value.
    full = -right @ np.linalg.solve(matrix, right)
    costs = []
    for k in range(5):
        keep = np.delete(np.arange(5), k)
        costs.append(-right[keep] @ np.linalg.solve(matrix[np.ix_(keep, keep)], right[keep]) - full)
    np.testing.assert_allclose(selection.drop_costs(matrix, right), costs, rtol=1e-7)


def selected(
    pointer: np.ndarray,
    index: np.ndarray,
    value: np.ndarray,
    scale: np.ndarray,
    target: np.ndarray,
    columns: int,
    count: int,
    ridge: np.ndarray,
    held: np.ndarray,
    pauses: tuple[int, ...] = (),
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return atoms, gains, triangle and right side of a selection, made in one go or with pauses."""
    seen = selection.transposed(pointer, index, value, columns)
    diagonal, full, pull, usable = greedy_kernels.begin(*seen, scale, target, ridge)
    rest, done = full.copy(), 0
    basis, found = np.zeros((count, columns), np.float32), (np.zeros(count, np.int64), np.zeros(count), np.zeros(count))
    for until in (*pauses, count):
        done = greedy_kernels.extend(
            pointer, index, value, *seen, scale, diagonal, full, usable, rest, pull, basis[:until],
            *(part[:until] for part in found), done, held,
        )  # fmt: skip
    chosen, gains, right = (part[:done] for part in found)
    return chosen, gains, greedy_kernels.triangle_of(basis, chosen), right


def greedy(a: np.ndarray, target: np.ndarray, count: int, ridge: float) -> list[int]:
    """Return the atoms of a forward selection that solves every candidate system afresh."""

    def least(columns: list[int]) -> float:
        g = a[:, columns].T @ a[:, columns] + ridge * np.eye(len(columns))
        r = a[:, columns].T @ target
        return float(-r @ np.linalg.solve(g, r))

    chosen: list[int] = []
    for _ in range(count):
        free = [j for j in range(a.shape[1]) if j not in chosen and (a[:, j] ** 2).sum() > 0]
        chosen.append(min(free, key=lambda j: least([*chosen, j])))
    return chosen


def test_selection_is_the_greedy_one_and_its_weights_solve_the_ridge_problem() -> None:
    rng = np.random.default_rng(4)
    rows = rows_of(directions(60))
    scale, target = rng.uniform(0.5, 2.0, 60), rng.normal(size=60)
    a = scale[:, None] * dense_of(*rows, GRID.size)
    seen = (a**2).sum(axis=0)
    floor = 1e-2 * seen.sum() / (seen > 0).sum()
    none = np.zeros(0, np.int64)
    chosen, gains, triangle, right = selected(*rows, scale, target, GRID.size, 6, np.full(GRID.size, 1e-2), none)
    assert chosen.tolist() == greedy(a, target, 6, floor)
    gram = a[:, chosen].T @ a[:, chosen] + floor * np.eye(6)
    np.testing.assert_allclose(triangle @ triangle.T, gram, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(triangle @ right, a[:, chosen].T @ target, rtol=1e-4, atol=1e-4)
    pull = a[:, chosen].T @ target
    assert gains.sum() == pytest.approx(pull @ np.linalg.solve(gram, pull), rel=1e-4)
    held = np.array([chosen[3], chosen[1]])
    again = selected(*rows, scale, target, GRID.size, 4, 10.0 * RIDGE, held)[0]
    assert again[:2].tolist() == held.tolist()
    assert len(set(again.tolist())) == 4
    paused = selected(*rows, scale, target, GRID.size, 6, np.full(GRID.size, 1e-2), none, pauses=(1, 3))
    assert paused[0].tolist() == chosen.tolist()
    np.testing.assert_allclose(paused[1], gains, rtol=1e-4)


def test_blocks_choose_what_one_by_one_would() -> None:
    # 80 of 2,012 atoms, several blocks, most atoms not looked at in a block: against the textbook's greedy choice.
    grid = CentreGrid((12, 400, 1600), 3.0)
    u = directions(900, 7)
    rows = rows_of(u, grid)
    random = np.random.default_rng(8)
    target = np.cos(u @ random.normal(0.0, 4.0, 3)) + 0.3 * np.cos(u @ random.normal(0.0, 9.0, 3))
    a = dense_of(*rows, grid.size)
    ridge = np.full(grid.size, 1e-5)
    count = 20 if config.DISABLE_JIT else 80
    none = np.zeros(0, np.int64)
    chosen, gains, triangle, right = selected(*rows, np.ones(900), target, grid.size, count, ridge, none)
    floor = 1e-5 * (a**2).sum(axis=0)[(a**2).sum(axis=0) > 0].mean()
    slow: list[int] = []
    lifted = np.vstack([a, math.sqrt(floor) * np.eye(grid.size)])
    rest, left = lifted.copy(), np.concatenate([target, np.zeros(grid.size)])
    fall = []
    for _ in range(count):
        size = (rest**2).sum(axis=0)
        gain = np.where(size > 1e-3 * (lifted**2).sum(axis=0), (rest.T @ left) ** 2 / np.maximum(size, 1e-300), 0.0)
        j = int(gain.argmax())
        slow.append(j)
        fall.append(gain[j])
        axis = rest[:, j] / math.sqrt(size[j])
        rest = rest - np.outer(axis, axis @ rest)
        left = left - axis * (axis @ left)
    assert len(chosen) == count
    assert gains.sum() == pytest.approx(sum(fall), rel=1e-3)
    assert chosen[:16].tolist() == slow[:16]
    np.testing.assert_allclose(triangle @ triangle.T, a[:, chosen].T @ a[:, chosen] + floor * np.eye(count), atol=1e-4)
    np.testing.assert_allclose(triangle @ right, a[:, chosen].T @ target, atol=1e-3)


def test_selection_ends_where_nothing_is_left_to_gain() -> None:
    rows = rows_of(directions(5))
    none = np.zeros(0, np.int64)
    nothing = selected(*rows, np.ones(5), np.zeros(5), GRID.size, 10, np.full(GRID.size, 1e-3), none)
    assert [len(part) for part in nothing] == [0, 0, 0, 0]
    one = (np.array([0, 1, 2]), np.array([0, 0], np.int32), np.array([1.0, 2.0]))  # two rows see one atom of three
    chosen, gains, _, right = selected(*one, np.ones(2), np.array([1.0, 2.0]), 3, 3, np.zeros(3), none)
    assert chosen.tolist() == [0]
    assert gains[0] == pytest.approx(5.0)
    assert right[0] == pytest.approx(math.sqrt(5.0))


def sphere_samples(centre: np.ndarray, radius: float) -> tuple[np.ndarray, np.ndarray]:
    normals = CentreGrid((600,), 2.0).centres
    return centre + radius * normals, np.array(normals)


def test_a_sphere_is_told_best_from_its_centre() -> None:
    centre = np.array([1.0, -2.0, 0.5])
    points, normals = sphere_samples(centre, 10.0)
    order = np.arange(600)
    candidates = centre + np.array([[0.0, 0, 0], [4.0, 0, 0], [0, -6.0, 0]])
    out = lookahead.misfits(points, normals, order, np.zeros((3, 600)), candidates, 2.0)
    assert out[0] < 1e-6
    assert out[0] < out[1] < out[2]
    # A member that the centre does not see costs its gap and is not fitted.
    gaps = np.zeros((3, 600))
    gaps[0, 5] = 7.0
    hidden = lookahead.misfits(points, normals, order, gaps, candidates, 2.0)
    assert hidden[0] == pytest.approx(7.0, abs=1e-6)
    assert hidden[1:].tolist() == out[1:].tolist()


def test_a_cut_between_two_spheres_finds_both_centres() -> None:
    middles = np.array([[-15.0, 0, 0], [15.0, 0, 0]])
    both = [sphere_samples(m, 8.0) for m in middles]
    points, normals = np.concatenate([b[0] for b in both]), np.concatenate([b[1] for b in both])
    order = np.arange(1200)
    candidates = np.concatenate([middles + np.array([0.0, 3.0, 0.0]), middles])
    along = np.array([[1.0, 0, 0], [0, 1.0, 0]])
    misfit, which = lookahead.best_centres(
        points, normals, order, np.zeros((4, 1200)), along @ points.T, np.array([[0.0, 40.0], [0.0, 40.0]]),
        candidates, along @ candidates.T, 2.0,
    )  # fmt: skip
    assert which[0, 0].tolist() == [2, 3]  # the middles themselves, left and right of x = 0
    assert (misfit[0, 0] < 1e-6).all()
    assert which[:, 1, 1].tolist() == [-1, -1]  # no candidate lies beyond 40 mm
    assert np.isinf(misfit[:, 1, 1]).all()
    assert (misfit[:, 1, 0] > 1.0).all()  # one centre for both spheres


def test_each_side_of_a_cut_is_judged_as_if_it_were_a_part() -> None:
    points, normals = sphere_samples(np.zeros(3), 10.0)
    points = points * (1.0, 0.7, 1.6)
    order = np.arange(0, 600, 2)
    rng = np.random.default_rng(4)
    candidates = rng.normal(size=(5, 3)) * 2.0
    gaps = np.where(rng.random((5, 300)) < 0.1, rng.random((5, 300)), 0.0)
    along = directions(6)
    heights, inside = along @ points[order].T, along @ candidates.T
    planes = np.sort(rng.normal(size=(6, 4)) * 4.0, axis=1)
    for power in (1.0, 1.5):
        misfit, which = lookahead.best_centres(points, normals, order, gaps, heights, planes, candidates, inside, power)
        for d, k in np.ndindex(6, 4):
            for side, members in enumerate((heights[d] < planes[d, k], heights[d] >= planes[d, k])):
                held = (inside[d] > planes[d, k]) == bool(side)
                whole = lookahead.misfits(points, normals, order[members], gaps[:, members].copy(), candidates, power)
                assert misfit[d, k, side] == pytest.approx(whole[held].min(initial=np.inf))
                assert which[d, k, side] == (np.where(held, whole, np.inf).argmin() if held.any() else -1)


def test_a_plane_between_three_spheres_is_judged_by_all_of_them() -> None:
    middles = np.array([[-20.0, 0, 0], [0.0, 20.0, 0], [20.0, 0, 0]])
    parts = [sphere_samples(m, 8.0) for m in middles]
    points, slopes = np.concatenate([b[0] for b in parts]), np.concatenate([b[1] for b in parts])
    normals, offsets = np.array([[1.0, 0, 0], [0, 1.0, 0]]), np.array([10.0, 10.0])
    children = np.array([[1, -1], [-2, -3]])  # above the first plane leaf 0; below and above the second leaves 1 and 2
    owner = plane_moves.leaves_of(points, normals, offsets, children)
    assert owner.tolist() == np.repeat([1, 2, 0], 600).tolist()
    assert (
        plane_moves.leaves_of(points[:3], np.zeros((0, 3)), np.zeros(0), np.zeros((0, 2), np.int64)).tolist() == [0] * 3
    )
    centres, gaps = middles[[2, 0, 1]], np.zeros((3, 1800))
    gaps[1, 0] = 5.0
    places = np.array([[0, 1.0, 0], [0, 1.0, 0], [0, 1.0, 0], [0, -1.0, 0]])
    heights = np.array([10.0, 16.0, 30.0, -10.0])
    found = plane_moves.misfits_of_places(
        points, slopes, gaps, centres, normals, offsets, children, 1, places, heights, 10, 1.0
    )
    assert found[0] == pytest.approx(5.0, abs=1e-3)  # spheres from their middles, and one sample that is not seen
    assert found[1] > 10.0  # a slice of the upper sphere goes to the left one's leaf
    assert np.isinf(found[2:]).all()  # a leaf loses its samples; two centres change sides
    few = plane_moves.misfits_of_places(
        points, slopes, gaps, centres, normals, offsets, children, 1, places[:1], heights[:1], 601, 1.0
    )
    assert np.isinf(few).all()


def test_gaussian_of_the_rows_is_the_leaf_one() -> None:
    u = directions(4)
    _, _, value = refinement.chosen_rows(u, u[3:], np.array([2.5]))
    expected = [wendland_gaussian((1 - v @ u[3]) / 2.5) for v in u if 1 - v @ u[3] < 2.5]
    np.testing.assert_allclose(value, expected, rtol=1e-12)


def test_an_ellipsoid_and_its_slopes_are_those_of_differences() -> None:
    u, axes = directions(30), np.array([3.0, 1.5, 2.0, 2.5, 1.0, 4.0])
    radii = refinement.ellipsoid_radii(axes, u)
    seen = np.where(u >= 0.0, axes[0::2], axes[1::2])
    np.testing.assert_allclose(((radii[:, None] * u / seen) ** 2).sum(axis=1), 1.0, rtol=1e-12)
    slopes = refinement.axis_slopes(axes, u, radii)
    for k in range(6):
        longer = axes * np.exp(1e-6 * (np.arange(6) == k))
        rise = (refinement.ellipsoid_radii(longer, u) - radii) / 1e-6
        np.testing.assert_allclose(slopes[:, k], rise, atol=1e-4)


def test_own_misses_are_signed_distances_and_their_slopes() -> None:
    corners = np.array(
        [[-1.0, -1, -1], [1, -1, -1], [1, 1, -1], [-1, 1, -1], [-1, -1, 1], [1, -1, 1], [1, 1, 1], [-1, 1, 1]]
    )
    faces = np.array([
        [0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7], [0, 1, 5], [0, 5, 4],
        [1, 2, 6], [1, 6, 5], [2, 3, 7], [2, 7, 6], [3, 0, 4], [3, 4, 7],
    ])  # fmt: skip
    boxes, links, triangles, _ = build(corners, faces)
    u = np.array([[1.0, 0, 0], [0.8, 0.6, 0], [0, 0, 1], [0, -1.0, 0], [0.6, 0, 0.8]])
    radius = np.array([0.7, 1.1, 1.5, 0.5, 1.25])
    miss, slope, share = np.full(5, 9.0), np.full(5, 9.0), np.full(5, 9.0)
    normals, offsets = np.array([[0.0, 1.0, 0.0]]), np.array([-0.25])  # y ≥ −0.25: the fourth point lies outside
    nearest = np.array([-1, 3, -1, -1, 0])
    refinement.own_misses(
        boxes, links, triangles, normals, offsets, np.zeros(3), u, radius, 0.2, 1e-9, 2.0, miss, slope, share, nearest
    )
    known = [np.full(5, 9.0) for _ in range(3)]
    assert nearest[3] == -1
    refinement.own_misses(
        boxes, links, triangles, normals, offsets, np.zeros(3), u, radius, 0.2, 1e-9, 2.0, *known, nearest
    )
    assert np.array_equal(known, [miss, slope, share])
    np.testing.assert_allclose(miss, [-0.3, -0.12, 0.5, 9.0, 0.0], atol=1e-12)
    np.testing.assert_allclose(slope, [1.0, 0.8, 1.0, 9.0, 0.8], atol=1e-12)
    np.testing.assert_allclose(share, [2 * 0.49, 2 * 1.21 / 0.8, 4.5, 9.0, 2 * 1.5625 / 0.8], rtol=1e-12)
    grazing = np.array([[0.0, 1.0, 0.0]])
    one = np.array([0.9]), np.zeros(1), np.zeros(1), np.zeros(1)
    refinement.own_misses(
        boxes, links, triangles, np.zeros((0, 3)), np.zeros(0), np.array([0.95, 0.0, 0.0]), grazing, *one[:1],
        0.2, 1e-9, 1.0, *one[1:], np.full(1, -1),
    )  # fmt: skip
    assert one[1][0] == pytest.approx(-0.05)
    assert abs(one[2][0]) == pytest.approx(0.2)  # the nearest wall runs along the ray: the slope is held at 0.2
