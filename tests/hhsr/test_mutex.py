"""Contour maps, mutex pairs and the utility of Eq. 9, against what can be said in closed form."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from hhsr.fitting.cuts import Plane, candidate_planes, ranked_planes, utilities
from hhsr.fitting.mutex import MutexPairs, hemisphere, mutex_pairs
from hhsr.fitting.samples import area_samples
from hhsr.fitting.split import Part
from hhsr.kernels.section import chain_segments, contour_map, passes_through, plane_segments


def ball(radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    mesh = trimesh.creation.icosphere(subdivisions=3, radius=radius)
    mesh.apply_translation(centre)
    return mesh


def dumbbell() -> tuple[np.ndarray, np.ndarray]:
    """Two balls of 10 mm, 24 mm apart, joined by a rod: one closed mesh with one obvious cut."""
    rod = trimesh.creation.cylinder(radius=3.0, height=24.0, sections=24)
    rod.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (0, 1, 0)))
    mesh = trimesh.boolean.union([ball(10.0, (-12, 0, 0)), ball(10.0, (12, 0, 0)), rod], engine="manifold")
    return np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)


def pairs_of(vertices: np.ndarray, faces: np.ndarray, threshold: float = 3.0) -> MutexPairs:
    return mutex_pairs(vertices, faces, np.zeros(len(faces), dtype=bool), threshold, 24)


def test_section_of_a_ball_is_one_circle_of_the_right_length() -> None:
    mesh = ball(20.0)
    vertices, faces = np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)
    points, starts, _ = contour_map(
        vertices, faces, np.zeros(len(faces), dtype=bool), np.ascontiguousarray(vertices[:, 2]), 5.0, 0.5
    )
    assert len(starts) == 2
    assert np.allclose(points[:, 2], 5.0)
    steps = np.linalg.norm(np.roll(points, -1, axis=0) - points, axis=1)
    assert steps.max() <= 0.5 + 1e-9
    assert steps.sum() == pytest.approx(2 * np.pi * np.sqrt(20.0**2 - 5.0**2), rel=0.01)


def test_chains_are_closed_loops_even_through_vertices() -> None:
    vertices, faces = dumbbell()
    heights = np.ascontiguousarray(vertices[:, 0])
    for offset in (float(heights[0]), float(heights[len(heights) // 2]), 0.0):
        points, keys, _ = plane_segments(vertices, faces, heights, offset)
        walk, offsets = chain_segments(keys)
        assert offsets[-1] == len(keys)
        for a, b in zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True):
            ends = walk[a:b]
            leaving = points[ends >> 1, 1 - (ends & 1)]
            entering = points[np.roll(ends, -1) >> 1, np.roll(ends, -1) & 1]
            assert np.array_equal(leaving, entering)


def test_a_convex_body_has_no_pairs() -> None:
    mesh = ball(20.0)
    assert len(pairs_of(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)).weights) == 0


def test_a_dumbbell_is_cut_through_its_waist() -> None:
    vertices, faces = dumbbell()
    pairs = pairs_of(vertices, faces)
    assert pairs.total > 0
    samples = area_samples(vertices, faces, 4000).points
    plane = ranked_planes(pairs, samples)[0]
    assert abs(plane.normal[0]) > 0.9
    assert abs(plane.offset) < 3.0


def test_pairs_do_not_depend_on_the_frame_and_weigh_less_when_scaled() -> None:
    vertices, faces = dumbbell()
    pairs = pairs_of(vertices, faces)
    larger = pairs_of(2.0 * vertices, faces, 6.0)
    assert len(larger.weights) == len(pairs.weights)
    assert larger.total == pytest.approx(pairs.total / 2.0, rel=1e-9)


def test_a_pair_behind_a_third_component_is_dropped() -> None:
    centres = (-12.0, 0.0, 12.0)
    mesh = trimesh.util.concatenate([ball(4.0, (x, 0.0, 0.0)) for x in centres])
    pairs = pairs_of(np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64), 2.0)
    of_ball = np.abs(pairs.points[:, :, :1] - np.array(centres)).argmin(axis=2)
    assert len(of_ball) > 0
    middle = np.abs(pairs.points[:, :, 1:]).max(axis=(1, 2)) < 2.0
    assert not ((np.abs(of_ball[:, 0] - of_ball[:, 1]) == 2) & middle).any()


def test_passes_through_needs_a_contour_on_both_sides() -> None:
    square = np.array([[-1.0, -1.0], [1.0, -1.0], [1.0, 1.0], [-1.0, 1.0]])
    flat = np.concatenate([square, [[-5.0, 0.0], [5.0, 0.0], [-5.0, 3.0], [5.0, 3.0]]])
    starts = np.array([0, 4])
    label = np.array([0])
    assert passes_through(flat, starts, label, 1, 2, 4, 5)
    assert not passes_through(flat, starts, label, 1, 2, 6, 7)
    assert not passes_through(flat, starts, label, 0, 2, 4, 5)


def test_utility_is_equation_9() -> None:
    random = np.random.default_rng(3)
    pairs = MutexPairs(random.normal(size=(12, 2, 3)), random.random(12))
    normals, offsets = candidate_planes(pairs)
    got, cut = utilities(pairs, normals, offsets)
    for k in range(12):
        side = pairs.points @ normals[k] >= offsets[k]
        split = side[:, 0] != side[:, 1]
        left, right = int((~side).all(axis=1).sum()), int(side.all(axis=1).sum())
        factor = 1.0 - min(left, right) / max(left, right) if max(left, right) else 1.0
        along = pairs.points[:, 0] - pairs.points[:, 1]
        along = np.abs(along @ normals[k]) / np.linalg.norm(along, axis=1)
        assert cut[k] == split.sum() >= 1
        assert got[k] == pytest.approx(factor * (pairs.weights * along)[split].sum())
        assert offsets[k] == pytest.approx(normals[k] @ pairs.points[k].mean(axis=0))


def test_planes_that_leave_a_side_empty_are_never_taken() -> None:
    pairs = MutexPairs(np.array([[[0.0, 0, 9.9], [0, 0, 10.1]]]), np.ones(1))
    points = np.random.default_rng(0).random((500, 3))
    assert ranked_planes(pairs, points) == []
    assert ranked_planes(MutexPairs(np.zeros((0, 2, 3)), np.zeros(0)), points) == []


def test_parts_share_the_volume_and_know_their_caps() -> None:
    vertices, faces = dumbbell()
    whole = Part(vertices, faces)
    left, right = whole.cut(Plane(np.array([1.0, 0.0, 0.0]), 0.5))
    volumes = [trimesh.Trimesh(p.vertices, p.faces, process=False).volume for p in (whole, left, right)]
    assert volumes[1] + volumes[2] == pytest.approx(volumes[0], rel=1e-9)
    caps = left.vertices[left.faces[left.capped()]]
    assert len(caps) > 0
    assert np.allclose(caps[..., 0], 0.5)
    assert right.holds(np.array([[1.0, 0, 0], [0, 0, 0]])).tolist() == [True, False]
    assert left.exits(np.zeros((2, 3)), np.array([[1.0, 0, 0], [-1.0, 0, 0]])).tolist() == [0.5, np.inf]


def test_hemisphere_is_one_half() -> None:
    normals = hemisphere(40)
    assert normals.shape == (40, 3)
    assert (normals[:, 2] > 0).all()
