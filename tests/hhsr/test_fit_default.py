"""The default fit on bodies whose shape is known, and on one real gland."""

from __future__ import annotations

from pathlib import Path

import numba
import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from hhsr.errors import FitError
from hhsr.evaluate import leaf_radius
from hhsr.fitting.lookahead import Parting, best_split, hidden
from hhsr.fitting.normalise import normalise
from hhsr.fitting.options import FitOptions
from hhsr.fitting.recipe import fit_default
from hhsr.fitting.samples import area_samples, turned_fibonacci
from hhsr.fitting.solid import Solid, everywhere, regions, solid_of
from hhsr.model import Cut, ModelLeaf, Node, RetainedPart, depth, leaves
from hhsr.triangle_tree import TriangleTree

DATA = Path(__file__).resolve().parents[2].parent / "shared" / "data"


def blob(scale: float = 1.0, detail: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """A bumpy body that is a radius over directions."""
    ball = trimesh.creation.icosphere(subdivisions=detail)
    u = np.array(ball.vertices)
    radius = 1.0 + 0.15 * np.sin(3.0 * u[:, 0] + 1.0) * u[:, 1] + 0.1 * u[:, 2] ** 3 + 0.05 * np.cos(7.0 * u[:, 1])
    return scale * u * radius[:, None] * (30.0, 22.0, 17.0), np.array(ball.faces)


def dumbbell(detail: int = 4) -> tuple[np.ndarray, np.ndarray]:
    """Two balls on a bent rod: no point sees all of it."""
    ball = trimesh.creation.icosphere(subdivisions=detail)
    v = np.array(ball.vertices)
    along = v[:, 0] * 60.0
    thick = 16.0 * np.sqrt(np.maximum(1.0 - v[:, 0] ** 2, 0.0)) * (0.35 + 0.65 * v[:, 0] ** 2)
    ring = np.sqrt((v[:, 1:] ** 2).sum(axis=1))
    side = v[:, 1:] / np.maximum(ring, 1e-9)[:, None] * thick[:, None]
    return np.column_stack([along, side[:, 0] + along**2 / 60.0, side[:, 1]]), np.array(ball.faces)


def contains(node: Node, points: np.ndarray) -> np.ndarray:
    """The solid of a tree of model leaves and bare cuts, as DESIGN §2 says it."""
    if isinstance(node, Cut):
        right = points @ node.normal - node.offset >= 0.0
        out = np.zeros(points.shape[0], dtype=bool)
        out[right], out[~right] = contains(node.right, points[right]), contains(node.left, points[~right])
        return out
    assert isinstance(node, ModelLeaf)
    offset = points - node.centre
    return np.sqrt((offset**2).sum(axis=1)) < leaf_radius(node, offset)


def misses(node: Node, vertices: np.ndarray, faces: np.ndarray) -> np.ndarray:
    """True distances of the leaves' own points, within their regions, to the source."""
    triangles = TriangleTree(vertices, faces)
    found = []
    for leaf, region in zip(leaves(node), regions(node), strict=True):
        directions = turned_fibonacci(4000, 9)
        points = leaf.centre + leaf_radius(leaf, directions)[:, None] * directions
        found.append(triangles.closest(points[region.holds(points)])[0])
    return np.concatenate(found)


def disagreement(node: Node, vertices: np.ndarray, faces: np.ndarray, deeper: float = 0.0) -> float:
    """Body volumes in which fit and source disagree, farther than `deeper` mm from the source's surface."""
    random = np.random.default_rng(0)
    points = random.uniform(vertices.min(axis=0), vertices.max(axis=0), (20_000, 3))
    triangles = TriangleTree(vertices, faces)
    inside = triangles.contains(points)
    wrong = (contains(node, points) != inside) & (triangles.closest(points)[0] > deeper)
    return float(wrong.sum() / inside.sum())


def test_one_leaf_tells_a_body_that_one_point_sees() -> None:
    vertices, faces = normalise(*blob())[0], blob()[1]
    node = fit_default(vertices, faces, FitOptions(max_parameters=200))
    assert isinstance(node, ModelLeaf)
    assert 190 <= node.parameters + 6 <= 200
    distances = misses(node, vertices, faces)
    assert distances.mean() < 0.03
    assert distances.max() < 0.3


def test_what_no_point_sees_is_cut_and_no_void_opens_at_the_cuts() -> None:
    vertices, faces = normalise(*dumbbell())[0], dumbbell()[1]
    node = fit_default(vertices, faces, FitOptions(max_parameters=240))
    assert isinstance(node, Cut)
    assert node.parameters + 6 <= 240
    assert depth(node) <= 12
    assert misses(node, vertices, faces).mean() < 0.25
    assert disagreement(node, vertices, faces) < 0.1
    assert disagreement(node, vertices, faces, deeper=1.0) < 0.005


def test_two_bodies_are_parted() -> None:
    ball = trimesh.creation.icosphere(subdivisions=3, radius=10.0)
    vertices = np.vstack([ball.vertices, np.array(ball.vertices) + np.array([40.0, 3.0, 0.0])])
    faces = np.vstack([ball.faces, ball.faces + len(ball.vertices)])
    vertices = normalise(vertices, faces)[0]
    node = fit_default(vertices, faces, FitOptions(max_parameters=60))
    # A third leaf may pay on the facets of the balls; one leaf over both bodies cannot.
    assert len(list(leaves(node))) >= 2
    assert misses(node, vertices, faces).mean() < 0.1
    assert disagreement(node, vertices, faces) < 0.02


@pytest.mark.parametrize("budget", [16, 24, 41, 80])
def test_small_budgets_are_kept(budget: int) -> None:
    vertices, faces = blob(detail=3)
    node = fit_default(normalise(vertices, faces)[0], faces, FitOptions(max_parameters=budget))
    assert node.parameters + 6 <= budget


def test_a_budget_below_one_leaf_is_refused() -> None:
    vertices, faces = blob(detail=2)
    options = FitOptions(max_parameters=16)
    object.__setattr__(options, "max_parameters", 14)
    with pytest.raises(FitError, match="at least 15"):
        fit_default(vertices, faces, options)


def test_more_numbers_fit_better() -> None:
    vertices, faces = normalise(*blob())[0], blob()[1]
    errors = [
        misses(fit_default(vertices, faces, FitOptions(max_parameters=b)), vertices, faces).mean()
        for b in (30, 80, 200)
    ]
    assert errors[0] > 2.0 * errors[1] > 4.0 * errors[2]


def test_no_more_is_spent_than_the_goals_ask_for() -> None:
    vertices, faces = normalise(*blob())[0], blob()[1]
    rough = fit_default(vertices, faces, FitOptions(max_mean_error_mm=0.3))
    fine = fit_default(vertices, faces, FitOptions(max_mean_error_mm=0.3, max_error_mm=0.5))
    assert misses(rough, vertices, faces).mean() < 0.33
    assert rough.parameters < fine.parameters
    assert misses(fine, vertices, faces).max() < 0.7
    capped = fit_default(vertices, faces, FitOptions(max_mean_error_mm=1e-6, max_parameters=90))
    assert capped.parameters + 6 <= 90


def same(one: Node, other: Node) -> bool:
    """Whether two trees are the same to the last bit."""
    if isinstance(one, Cut) or isinstance(other, Cut):
        return (
            isinstance(one, Cut)
            and isinstance(other, Cut)
            and np.array_equal(one.normal_angles, other.normal_angles)
            and one.offset == other.offset
            and same(one.left, other.left)
            and same(one.right, other.right)
        )
    assert not isinstance(one, RetainedPart)
    assert not isinstance(other, RetainedPart)
    pairs = (
        (one.centre, other.centre),
        (one.superquadric.half_axes, other.superquadric.half_axes),
        (one.scale_field.index, other.scale_field.index),
        (one.scale_field.weights, other.scale_field.weights),
    )
    return all(np.array_equal(a, b) for a, b in pairs)


def test_the_number_of_threads_changes_nothing() -> None:
    vertices, faces = normalise(*dumbbell(3))[0], dumbbell(3)[1]
    options = FitOptions(max_parameters=50)
    usual = numba.get_num_threads()
    fits = []
    try:
        for threads in (1, numba.config.NUMBA_NUM_THREADS):
            numba.set_num_threads(threads)
            fits.append(fit_default(vertices, faces, options))
    finally:
        numba.set_num_threads(usual)
    assert same(fits[0], fits[1])


def test_scale_and_place_of_the_source_change_the_error_only_in_proportion() -> None:
    vertices, faces = blob(detail=3)
    turn = Rotation.from_rotvec([0.4, -1.2, 2.2]).as_matrix()
    errors = []
    for scale, moved in ((1.0, vertices), (1.0, vertices @ turn.T + (100.0, -40.0, 7.0)), (10.0, 10.0 * vertices)):
        local = normalise(moved, faces)[0]
        errors.append(misses(fit_default(local, faces, FitOptions(max_parameters=120)), local, faces).mean() / scale)
    assert abs(errors[1] / errors[0] - 1.0) < 1e-6
    assert abs(errors[2] / errors[0] - 1.0) < 0.02


def solid() -> Solid:
    """The dumbbell as the fit knows it."""
    return solid_of(normalise(*dumbbell())[0], dumbbell()[1], 3000, 0)


def test_inner_points_are_inside_and_hidden_points_are_behind_the_surface() -> None:
    body = solid()
    assert body.triangles.contains(body.inner).all()
    centre = body.inner[:3]
    members = np.arange(0, 3000, 10)
    gaps = hidden(body, centre, members)
    for c in range(3):
        crossings = body.triangles.crossings(
            np.broadcast_to(centre[c], (members.size, 3)),
            centre[c] + (1.0 - 1e-4) * (body.samples.points[members] - centre[c]),
        )
        assert ((np.diff(crossings.offsets) > 0) == (gaps[c] > 0.0)).mean() > 0.99


def test_each_cut_lowers_the_misfit_and_shows_more() -> None:
    body = solid()
    parting = Parting(body)
    assert parting.grown(3)
    assert parting.misfit(1) > parting.misfit(2) > parting.misfit(3)
    assert parting.hidden(1) > parting.hidden(2)
    for count in (1, 2, 3):
        members = np.sort(np.concatenate([p.members for p in parting.pieces(count)]))
        assert np.array_equal(members, np.arange(3000))
        for piece in parting.pieces(count):
            assert piece.region.holds(body.samples.points[piece.members]).all()
            assert piece.region.holds(piece.centre[None]).all()
            assert body.triangles.contains(piece.centre[None]).all()


def test_a_piece_too_small_is_not_cut() -> None:
    body = solid()
    piece = Parting(body).pieces(1)[0]
    few = type(piece)(piece.region, piece.members[:10], piece.centre, 1.0, 0.0, 0)
    deep = type(piece)(piece.region, piece.members, piece.centre, 1.0, 0.0, 12)
    assert best_split(body, few, 1.0) is None
    assert best_split(body, deep, 1.0) is None


def test_a_ray_leaves_a_region_where_its_planes_say() -> None:
    region = everywhere().halves(np.array([1.0, 0.0, 0.0]), 5.0)[0].halves(np.array([0.0, 1.0, 0.0]), -2.0)[1]
    directions = np.array([[1.0, 0.0, 0.0], [0.0, -1.0, 0.0], [-1.0, 0.0, 0.0], [0.6, -0.8, 0.0]])
    reach, cosine = region.exits(np.zeros(3), directions)
    assert np.allclose(reach, [5.0, 2.0, np.inf, 2.5])
    assert np.allclose(cosine[[0, 1, 3]], [1.0, 1.0, 0.8])


@pytest.mark.skipif(not DATA.is_dir(), reason="the shared data folder is missing")
def test_a_real_gland_is_told_by_320_numbers() -> None:
    mesh = trimesh.load(DATA / "prostate" / "prostate_picai_10035.ply")
    vertices, faces = normalise(np.array(mesh.vertices), np.array(mesh.faces))[0], np.array(mesh.faces)
    node = fit_default(vertices, faces, FitOptions(max_parameters=320))
    assert node.parameters + 6 <= 320
    distances = misses(node, vertices, faces)
    assert distances.mean() < 0.03
    assert distances.max() < 0.6
    assert disagreement(node, vertices, faces) < 0.01
    assert area_samples(vertices, faces, 10).points.shape == (10, 3)
