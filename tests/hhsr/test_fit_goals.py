"""What a fit is asked for: errors that it must keep, mean against maximum, pieces kept as triangles."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

import hhsr
from hhsr.errors import InputError
from hhsr.fitting.aim import aim_of
from hhsr.fitting.goals import enough, excess
from hhsr.fitting.keep import affordable, least_numbers
from hhsr.fitting.lookahead import Parting
from hhsr.fitting.normalise import normalise, on_grid
from hhsr.fitting.options import FitOptions
from hhsr.fitting.recipe import fit_default
from hhsr.fitting.scale_field import leaf_of
from hhsr.fitting.solid import everywhere, solid_of
from hhsr.model import ErrorFigures, ModelLeaf, Node, RetainedPart, ScaleField, leaves


def bumpy() -> tuple[np.ndarray, np.ndarray]:
    ball = trimesh.creation.icosphere(subdivisions=4)
    u = np.array(ball.vertices)
    radius = 20.0 * (1.0 + 0.15 * np.sin(3.0 * u[:, 0] + 1.0) * u[:, 1] + 0.05 * np.cos(7.0 * u[:, 1]))
    return u * radius[:, None] * (1.4, 1.0, 0.8), np.array(ball.faces)


def test_the_stored_fit_keeps_the_errors_asked_for_and_spends_no_more_than_a_little() -> None:
    surface = hhsr.Surface.from_mesh(*bumpy())
    errors = {}
    for goal in (0.4, 0.1):
        shape = hhsr.fit(surface, FitOptions(max_mean_error_mm=goal))
        assert shape.fit_error is not None
        assert shape.fit_error.mean_mm <= goal
        errors[goal] = shape
    assert errors[0.4].parameters < errors[0.1].parameters < 200
    strict = hhsr.fit(surface, FitOptions(max_mean_error_mm=0.4, max_error_mm=0.8))
    assert strict.fit_error is not None
    assert strict.fit_error.max_mm <= 0.8


def test_budgets_grow_by_the_excess_until_the_goal_or_the_cap() -> None:
    vertices, faces = normalise(*bumpy())[0], bumpy()[1]
    asked: list[int] = []

    def fitted(budget: int) -> Node:
        asked.append(budget)
        return leaf_of(np.zeros(3), np.full(6, 20.0), ScaleField.none())

    root = enough(fitted, vertices, faces, FitOptions(max_mean_error_mm=1e-3, max_parameters=400))
    assert isinstance(root, ModelLeaf)
    assert asked == [64, 192, 400]  # three times as many at most, and never more than the cap
    asked.clear()
    enough(fitted, vertices, faces, FitOptions(max_error_mm=100.0))
    assert asked == [64]


def test_excess_is_the_worse_of_both_goals() -> None:
    error = ErrorFigures(0.2, 0.5, 3.0)
    assert excess(error, FitOptions(max_mean_error_mm=0.1)) == pytest.approx(2.0)
    assert excess(error, FitOptions(max_error_mm=1.0)) == pytest.approx(3.0)
    assert excess(error, FitOptions(max_mean_error_mm=0.1, max_error_mm=6.0)) == pytest.approx(2.0)


def test_a_heavier_maximum_raises_the_power_within_bounds() -> None:
    assert aim_of(0.01).power == pytest.approx(1.5)
    assert aim_of(0.1).power == pytest.approx(2.0)
    assert aim_of(1.0).power == pytest.approx(2.5)
    assert aim_of(0.0).power == pytest.approx(1.2)
    with pytest.raises(InputError, match="max_error_weight"):
        FitOptions(max_error_weight=1.5)


def test_a_body_of_few_triangles_is_kept_as_it_is() -> None:
    box = trimesh.creation.box((40.0, 25.0, 10.0))
    vertices, faces = normalise(np.array(box.vertices), np.array(box.faces))[0], np.array(box.faces)
    node = fit_default(vertices, faces, FitOptions(max_parameters=100))
    assert isinstance(node, RetainedPart)
    assert node.parameters == 60
    assert np.abs(node.vertices - vertices).max() < 1e-3
    assert isinstance(fit_default(vertices, faces, FitOptions(max_parameters=60)), ModelLeaf)  # no room for a pose


def box_and_ball() -> tuple[np.ndarray, np.ndarray]:
    """A bumpy body and, apart from it, an oblique box of twelve triangles."""
    vertices, faces = bumpy()
    box = trimesh.creation.box((16.0, 12.0, 14.0))
    box.apply_transform(trimesh.transformations.euler_matrix(0.4, 0.7, 0.2))
    moved = np.array(box.vertices) + np.array([60.0, 4.0, 0.0])
    return np.vstack([vertices, moved]), np.vstack([faces, np.array(box.faces) + len(vertices)])


def test_a_piece_of_few_triangles_is_bought_as_it_is() -> None:
    vertices, faces = box_and_ball()
    surface = hhsr.Surface.from_mesh(vertices, faces)
    shape = hhsr.fit(surface, FitOptions(max_parameters=220))
    kinds = [type(leaf) for leaf in leaves(shape.tree.root)]
    assert RetainedPart in kinds
    assert ModelLeaf in kinds
    assert shape.parameters <= 220
    on_box = np.flatnonzero([isinstance(leaf, RetainedPart) for leaf in leaves(shape.tree.root)])
    assert max(shape.leaf_errors[k].max_mm for k in on_box) < 0.01
    assert shape.mesh().is_watertight


def test_parts_too_large_are_not_offered() -> None:
    vertices, faces = box_and_ball()
    unit, size = on_grid(normalise(vertices, faces)[0], np.arange(len(vertices)))
    solid = solid_of(unit, faces, 3000, 0)
    parting = Parting(solid)
    assert parting.grown(2)
    pieces = parting.pieces(2)
    assert least_numbers(solid, everywhere()) == 3 * len(vertices) + 3 * len(faces)
    found = affordable(solid, pieces, 120, size)
    assert [part.parameters for part in found.values()] == [60]
    assert affordable(solid, pieces, 59, size) == {}
