"""The frame of the fit and the samples on a surface."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from hhsr.errors import SurfaceError
from hhsr.fitting.normalise import apply_inverse, normalise
from hhsr.fitting.samples import area_samples, face_areas, turned_fibonacci, vertex_normals
from hhsr.model import rotation_matrix


def lopsided() -> tuple[np.ndarray, np.ndarray]:
    """A closed body with three different axes and no mirror plane."""
    ball = trimesh.creation.icosphere(subdivisions=3)
    v = np.array(ball.vertices)
    v[:, 0] = np.expm1(v[:, 0])
    v[:, 1] = np.expm1(v[:, 1])
    v[:, 2] += 0.1 * v[:, 0]
    return v * (40.0, 25.0, 12.0), np.array(ball.faces)


def test_the_solid_lies_centred_on_its_principal_axes_with_positive_third_moments() -> None:
    vertices, faces = lopsided()
    turned = vertices @ Rotation.from_rotvec([0.3, -1.1, 2.0]).as_matrix().T + (100.0, -20.0, 7.0)
    mesh = trimesh.Trimesh(normalise(turned, faces)[0], faces, process=False)
    assert np.abs(mesh.center_mass).max() < 5e-3
    second = mesh.moment_inertia
    assert np.abs(second - np.diag(np.diag(second))).max() < 1e-3 * second.max()
    assert second[0, 0] < second[1, 1] < second[2, 2]
    corners = mesh.triangles
    shares = np.random.default_rng(0).dirichlet(np.ones(4), (corners.shape[0], 40))[..., :3]
    inside = np.einsum("fsk,fki->fsi", shares, corners)
    volumes = np.linalg.det(corners)
    assert (np.einsum("f,fsi->i", volumes, inside**3)[:2] > 0).all()


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(0.01, 100.0))
def test_a_rigid_motion_moves_only_the_pose_and_a_scaling_only_scales(seed: int, scale: float) -> None:
    vertices, faces = lopsided()
    random = np.random.default_rng(seed)
    moved = scale * vertices @ Rotation.random(random_state=random).as_matrix().T + random.normal(0, 50, 3) * scale
    here, _ = normalise(vertices, faces)
    there, pose = normalise(moved, faces)
    assert np.abs(there / scale - here).max() < 1e-9
    extent = np.ptp(moved, axis=0).max()
    assert np.abs(there @ rotation_matrix(pose[:3]).T + pose[3:] - moved).max() < 1e-6 * extent
    assert np.abs(there - apply_inverse(moved, pose)).max() < 1e-6 * extent


def test_points_without_faces_and_orphans() -> None:
    vertices, faces = lopsided()
    cloud, _ = normalise(vertices, None)
    assert np.abs(cloud.mean(axis=0)).max() < 5e-3
    orphaned, _ = normalise(np.vstack([vertices, [[500.0, 0.0, 0.0]]]), faces)
    assert np.array_equal(orphaned[:-1], normalise(vertices, faces)[0])


@pytest.mark.parametrize("points", [np.zeros((3, 3)), np.ones((9, 3))])
def test_what_spans_no_solid_is_refused(points: np.ndarray) -> None:
    with pytest.raises(SurfaceError, match="expected"):
        normalise(points, None)


def test_samples_are_even_by_area_repeatable_and_on_the_surface() -> None:
    vertices, faces = lopsided()
    samples = area_samples(vertices, faces, 5000, seed=3)
    again = area_samples(vertices, faces, 5000, seed=3)
    assert all(np.array_equal(a, b) for a, b in zip(samples, again, strict=True))
    assert not np.array_equal(samples.points, area_samples(vertices, faces, 5000, seed=4).points)
    expected = 5000 * face_areas(vertices, faces) / face_areas(vertices, faces).sum()
    assert np.abs(np.bincount(samples.face, minlength=faces.shape[0]) - expected).max() < 2.0
    corner = vertices[faces[samples.face, 0]]
    assert np.abs(np.einsum("ni,ni->n", samples.points - corner, samples.normals)).max() < 1e-9
    mesh = trimesh.Trimesh(vertices, faces, process=False)
    assert np.einsum("ni,ni->n", samples.normals, mesh.face_normals[samples.face]).min() > 1 - 1e-9


def test_a_surface_without_area_is_refused() -> None:
    with pytest.raises(SurfaceError, match="no area"):
        area_samples(np.zeros((3, 3)), np.array([[0, 1, 2]]), 10)


def test_directions_and_vertex_normals_are_unit_and_even() -> None:
    directions = turned_fibonacci(2000, seed=1)
    assert np.allclose((directions**2).sum(axis=1), 1.0)
    assert np.abs(directions.mean(axis=0)).max() < 1e-2
    ball = trimesh.creation.icosphere(subdivisions=3)
    vertices = np.vstack([ball.vertices, [[9.0, 9.0, 9.0]]])
    normals = vertex_normals(vertices, np.array(ball.faces))
    assert np.einsum("ni,ni->n", normals[:-1], vertices[:-1]).min() > 0.999
    assert (normals[-1] == 0).all()
