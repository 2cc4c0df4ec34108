"""Richer bases of a leaf: their radii and slopes, and that they are bought where they bring more than centres."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

import hhsr
from hhsr.errors import InputError
from hhsr.evaluate import leaf_radius
from hhsr.fitting.base import ANY, TURNED, base_radii, base_slopes, local
from hhsr.fitting.bases import base_that_pays, squares_left
from hhsr.fitting.options import FitOptions
from hhsr.fitting.samples import turned_fibonacci
from hhsr.fitting.scale_field import fit_ellipsoid, grid_for, leaf_of, select_centres
from hhsr.fitting.solid import everywhere, solid_of
from hhsr.fitting.task import Task, first_rows, start_rows, task_of
from hhsr.model import ModelLeaf, ScaleField, Superquadric, leaves

AXES = np.array([3.0, 2.5, 2.0, 1.5, 1.0, 1.2])


def leaf(rotation: list[float], azimuth: list[float], elevation: list[float]) -> ModelLeaf:
    base = Superquadric(AXES, np.array(azimuth), np.array(elevation))
    return ModelLeaf(np.zeros(3), np.array(rotation), base, ScaleField.none())


@pytest.mark.parametrize(
    ("rotation", "azimuth", "elevation"),
    [([], [], []), ([0.3, -0.2, 0.5], [], []), ([0.3, -0.2, 0.5], [0.4], [-0.3]), ([], [0.2, -0.4, 0.1], [0.5, 0.0])],
)
def test_slopes_are_those_of_differences(rotation: list[float], azimuth: list[float], elevation: list[float]) -> None:
    one, u = leaf(rotation, azimuth, elevation), turned_fibonacci(60, 4)
    radii = base_radii(one, u)
    turn = Rotation.from_rotvec(rotation).as_matrix() if rotation else np.eye(3)
    assert np.allclose(local(one, u), u @ turn)
    assert np.allclose(radii, leaf_radius(one, u @ turn))
    slopes = base_slopes(one, u, radii)
    assert slopes.shape == (60, 6 + len(azimuth) + len(elevation))
    values = np.concatenate([np.log(AXES), azimuth, elevation])
    for k in range(values.size):
        moved = values + 1e-6 * (np.arange(values.size) == k)
        base = Superquadric(np.exp(moved[:6]), moved[6 : 6 + len(azimuth)], moved[6 + len(azimuth) :])
        rise = (base_radii(ModelLeaf(one.centre, one.rotation, base, one.scale_field), u) - radii) / 1e-6
        assert np.abs(slopes[:, k] - rise).max() < 1e-4


def task_of_body(vertices: np.ndarray, faces: np.ndarray) -> tuple[Task, ModelLeaf, object]:
    """The task of a body seen from the origin, and its ellipsoid with twelve centres."""
    solid = solid_of(vertices / np.ptp(vertices, axis=0).max(), faces, 3000, 0)
    task = task_of(solid, everywhere(), np.arange(3000), np.zeros(3), 1)
    axes = fit_ellipsoid(start_rows(task, solid))
    bare = leaf_of(np.zeros(3), axes, ScaleField.none())
    return (
        task,
        leaf_of(np.zeros(3), axes, select_centres(first_rows(task, solid, bare), axes, grid_for(200), 12).field(12)),
        solid,
    )


def test_an_oblique_ellipsoid_buys_a_turn_and_an_upright_one_does_not() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)
    upright = np.array(ball.vertices) * (30.0, 12.0, 9.0)
    oblique = upright @ Rotation.from_rotvec([0.3, 0.5, 0.6]).as_matrix().T
    for vertices, size in ((upright, 0), (oblique, 3)):
        task, one, solid = task_of_body(vertices, np.array(ball.faces))
        bought = base_that_pays(solid, task, one, TURNED)  # type: ignore[arg-type]
        assert bought.rotation.size == size
        assert bought.scale_field.index.size == 0
        grid = one.scale_field.grid
        ellipsoid = leaf_of(np.zeros(3), np.asarray(one.superquadric.half_axes), ScaleField.none())
        left = squares_left(solid, task, bought, grid, 9)  # type: ignore[arg-type]
        assert left <= squares_left(solid, task, ellipsoid, grid, 12)  # type: ignore[arg-type]


def test_a_rounded_box_buys_exponents() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)
    u = np.array(ball.vertices)
    box = u / ((np.abs(u) / (30.0, 20.0, 12.0)) ** 8).sum(axis=1)[:, None] ** (1.0 / 8.0)
    task, one, solid = task_of_body(box, np.array(ball.faces))
    bought = base_that_pays(solid, task, one, ANY)  # type: ignore[arg-type]
    assert bought.superquadric.parameters > 6


def test_bought_bases_keep_the_budget_and_are_stored() -> None:
    ball = trimesh.creation.icosphere(subdivisions=4)
    u = np.array(ball.vertices)
    box = u / ((np.abs(u) / (30.0, 20.0, 12.0)) ** 8).sum(axis=1)[:, None] ** (1.0 / 8.0)
    surface = hhsr.Surface.from_mesh(box, np.array(ball.faces))
    fits = [hhsr.fit(surface, FitOptions(max_parameters=60, bases=bases)) for bases in ("ellipsoid", "any")]  # type: ignore[arg-type]
    assert all(shape.parameters <= 60 for shape in fits)
    assert any(one.superquadric.parameters > 6 for one in leaves(fits[1].tree.root) if isinstance(one, ModelLeaf))
    assert fits[0].fit_error is not None
    assert fits[1].fit_error is not None
    assert fits[1].fit_error.mean_mm < 0.8 * fits[0].fit_error.mean_mm
    with pytest.raises(InputError, match="bases"):
        FitOptions(bases="round")  # type: ignore[arg-type]
