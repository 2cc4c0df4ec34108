"""Layouts of planes: split, merged, settled; sections of the planes; voids behind them closed."""

from __future__ import annotations

import threading

import numba
import numpy as np
import pytest
import trimesh

from hhsr.fitting.aim import aim_of
from hhsr.fitting.closing import closed, with_section
from hhsr.fitting.leaves import SCOUT, Workshop, fit_leaves
from hhsr.fitting.lookahead import Layout, Parting
from hhsr.fitting.normalise import normalise, on_grid, scaled
from hhsr.fitting.planes import settled
from hhsr.fitting.refine import improved, misses, radii_of, view_of, weights_of
from hhsr.fitting.samples import side_by_side, turned_fibonacci
from hhsr.fitting.scale_field import NONE, fit_ellipsoid, grid_for, leaf_of, select_centres
from hhsr.fitting.section import Section, near_voids, section_of
from hhsr.fitting.solid import Solid, solid_of
from hhsr.fitting.task import first_rows, start_rows, task_of
from hhsr.fitting.threads import in_threads
from hhsr.kernels.refinement import ellipsoid_radii
from hhsr.model import Cut, FloatArray, ModelLeaf, ScaleField, frozen, plane_frame


@pytest.fixture(scope="module")
def solid() -> Solid:
    """A horseshoe of round section, in units of its longest side."""
    ball = trimesh.creation.icosphere(subdivisions=4)
    v = np.array(ball.vertices)
    turn = 2.2 * v[:, 0]
    thick = 6.0 * np.sqrt(np.maximum(1.0 - v[:, 0] ** 2, 0.0)) ** 0.5
    ring = v[:, 1:] / np.maximum(np.linalg.norm(v[:, 1:], axis=1), 1e-9)[:, None] * thick[:, None]
    radius = 18.0 + ring[:, 0]
    bent = np.column_stack([radius * np.cos(turn), radius * np.sin(turn), ring[:, 1]])
    faces = np.array(ball.faces)
    if trimesh.Trimesh(bent, faces, process=False).volume < 0:
        faces = faces[:, ::-1]
    local = normalise(bent, faces)[0]
    return solid_of(on_grid(local, np.unique(faces))[0], faces, 4000, 0)


def misfit(layout: Layout) -> float:
    return sum(piece.misfit for piece in layout.pieces)


def is_a_partition(solid: Solid, layout: Layout) -> bool:
    """Whether each sample is a member of the one piece whose region holds it."""
    for piece in layout.pieces:
        held = np.flatnonzero(piece.region.holds(solid.samples.points))
        if not np.array_equal(held, np.sort(piece.members)):
            return False
    return sum(piece.members.size for piece in layout.pieces) == solid.samples.points.shape[0]


def test_planes_are_moved_only_to_what_fits_better(solid: Solid) -> None:
    parting = Parting(solid)
    assert parting.grown(4)
    layout = parting.layout(4)
    moved = settled(solid, layout)
    assert is_a_partition(solid, layout)
    assert is_a_partition(solid, moved)
    assert misfit(moved) <= misfit(layout)
    assert np.array_equal(moved.children, layout.children)
    assert settled(solid, parting.layout(1)).planes == ()


def test_a_cut_undone_leaves_the_other_pieces_as_they_were(solid: Solid) -> None:
    parting = Parting(solid)
    assert parting.grown(5)
    layout = parting.layout(5)
    lowest = np.flatnonzero((layout.children < 0).all(axis=1))
    for plane in lowest:
        merged = layout.merged(solid, int(plane))
        assert len(merged.pieces) == 4
        assert len(merged.planes) == 3
        assert is_a_partition(solid, merged)
        assert sum(piece in layout.pieces for piece in merged.pieces) == 3
        leaf = ModelLeaf(frozen(np.zeros(3)), frozen([]), None, None)  # type: ignore[arg-type]
        root = merged.tree([leaf] * 4)
        assert isinstance(root, Cut)
        assert [s.size for s in (root.normal_angles,)] == [2]
    only = parting.layout(2).merged(solid, 0)
    assert only.planes == ()
    assert only.children.shape == (0, 2)


def test_a_section_lies_on_the_planes_and_in_the_solid(solid: Solid) -> None:
    parting = Parting(solid)
    assert parting.grown(3)
    for piece in parting.pieces(3):
        section = section_of(solid, piece.region, piece.centre)
        points = piece.centre + section.reach[:, None] * section.along
        height = np.abs(points @ piece.region.normals.T - piece.region.offsets)
        assert section.reach.size > 5
        assert height.min(axis=1).max() < 1e-9
        assert solid.triangles.contains(points).all()
        assert np.allclose(solid.triangles.closest(points)[0], section.depth)


def voids(section: Section, leaf: ModelLeaf) -> float:
    """The depths, summed, of the points of a leaf's sections that its centre sees and it does not cover."""
    void = (section.hit > section.reach) & (radii_of(leaf, section.along) < section.reach)
    return float(section.depth[void].sum())


def test_a_void_between_the_points_of_a_section_is_found(solid: Solid) -> None:
    parting = Parting(solid)
    assert parting.grown(3)
    piece = max(parting.pieces(3), key=lambda piece: len(section_of(solid, piece.region, piece.centre).reach))
    coarse = section_of(solid, piece.region, piece.centre)
    points = piece.centre + coarse.reach[:, None] * coarse.along
    spacing = np.sqrt(coarse.cell[0])
    deepest = int(np.argmax(coarse.depth * (coarse.hit > coarse.reach)))
    plane = np.argmin(np.abs(piece.region.normals @ points[deepest] - piece.region.offsets))
    frame = plane_frame(piece.region.normals[plane])
    spot, wide = points[deepest] + 0.4 * spacing * (frame[0] + frame[1]), 0.25 * spacing

    def radii(along: FloatArray) -> FloatArray:
        """Longer than the planes' distance but near the spot, where a void as narrow as this is left."""
        reach = piece.region.exits(piece.centre, along)[0]
        away = np.linalg.norm(piece.centre + np.minimum(reach, 10.0)[:, None] * along - spot, axis=1)
        return np.where(np.isfinite(reach), reach + np.minimum(away - wide, 0.2), 10.0)

    assert (radii(coarse.along) >= coarse.reach).all()
    near = near_voids(solid, piece.region, piece.centre, radii, 0.5 * coarse.depth[deepest])
    found = piece.centre + near.reach[:, None] * near.along
    void = radii(near.along) < near.reach
    assert 0.5 * np.pi * wide**2 < near.cell[void].sum() < 2.0 * np.pi * wide**2
    assert np.linalg.norm(found[void] - spot, axis=1).max() <= wide * (1.0 + 1e-6)
    assert near.depth.min() > 0.45 * coarse.depth[deepest]
    assert near_voids(solid, piece.region, piece.centre, radii, 2.0 * coarse.depth[deepest]).reach.size == 0


def test_voids_behind_cuts_are_closed_and_never_made(solid: Solid) -> None:
    parting = Parting(solid)
    assert parting.grown(3)
    left = []
    for piece in parting.pieces(3):
        task = task_of(solid, piece.region, piece.members, piece.centre, 1)
        section = section_of(solid, piece.region, piece.centre)
        rows = start_rows(task, solid)
        axes = fit_ellipsoid(rows)
        field = select_centres(rows, axes, grid_for(300), 40, NONE).field(40)
        leaf = leaf_of(piece.centre, 0.97 * axes, field)
        found = misses(task, solid, leaf, view_of(task.directions, leaf))
        before, after = voids(section, leaf), voids(section, closed(solid, task, section, leaf, found, aim_of(0.01))[0])
        assert before > 0.0
        assert after <= before
        assert with_section(task, section).behind.shape[0] >= task.behind.shape[0]
        left.append(after / before)
    # Where all of a section is a void, as behind these pieces' first planes, the steps overshoot and are not taken.
    assert min(left) < 0.1


def test_rows_for_the_first_centres_are_those_of_bounds_and_holds_together(solid: Solid) -> None:
    piece = Parting(solid).pieces(1)[0]
    region = piece.region.halves(np.array([1.0, 0.0, 0.0]), float(piece.centre[0]) + 0.05)[0]
    task = task_of(solid, region, np.flatnonzero(region.holds(solid.samples.points)), piece.centre, 1)
    axes = fit_ellipsoid(start_rows(task, solid))
    rows = first_rows(task, solid, leaf_of(piece.centre, axes, ScaleField.none()))
    assert np.array_equal(rows.directions, task.directions)
    told = rows.weights > 0.0
    assert told.sum() == task.along.shape[0] + task.behind.shape[0]
    base = ellipsoid_radii(axes, task.behind)
    short = base < task.bound
    assert short.any()
    assert (~short).any()
    behind = slice(len(rows.radii) - len(task.behind), None)
    assert np.allclose(rows.radii[behind], np.maximum(base, task.bound))
    assert (rows.weights[behind][short] > rows.weights[behind][~short].max()).all()


def test_a_step_that_does_not_help_is_halved_and_misses_never_grow(solid: Solid) -> None:
    parting = Parting(solid)
    assert parting.grown(2)
    piece = parting.pieces(2)[0]
    task = task_of(solid, piece.region, piece.members, piece.centre, 1)
    axes = fit_ellipsoid(start_rows(task, solid))
    rows = first_rows(task, solid, leaf_of(piece.centre, axes, ScaleField.none()))
    leaf = leaf_of(piece.centre, 1.3 * axes, select_centres(rows, axes, grid_for(300), 40).field(40))
    view = view_of(task.directions, leaf)
    costs = []
    for steps in range(4):
        found = improved(solid, task, leaf, view, steps, 1.5)[1]
        costs.append(float((weights_of(found, solid, 1.5) * found.miss**2).sum()))
    assert (np.diff(costs) <= 0.0).all()
    assert costs[3] < 0.5 * costs[0]


def test_what_a_leaf_misses_does_not_depend_on_where_one_looks_first(solid: Solid) -> None:
    piece = Parting(solid).pieces(1)[0]
    task = task_of(solid, piece.region, piece.members, piece.centre, 1)
    one = leaf_of(piece.centre, fit_ellipsoid(start_rows(task, solid)), ScaleField.none())
    other = leaf_of(piece.centre, 1.1 * np.asarray(one.superquadric.half_axes), ScaleField.none())
    view = view_of(task.directions, other)
    plain, told = misses(task, solid, other, view), misses(task, solid, other, view, misses(task, solid, one, view))
    assert np.allclose(np.abs(plain.miss), np.abs(told.miss), rtol=0.0, atol=1e-12)
    assert (plain.nearest >= 0).all()
    again = misses(task, solid, other, view, own=plain)
    assert np.array_equal(again.miss, plain.miss)


def test_a_fit_far_behind_its_rival_is_given_up(solid: Solid) -> None:
    parting = Parting(solid)
    assert parting.grown(3)
    workshop = Workshop(solid, aim_of(0.01))
    best = fit_leaves(workshop, parting.pieces(3), 120, SCOUT)
    assert best.mean < best.first
    assert best.score == pytest.approx(best.mean + 0.01 * best.largest)
    worse = fit_leaves(workshop, parting.pieces(1), 120, SCOUT, best)
    assert worse.first == worse.mean > 1.3 * best.first
    assert worse.score > 1.3 * best.score
    near = fit_leaves(workshop, parting.pieces(3), 118, SCOUT, best)
    assert near.first < 1.3 * best.first
    assert near.mean < near.first


def test_work_handed_out_by_a_thread_stays_in_it() -> None:
    def outer(k: int) -> tuple[int, list[bool]]:
        own = threading.get_ident()
        return k, [n == own for n in in_threads(lambda _: threading.get_ident(), 3)]

    usual = numba.get_num_threads()
    try:
        numba.set_num_threads(min(2, numba.config.NUMBA_NUM_THREADS))
        assert in_threads(outer, 4) == [(k, [True] * 3) for k in range(4)]
        assert in_threads(lambda k: k * k, 5) == [0, 1, 4, 9, 16]
    finally:
        numba.set_num_threads(usual)


def test_directions_side_by_side_are_the_same_ones_nearer_to_each_other() -> None:
    given = turned_fibonacci(2000, 3)
    ordered = side_by_side(given)
    assert np.array_equal(given[np.lexsort(given.T)], ordered[np.lexsort(ordered.T)])
    apart = [float(np.linalg.norm(np.diff(u, axis=0), axis=1).mean()) for u in (given, ordered)]
    assert apart[1] < 0.1 * apart[0]


def test_scaling_scales_every_length() -> None:
    leaf = leaf_of(frozen([1.0, 2.0, 3.0]), frozen(np.arange(1.0, 7.0)), ScaleField.none())
    node = scaled(Cut(frozen([0.3, 0.2]), 2.0, 0.5, (), leaf, leaf), 3.0)
    assert isinstance(node, Cut)
    assert isinstance(node.left, ModelLeaf)
    assert (node.offset, node.half_width) == (6.0, 1.5)
    assert np.allclose(node.left.centre, [3.0, 6.0, 9.0])
    assert np.allclose(node.left.superquadric.half_axes, 3.0 * np.arange(1.0, 7.0))
