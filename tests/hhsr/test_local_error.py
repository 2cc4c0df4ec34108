"""The error of a fit at a point: what the samples of its cell say, kept in the file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

import hhsr
from hhsr.errors import InputError
from hhsr.fitting.report import measure
from hhsr.local_error import CELLS, LETTERS, cells_of, encoded
from hhsr.model import Cut, ErrorFigures, ModelLeaf, Provenance, ScaleField, Superquadric, Tree, frozen
from hhsr.shape import Shape


def ball(centre: float, radius: float) -> ModelLeaf:
    return ModelLeaf(
        frozen([centre, 0.0, 0.0]), frozen([]), Superquadric(frozen(np.full(6, radius))), ScaleField.none()
    )


def bumped() -> tuple[Tree, np.ndarray, np.ndarray]:
    """Two balls parted at x = 0, moved and turned; and a source whose right ball has a bump of 2 mm towards +x."""
    pose = frozen([0.0, 0.0, 0.5 * np.pi, 5.0, 6.0, 7.0])
    tree = Tree(Cut(frozen([0.0, 0.0]), 0.0, 0.0, (), ball(-15.0, 10.0), ball(15.0, 10.0)), pose)
    sphere = trimesh.creation.icosphere(subdivisions=4, radius=10.0)
    u = np.array(sphere.vertices) / 10.0
    right = u * (10.0 + 2.0 * np.exp(-60.0 * (1.0 - u[:, 0])))[:, None]
    shift = np.array([15.0, 0.0, 0.0])
    vertices = np.vstack([10.0 * u - shift, right + shift])
    turned = np.column_stack([-vertices[:, 1], vertices[:, 0], vertices[:, 2]]) + pose[3:]
    return tree, turned, np.vstack([sphere.faces, sphere.faces + len(u)])


def test_a_spike_rules_its_own_cell_only(tmp_path: Path) -> None:
    tree, vertices, faces = bumped()
    found = measure(Shape(tree), vertices, faces, 4000, 1)
    provenance = Provenance(fit_error=found.error, leaf_errors=found.leaf_errors, report=found.report)
    Shape(tree, provenance).save(tmp_path / "two.hhsr")
    shape = hhsr.load(tmp_path / "two.hhsr")
    tip = np.array([5.0, 6.0 + 26.0, 7.0])
    away = np.array([[5.0 - 10.0, 6.0 + 14.0, 7.0], [5.0, 6.0 - 25.0, 7.0]])
    assert shape.fit_error is not None
    assert shape.fit_error_at(tip + 0.1) == pytest.approx(shape.fit_error.max_mm)
    assert 1.5 < shape.fit_error_at(tip) < 2.1
    assert (shape.fit_error_at(away) < 0.25).all()
    assert shape.fit_error_at(np.stack([away, away])).shape == (2, 2)


def test_no_sample_misses_by_more_than_its_cell_says() -> None:
    tree, vertices, faces = bumped()
    found = measure(Shape(tree), vertices, faces, 3000, 1)
    shape = Shape(tree, Provenance(fit_error=found.error, leaf_errors=found.leaf_errors, report=found.report))
    # Distance to the true solid at the source's own vertices; a cell's figure is sampled, so it may be a little short.
    distance = np.abs(shape.signed_distance(vertices))
    assert (distance <= 1.2 * shape.fit_error_at(vertices) + 0.02).all()
    assert shape.fit_error_at(vertices).mean() < 0.5 * found.error.max_mm


def test_letters_are_never_below_what_they_stand_for() -> None:
    rng = np.random.default_rng(0)
    largest = np.exp(rng.uniform(-12.0, 1.0, 2 * CELLS))
    largest[3] = np.nan
    figures = [ErrorFigures(0.1, 0.2, float(np.nanmax(part))) for part in np.split(largest, 2)]
    whole = ErrorFigures(0.1, 0.2, max(f.max_mm for f in figures))
    letters = encoded(largest, whole, figures)
    back = whole.max_mm * 2.0 ** (-np.array([LETTERS.index(c) for c in letters]) / 2.0)
    wanted = np.where(np.isnan(largest), figures[0].max_mm, largest)
    assert (back >= wanted * (1.0 - 1e-6)).all()
    near = wanted > whole.max_mm * 1e-3
    assert (back[near] <= 1.42 * wanted[near]).all()


def test_without_cells_the_leaf_says_and_without_figures_nobody() -> None:
    tree, vertices, _ = bumped()
    figures = (ErrorFigures(0.1, 0.2, 0.3), ErrorFigures(0.1, 0.2, 2.0))
    shape = Shape(tree, Provenance(fit_error=ErrorFigures(0.1, 0.2, 2.0), leaf_errors=figures))
    assert set(np.unique(shape.fit_error_at(vertices))) == {0.3, 2.0}
    assert set(np.unique(cells_of(tree, vertices) // CELLS)) == {0, 1}
    lone = Shape(tree, Provenance(fit_error=ErrorFigures(0.1, 0.2, 2.0)))
    assert lone.fit_error_at(vertices[0]) == 2.0
    with pytest.raises(InputError, match="not measured"):
        Shape(tree).fit_error_at(vertices)
    with pytest.raises(InputError, match="points"):
        shape.fit_error_at([np.nan, 0.0, 0.0])
