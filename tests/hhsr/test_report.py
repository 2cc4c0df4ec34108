"""What the report says of a fit, where it is known: concentric balls, a step of known width, an empty part."""

from __future__ import annotations

import numpy as np
import pytest
import trimesh

from hhsr.fitting.report import figures_of, measure
from hhsr.local_error import owners
from hhsr.model import Cut, ModelLeaf, Node, RetainedPart, ScaleField, Superquadric, Tree, frozen
from hhsr.shape import Shape


def ball_leaf(radius: float) -> ModelLeaf:
    return ModelLeaf(frozen([0.0] * 3), frozen([]), Superquadric(frozen([radius] * 6)), ScaleField.none())


def shape_of(root: Node) -> Shape:
    return Shape(Tree(root, frozen([0.0] * 6)))


def source(radius: float) -> tuple[np.ndarray, np.ndarray]:
    mesh = trimesh.creation.icosphere(subdivisions=5, radius=radius)
    return np.array(mesh.vertices), np.array(mesh.faces, dtype=np.int64)


def test_concentric_balls_are_their_difference_apart() -> None:
    got = measure(shape_of(ball_leaf(21.0)), *source(20.0), samples=2000)
    assert got.error.mean_mm == pytest.approx(1.0, abs=0.03)
    assert got.error.max_mm == pytest.approx(1.0, abs=0.05)
    assert got.leaf_errors == (got.error,)
    assert got.report["cuts"] == []
    assert got.report["topology"]["bodies"] == [1, 1]
    assert got.report["topology"]["genus"] == [0, 0]
    assert got.report["topology"]["volume_ml"][1] == pytest.approx(4 / 3 * np.pi * 21.0**3 / 1000, rel=0.005)


def test_a_step_and_the_leaves_on_its_sides() -> None:
    root = Cut(frozen([0.0, np.pi / 2]), 0.0, 0.0, (), ball_leaf(20.0), ball_leaf(22.0))
    got = measure(shape_of(root), *source(20.0), samples=4000)
    (step,) = got.report["cuts"]
    assert step["step_area_mm2"] == pytest.approx(np.pi * (22.0**2 - 20.0**2), rel=0.02)
    assert 0.2 < step["largest_step_mm"] < 2.0
    left, right = got.leaf_errors
    assert left.mean_mm < 0.2 < 1.5 < right.mean_mm


def test_an_empty_solid_is_never_near() -> None:
    empty = RetainedPart(frozen(np.zeros((0, 3))), frozen(np.zeros((0, 3)), np.int64))
    assert measure(shape_of(empty), *source(20.0), samples=1000).error.mean_mm > 40.0


def test_owners_descend_by_the_planes() -> None:
    inner = Cut(frozen([0.0, 0.0]), 5.0, 0.0, (), ball_leaf(1.0), ball_leaf(1.0))
    tree = Tree(Cut(frozen([0.0, np.pi / 2]), 0.0, 0.0, (), ball_leaf(1.0), inner), frozen([0.0, 0, 0, 0, 0, 10.0]))
    points = np.array([[0.0, 0, 9.0], [0.0, 0, 11.0], [6.0, 0, 11.0]])
    assert owners(tree, points).tolist() == [0, 1, 2]


def test_figures_of_nothing_and_of_numbers() -> None:
    assert figures_of(np.zeros(0)) == (0.0, 0.0, 0.0)
    assert figures_of(np.arange(101.0)) == (50.0, 95.0, 100.0)
