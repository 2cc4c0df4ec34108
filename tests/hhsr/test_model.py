"""The records: what is counted, what is refused to change, and the frames that depend on a normal alone."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hhsr.evaluate import contour_radius, leaf_radius
from hhsr.model import (
    CentreGrid,
    Contour,
    Cut,
    ModelLeaf,
    RetainedPart,
    ScaleField,
    Superquadric,
    Tree,
    cuts,
    depth,
    exponent_of_logit,
    fibonacci_sphere,
    frozen,
    leaves,
    logit_of_exponent,
    normal_angles_of,
    plane_frame,
    rotation_matrix,
    subset_numbers,
)

GRID = CentreGrid((20, 60), 2.5)


def leaf(weights: int = 0, rotation: int = 0, knots: int = 0) -> ModelLeaf:
    index = frozen(range(weights), np.int64)
    return ModelLeaf(
        frozen([1.0, 2.0, 3.0]),
        frozen([0.1] * rotation),
        Superquadric(frozen([4.0] * 6), frozen([0.0] * knots), frozen([0.0] * knots)),
        ScaleField(GRID, index, frozen([0.01] * weights)),
    )


def test_parameters_count_every_stored_number() -> None:
    assert leaf().parameters == 9
    assert leaf(rotation=3, knots=5).parameters == 22
    assert leaf(weights=10).parameters == 9 + 10 + math.ceil(math.log2(math.comb(80, 10)) / 32)
    contour = Contour(frozen([0, 0]), frozen([1.0] * 4), frozen([]), frozen([0.0] * 8))
    part = RetainedPart(frozen(np.zeros((4, 3))), frozen(np.zeros((4, 3)), np.int64))
    banded = Cut(frozen([0, 0]), 0.0, 1.0, (contour,), leaf(), part)
    assert banded.parameters == 3 + 1 + 14 + 9 + 24
    bare = Cut(frozen([0, 0]), 0.0, 0.0, (), banded, leaf())
    assert Tree(bare, frozen(np.zeros(6))).parameters == 6 + 3 + banded.parameters + 9
    assert [type(x) for x in leaves(bare)] == [ModelLeaf, RetainedPart, ModelLeaf]
    assert list(cuts(bare)) == [bare, banded]
    assert depth(bare) == 2


def test_all_or_none_of_the_centres_need_no_index() -> None:
    assert subset_numbers(300, 300) == subset_numbers(300, 0) == 0
    assert subset_numbers(33, 1) == 1
    assert subset_numbers(4000, 160) == math.ceil(math.log2(math.comb(4000, 160)) / 32)


@given(st.tuples(*[st.floats(-1, 1)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-3))
def test_plane_frame_is_right_handed_and_angles_give_the_normal_back(vector: tuple[float, float, float]) -> None:
    normal = np.array(vector) / np.linalg.norm(vector)
    frame = plane_frame(normal)
    np.testing.assert_allclose(frame @ frame.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(frame) == pytest.approx(1.0)
    cut = Cut(frozen(normal_angles_of(normal)), 0.0, 0.0, (), leaf(), leaf())
    np.testing.assert_allclose(cut.normal, normal, atol=1e-12)
    np.testing.assert_allclose(cut.frame[2], cut.normal)


@given(st.floats(0.11, 1.89))
def test_logits_and_exponents_are_inverse(exponent: float) -> None:
    assert exponent_of_logit(logit_of_exponent(exponent)) == pytest.approx(exponent)


def test_records_cannot_be_changed() -> None:
    record = leaf(weights=3)
    with pytest.raises(ValueError, match="read-only"):
        record.scale_field.weights[0] = 1.0
    with pytest.raises(AttributeError):
        record.centre = np.zeros(3)  # type: ignore[misc]


def test_grid_is_even_and_radii_follow_the_records() -> None:
    centres = fibonacci_sphere(500)
    np.testing.assert_allclose(np.linalg.norm(centres, axis=1), 1.0)
    nearest = np.sort(centres @ centres.T, axis=1)[:, -2]
    assert np.arccos(nearest).min() > 0.6 * math.sqrt(4 * math.pi / 500)
    assert GRID.size == len(GRID.centres) == len(GRID.extents) == 80
    assert leaf_radius(leaf(), [[1.0, 2.0, -3.0]])[0] == pytest.approx(4.0)
    assert leaf_radius(leaf(weights=1), [GRID.centres[0]])[0] == pytest.approx(0.99 * 4.0)
    ring = Contour(frozen([0, 0]), frozen([2.0] * 4), frozen([]), frozen([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    assert contour_radius(ring, [-math.pi, 0.0]) == pytest.approx([1.8, 2.0])


def test_rotation_vector_is_rodrigues() -> None:
    from scipy.spatial.transform import Rotation

    vector = np.array([0.3, -1.2, 0.4])
    np.testing.assert_allclose(rotation_matrix(vector), Rotation.from_rotvec(vector).as_matrix(), atol=1e-14)
    np.testing.assert_array_equal(rotation_matrix([]), np.eye(3))
