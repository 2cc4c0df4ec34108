"""The surface of a tree is closed, and is the boundary of the very set that the tree means (DESIGN §2)."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from hhsr.errors import InputError, SurfaceError
from hhsr.evaluate import leaf_radius
from hhsr.model import (
    CentreGrid,
    Contour,
    Cut,
    ModelLeaf,
    Node,
    RetainedPart,
    ScaleField,
    Superquadric,
    Tree,
    cuts,
    frozen,
    normal_angles_of,
    rotation_matrix,
)
from hhsr.surface import Patch, Retained, Step, Strip, reconstruct
from hhsr.triangle_tree import TriangleTree

NO_POSE = frozen(np.zeros(6))


def holds(node: Node, points: np.ndarray, tables: dict[int, list] | None = None) -> np.ndarray:
    """Return whether the set of DESIGN §2 holds points of the tree's frame: the definition, word for word."""
    if isinstance(node, ModelLeaf):
        q = (points - node.centre) @ rotation_matrix(node.rotation)
        return np.linalg.norm(q, axis=1) < leaf_radius(node, q)
    if isinstance(node, RetainedPart):
        return TriangleTree(node.vertices, node.faces).contains(points)
    height = points @ node.normal - node.offset
    slab, out = np.abs(height) < node.half_width, np.zeros(len(points), dtype=bool)
    for side, child in ((~slab & (height >= 0), node.right), (~slab & (height < 0), node.left)):
        if side.any():
            out[side] = holds(child, points[side], tables)
    for lobe, (left, right) in enumerate(tables[id(node)] if slab.any() else []):
        local = points[slab] @ node.frame.T
        x, y = (local[:, :2] - node.contours[lobe].centre).T
        share = 0.5 * (height[slab] / node.half_width + 1.0)
        out[slab] |= np.hypot(x, y) < Strip(0, lobe, node, left, right).radius(np.arctan2(y, x), share)
    return out


def ball(radius: float = 20.0, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> ModelLeaf:
    return ModelLeaf(frozen(centre), frozen([]), Superquadric(frozen([radius] * 6)), ScaleField.none())


def random_leaf(rng: np.random.Generator, size: float = 25.0) -> ModelLeaf:
    grid = CentreGrid((40, 120, 400), 2.5)
    index = np.sort(rng.choice(grid.size, 30, replace=False))
    weights = rng.normal(size=30) * 0.04
    base = Superquadric(frozen(size * rng.uniform(0.5, 1.4, 6)), frozen(rng.normal(size=3)), frozen(rng.normal(size=4)))
    return ModelLeaf(
        frozen(rng.normal(size=3) * 0.3 * size),
        frozen(rng.normal(size=3)),
        base,
        ScaleField(grid, frozen(index, np.int64), frozen(weights)),
    )


def random_part(rng: np.random.Generator, size: float = 25.0) -> RetainedPart:
    body = trimesh.creation.torus(0.7 * size, 0.25 * size, major_sections=24, minor_sections=12)
    body.apply_transform(trimesh.transformations.random_rotation_matrix(rng.random(3)))
    return RetainedPart(frozen(body.vertices), frozen(body.faces, np.int64))


def random_cut(rng: np.random.Generator, left: Node, right: Node, spread: float = 6.0) -> Cut:
    return Cut(frozen(normal_angles_of(rng.normal(size=3))), float(rng.normal() * spread), 0.0, (), left, right)


def random_tree(rng: np.random.Generator, depth: int, retained: float = 0.0) -> Node:
    if depth == 0 or (depth < 3 and rng.random() < 0.15):
        return random_part(rng) if rng.random() < retained else random_leaf(rng)
    return random_cut(rng, random_tree(rng, depth - 1, retained), random_tree(rng, depth - 1, retained))


def check(tree: Tree, mesh: trimesh.Trimesh, tables: dict[int, list] | None = None, seed: int = 0) -> None:
    """Assert everything that issue 2 asks of a mesh, against the definition."""
    rng = np.random.default_rng(seed)
    tolerance = mesh.metadata["tolerance_mm"]
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    rotation, translation = rotation_matrix(tree.pose[:3]), tree.pose[3:]
    probes = rng.uniform(mesh.bounds[0] - 2, mesh.bounds[1] + 2, (8000, 3))
    on, _ = trimesh.sample.sample_surface(mesh, 4000, seed=seed)
    probes = np.concatenate([probes, on + rng.normal(size=on.shape) * 5.0 * tolerance])
    answers = TriangleTree(mesh.vertices, mesh.faces)
    differs = answers.contains(probes) != holds(tree.root, (probes - translation) @ rotation, tables)
    assert (answers.closest(probes[differs])[0] < 3.0 * tolerance).all()

    sources, source = mesh.metadata["sources"], mesh.face_attributes["source"]
    vertices = (mesh.vertices - translation) @ rotation
    several = np.zeros(len(vertices), dtype=bool)
    lowest, highest = np.full(len(vertices), len(sources)), np.full(len(vertices), -1)
    np.minimum.at(lowest, mesh.faces, source[:, None])
    np.maximum.at(highest, mesh.faces, source[:, None])
    several = lowest != highest
    for number, kind in enumerate(sources):
        faces = source == number
        inner = np.unique(mesh.faces[faces])
        inner = inner[~several[inner]]
        if isinstance(kind, Patch) and len(inner):
            q = (vertices[inner] - kind.model.centre) @ rotation_matrix(kind.model.rotation)
            assert np.abs(np.linalg.norm(q, axis=1) / leaf_radius(kind.model, q) - 1.0).max() <= 1e-6
        if isinstance(kind, Strip) and len(inner):
            assert np.abs(kind.miss(vertices[inner])).max() <= 0.01
        if isinstance(kind, Step) and faces.any():
            corners = vertices[mesh.faces[faces]]
            miss = np.abs(kind.miss(corners.reshape(-1, 3)))
            assert miss.max() < 0.02  # edges shorter than 2e-4 are collapsed at any price: so few that
            assert (miss > 1e-8).sum() <= 0.01 * miss.size + 6
            exact = corners[(miss <= 1e-8).reshape(-1, 3).all(axis=1)]
            step_faces(tree.root, exact, kind.model.normal, tables, max(2.0 * tolerance, 0.1))


def step_faces(
    root: Node, corners: np.ndarray, normal: np.ndarray, tables: dict[int, list] | None, sliver: float
) -> None:
    """Assert that step faces have the solid on their inner side only; slivers along the chords' sag excepted."""
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    area = 0.5 * np.linalg.norm(across, axis=1)
    side = np.sign(across @ normal)[:, None] * normal
    middle = corners.mean(axis=1)
    right = holds(root, middle - 1e-6 * side, tables) & ~holds(root, middle + 1e-6 * side, tables)
    longest = np.linalg.norm(corners - np.roll(corners, 1, axis=1), axis=2).max(axis=1)
    assert right[2.0 * area / longest > sliver].all()
    assert area[~right].sum() <= 0.02 * area.sum() + 0.3  # mm², along outlines of some 100 mm


def test_ball_is_a_ball() -> None:
    for tolerance in (0.2, 0.02):
        mesh = reconstruct(Tree(ball(), frozen([0.1, 0.2, 0.3, 5.0, 6.0, 7.0])), tolerance)
        radius = np.linalg.norm(mesh.vertices - [5, 6, 7], axis=1)
        np.testing.assert_allclose(radius, 20.0, atol=1e-12)
        assert mesh.is_watertight
        inner = np.linalg.norm(mesh.triangles_center - [5, 6, 7], axis=1)
        assert 20.0 - inner.min() <= tolerance
        assert mesh.volume == pytest.approx(4 / 3 * np.pi * 20.0**3, rel=0.06 * tolerance)


def test_tessellation_adds_little_to_a_mean() -> None:
    leaf = random_leaf(np.random.default_rng(5))
    mesh = reconstruct(Tree(leaf, NO_POSE), 0.02)
    points, _ = trimesh.sample.sample_surface(mesh, 20000, seed=1)
    q = (points - leaf.centre) @ rotation_matrix(leaf.rotation)
    miss = np.abs(np.linalg.norm(q, axis=1) - leaf_radius(leaf, q))
    assert miss.mean() < 0.004
    assert np.quantile(miss, 0.99) < 0.02


def test_two_balls_leave_one_step() -> None:
    cut = Cut(frozen([0.3, 0.4]), 2.0, 0.0, (), ball(20.0), ball(22.0))
    mesh = reconstruct(Tree(cut, NO_POSE), 0.02)
    check(Tree(cut, NO_POSE), mesh)
    step = np.array([isinstance(s, Step) for s in mesh.metadata["sources"]])[mesh.face_attributes["source"]]
    assert mesh.area_faces[step].sum() == pytest.approx(np.pi * (22.0**2 - 20.0**2), rel=1e-3)
    np.testing.assert_allclose(mesh.face_normals[step], -np.broadcast_to(cut.normal, (step.sum(), 3)), atol=1e-6)
    leaf = mesh.face_attributes["leaf"]
    np.testing.assert_array_equal(leaf, (mesh.triangles_center - 1e-6 * mesh.face_normals) @ cut.normal >= 2.0)


def test_a_cut_through_one_ball_leaves_no_step() -> None:
    cut = Cut(frozen([0.3, 0.4]), 2.0, 0.0, (), ball(), ball())
    inner = Cut(frozen([1.3, -0.4]), 1.0, 0.0, (), cut, ball())
    mesh = reconstruct(Tree(inner, NO_POSE), 0.02)
    check(Tree(inner, NO_POSE), mesh)
    step = np.array([isinstance(s, Step) for s in mesh.metadata["sources"]])[mesh.face_attributes["source"]]
    assert mesh.area_faces[step].sum() < 0.5
    assert mesh.volume == pytest.approx(4 / 3 * np.pi * 20.0**3, rel=1e-3)


@pytest.mark.parametrize("seed", range(6))
def test_random_trees(seed: int, tmp_path: Path) -> None:
    rng = np.random.default_rng(seed)
    tree = Tree(random_tree(rng, 1 + seed % 3), frozen([*rng.normal(size=3), *rng.normal(size=3) * 50]))
    mesh = reconstruct(tree, 0.05)
    check(tree, mesh, seed=seed)
    mesh.export(tmp_path / "shape.ply")
    assert trimesh.load(tmp_path / "shape.ply").is_watertight


@pytest.mark.parametrize("seed", range(4))
def test_random_trees_with_retained_parts(seed: int) -> None:
    rng = np.random.default_rng(100 + seed)
    tree = Tree(random_cut(rng, random_part(rng), random_tree(rng, 1 + seed % 2, 0.5)), NO_POSE)
    mesh = reconstruct(tree, 0.1)
    check(tree, mesh, seed=seed)
    assert any(isinstance(s, Retained) for s in mesh.metadata["sources"])


def test_retained_alone_is_itself() -> None:
    part = random_part(np.random.default_rng(0))
    mesh = reconstruct(Tree(part, NO_POSE))
    np.testing.assert_array_equal(mesh.vertices, part.vertices)
    np.testing.assert_array_equal(mesh.faces, part.faces)


def test_sixty_four_leaves() -> None:
    rng = np.random.default_rng(7)

    def full(depth: int) -> Node:
        return (
            ball(rng.uniform(15, 20), tuple(rng.normal(size=3)))
            if depth == 0
            else random_cut(rng, full(depth - 1), full(depth - 1), 3.0)
        )

    tree = Tree(full(6), NO_POSE)
    check(tree, reconstruct(tree, 0.2))


def test_leaves_that_miss_their_region_and_empty_parts() -> None:
    far = Cut(frozen([0.0, 0.0]), 30.0, 0.0, (), ball(), ball())
    mesh = reconstruct(Tree(far, NO_POSE), 0.1)
    check(Tree(far, NO_POSE), mesh)
    assert set(mesh.face_attributes["leaf"]) == {0}
    nothing = RetainedPart(frozen(np.zeros((0, 3))), frozen(np.zeros((0, 3)), np.int64))
    half = Cut(frozen([0.0, 0.0]), 0.0, 0.0, (), nothing, ball())
    mesh = reconstruct(Tree(half, NO_POSE), 0.1)
    check(Tree(half, NO_POSE), mesh)
    assert mesh.volume == pytest.approx(2 / 3 * np.pi * 20.0**3, rel=0.01)
    empty = reconstruct(Tree(Cut(frozen([0.0, 0.0]), 0.0, 0.0, (), nothing, nothing), NO_POSE))
    assert len(empty.faces) == 0


def test_several_bodies_and_slivers() -> None:
    # A thin wedge between two almost parallel planes, and a plane that just grazes a ball.
    thin = Cut(frozen([0.001, 0.0]), 0.02, 0.0, (), ball(20.0), ball(5.0, (0.0, 0.0, 25.0)))
    tree = Tree(Cut(frozen([0.0, 0.0]), 0.0, 0.0, (), ball(19.999, (0.0, 3.0, 0.0)), thin), NO_POSE)
    check(tree, reconstruct(tree, 0.05))
    graze = Tree(Cut(frozen([0.0, 0.5]), 19.9995, 0.0, (), ball(), ball(20.0005)), NO_POSE)
    check(graze, reconstruct(graze, 0.05))
    apart = Tree(Cut(frozen([0.0, 0.0]), 0.0, 0.0, (), ball(5.0, (-9, 0, 0)), ball(5.0, (9, 0, 0))), NO_POSE)
    mesh = reconstruct(apart, 0.05)
    check(apart, mesh)
    assert mesh.body_count == 2


def banded(leaf: ModelLeaf, other: ModelLeaf, half_width: float, offset: float, centre: tuple[float, float]) -> Cut:
    """Return two leaves with a band whose contour is the mean of the two sections' ellipses."""
    axes = frozen([17.0, 18.0, 18.0, 17.5])
    return Cut(frozen([0.4, 0.7]), offset, half_width, (Contour(frozen(centre), axes),), leaf, other)


def section_tables(cut: Cut, tables: dict[int, list]) -> list[tuple[np.ndarray, np.ndarray]]:
    """Return the radii of the children's sections at h = ∓d by bisection (one exit along every ray)."""
    angle = -np.pi + 2.0 * np.pi * np.arange(256) / 256
    rays = np.outer(np.cos(angle), cut.frame[0]) + np.outer(np.sin(angle), cut.frame[1])
    lobes = []
    for contour in cut.contours:
        ends = []
        for side, child in ((-1, cut.left), (1, cut.right)):
            origin = contour.centre @ cut.frame[:2] + (cut.offset + side * cut.half_width) * cut.normal
            low, high = np.zeros(256), np.full(256, 100.0)
            for _ in range(60):
                middle = 0.5 * (low + high)
                inside = holds(child, origin + middle[:, None] * rays, tables)
                low, high = np.where(inside, middle, low), np.where(inside, high, middle)
            ends.append(low)
        lobes.append((ends[0], ends[1]))
    return lobes


def tables_of(root: Node) -> dict[int, list]:
    tables: dict[int, list] = {}
    for cut in reversed(list(cuts(root))):
        tables[id(cut)] = section_tables(cut, tables) if cut.half_width > 0 else []
    return tables


@pytest.mark.parametrize("half_width", [0.5, 3.0])
def test_bands_join_without_steps(half_width: float) -> None:
    cut = banded(ball(20.0), ball(20.5, (0.5, 0.2, 0.1)), half_width, 1.0, (0.5, -0.5))
    tables = tables_of(cut)
    mesh = reconstruct(Tree(cut, NO_POSE), 0.02, [tables[id(c)] for c in cuts(cut)])
    check(Tree(cut, NO_POSE), mesh, tables)
    kinds = np.array([type(s).__name__ for s in mesh.metadata["sources"]])[mesh.face_attributes["source"]]
    assert mesh.area_faces[kinds == "Step"].sum() < 1e-3
    assert (kinds == "Strip").sum() > 100


def test_a_band_under_a_cut_and_a_band_over_it() -> None:
    inner = banded(ball(20.0), ball(20.5, (0.5, 0.2, 0.1)), 1.0, 1.0, (0.5, -0.5))
    outer = Cut(
        frozen([-1.0, 0.2]),
        2.0,
        0.8,
        (Contour(frozen([0.0, 0.0]), frozen([20.0, 19.5, 19.8, 20.1])),),
        inner,
        ball(20.3, (0.0, 0.3, 0.0)),
    )
    whole = Cut(frozen([0.5, -0.9]), -1.0, 0.0, (), outer, ball(19.0))
    tables = tables_of(whole)
    mesh = reconstruct(Tree(whole, NO_POSE), 0.02, [tables[id(c)] for c in cuts(whole)])
    check(Tree(whole, NO_POSE), mesh, tables)
    by_itself = reconstruct(Tree(whole, NO_POSE), 0.02)
    assert by_itself.is_watertight
    assert by_itself.volume == pytest.approx(mesh.volume, rel=1e-5)


@pytest.mark.parametrize("seed", range(3))
def test_bands_that_hardly_hold(seed: int, tmp_path: Path) -> None:
    """Contours drawn at random: sections are missed, lobes overlap, radii vanish; the set is still one, and closed."""
    rng = np.random.default_rng(seed)

    def lobe() -> Contour:
        centre, axes = frozen(rng.normal(size=2) * 6), frozen(rng.uniform(8, 25, 4))
        return Contour(centre, axes, frozen([]), frozen(rng.normal(size=6) * 0.05))

    def wild(depth: int) -> Node:
        if depth == 0:
            return random_leaf(rng) if rng.random() < 0.8 else random_part(rng)
        cut = random_cut(rng, wild(depth - 1), wild(depth - 1))
        lobes = tuple(lobe() for _ in range(rng.integers(1, 3)))
        return Cut(cut.normal_angles, cut.offset, float(rng.uniform(0.2, 3.0)), lobes, cut.left, cut.right)

    tree = Tree(wild(1 + seed % 2), NO_POSE)
    tables = tables_of(tree.root)
    mesh = reconstruct(tree, 0.1, [tables[id(c)] for c in cuts(tree.root)])
    check(tree, mesh, tables, seed)
    mesh.export(tmp_path / "shape.ply")
    assert trimesh.load(tmp_path / "shape.ply").is_watertight


def test_a_retained_part_that_touches_itself() -> None:
    """Two boxes that share an edge, and two that share a corner, by index: four faces an edge, two fans a vertex."""
    boxes = [trimesh.creation.box((10, 10, 10)) for _ in range(3)]
    boxes[1].apply_translation((10, 10, 0))
    boxes[2].apply_translation((-10, -10, -10))
    touching = trimesh.util.concatenate(boxes)
    touching.merge_vertices()
    assert not touching.is_watertight
    part = RetainedPart(frozen(touching.vertices), frozen(touching.faces, np.int64))
    assert reconstruct(Tree(part, NO_POSE)).volume == pytest.approx(3000.0)
    cut = Cut(frozen([0.2, 0.3]), 0.5, 0.0, (), part, ball(9.0))
    mesh = reconstruct(Tree(cut, NO_POSE), 0.05)
    check(Tree(cut, NO_POSE), mesh)


def test_open_triangles_and_bad_tolerances_are_refused() -> None:
    box = trimesh.creation.box((10, 10, 10))
    part = RetainedPart(frozen(box.vertices), frozen(box.faces[:-1], np.int64))
    tree = Tree(Cut(frozen([0.0, 0.0]), 0.0, 0.0, (), part, part), NO_POSE)
    with pytest.raises(SurfaceError, match="not closed"):
        reconstruct(tree)
    with pytest.raises(InputError, match="tolerance_mm"):
        reconstruct(tree, 0.0)
