"""Numbers rounded as they are stored."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from hhsr.evaluate import leaf_radius
from hhsr.fitting.quantise import ANGLE_STEP, quantised, rounded_plane, weight_step
from hhsr.fitting.samples import turned_fibonacci
from hhsr.fitting.scale_field import grid_for
from hhsr.io import encode
from hhsr.model import (
    Contour,
    Cut,
    ModelLeaf,
    Node,
    Provenance,
    RetainedPart,
    ScaleField,
    Superquadric,
    Tree,
    cuts,
    frozen,
    leaves,
)


def some_tree(seed: int, size: float) -> Cut:
    """A cut with a band between a leaf and a retained part, of random numbers."""
    random = np.random.default_rng(seed)
    grid = grid_for(400)
    index = np.sort(random.choice(grid.size, 60, replace=False))
    base = Superquadric(frozen(size * random.uniform(0.2, 1.0, 6)), frozen(random.normal(0, 1, 4)), frozen([0.3]))
    leaf = ModelLeaf(
        frozen(size * random.normal(0, 0.2, 3)),
        frozen(random.normal(0, 1, 3)),
        base,
        ScaleField(grid, frozen(index, np.int64), frozen(random.normal(0, 0.05, 60))),
    )
    part = RetainedPart(
        frozen(size * random.normal(0, 0.3, (4, 3))), frozen([[0, 2, 1], [0, 1, 3], [1, 2, 3], [0, 3, 2]], np.int64)
    )
    contour = Contour(
        frozen(size * random.normal(0, 0.1, 2)),
        frozen(size * random.uniform(0.2, 0.5, 4)),
        frozen([]),
        frozen(random.normal(0, 0.03, 6)),
    )
    return Cut(frozen(random.uniform(-1, 1, 2)), 0.1 * size * random.normal(), 0.01 * size, (contour,), leaf, part)


def numbers(node: Node) -> np.ndarray:
    """Every float of a tree."""
    found = [np.concatenate([c.normal_angles, [c.offset, c.half_width]]) for c in cuts(node)]
    found += [np.concatenate([k.centre, k.half_axes, k.logits, k.weights]) for c in cuts(node) for k in c.contours]
    for leaf in leaves(node):
        if isinstance(leaf, RetainedPart):
            found.append(leaf.vertices.ravel())
        else:
            base = leaf.superquadric
            parts = (leaf.centre, leaf.rotation, base.half_axes, base.azimuth_logits, base.elevation_logits)
            found += [np.concatenate(parts), leaf.scale_field.weights]
    return np.concatenate(found)


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1.0, 1000.0))
def test_rounding_moves_no_number_far_and_no_surface_visibly(seed: int, size: float) -> None:
    tree = some_tree(seed, size)
    rounded = quantised(tree)
    assert isinstance(rounded, Cut)
    assert rounded.parameters == tree.parameters
    assert np.abs(numbers(rounded) - numbers(tree)).max() < 4e-5 * max(size, 64.0)
    directions = turned_fibonacci(300, 1)
    before, after = leaf_radius(tree.left, directions), leaf_radius(rounded.left, directions)
    assert np.abs(after - before).max() < 2e-3 * size
    assert not np.signbit(numbers(rounded)[numbers(rounded) == 0.0]).any()


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_a_rounded_tree_is_stored_in_far_fewer_bytes(seed: int) -> None:
    tree = some_tree(seed, 80.0)
    pose = frozen(np.zeros(6))
    assert len(encode(Tree(quantised(tree), pose), Provenance())) < 0.5 * len(encode(Tree(tree, pose), Provenance()))


def test_half_axes_never_round_to_nothing() -> None:
    leaf = ModelLeaf(
        frozen([100.0, 0.0, 0.0]), frozen([]), Superquadric(frozen([1e-9, 50, 1, 1, 1, 1])), ScaleField.none()
    )
    rounded = quantised(leaf)
    assert isinstance(rounded, ModelLeaf)
    assert (rounded.superquadric.half_axes > 0.0).all()


def test_a_tree_without_weights_rounds_too() -> None:
    assert weight_step(np.zeros(0)) == 1.0
    assert weight_step(np.zeros(3)) == 1.0
    empty = RetainedPart(frozen(np.zeros((0, 3))), frozen(np.zeros((0, 3)), np.int64))
    assert quantised(empty).parameters == 0


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 2**32 - 1), st.floats(1.0, 1000.0))
def test_a_plane_rounded_for_the_fit_is_not_moved_by_the_tree_s_rounding(seed: int, size: float) -> None:
    random = np.random.default_rng(seed)
    normal = random.normal(0, 1, 3)
    normal /= np.sqrt((normal**2).sum())
    offset = 0.4 * size * random.uniform(-1, 1)
    angles, height = rounded_plane(normal, offset, size)
    base = Superquadric(frozen(size * random.uniform(0.1, 0.99, 6)))
    leaf = ModelLeaf(frozen(np.zeros(3)), frozen([]), base, ScaleField.none())
    rounded = quantised(Cut(frozen(angles), height, 0.0, (), leaf, leaf))
    assert isinstance(rounded, Cut)
    assert rounded.offset == height
    assert np.array_equal(rounded.normal_angles, angles)
    assert np.abs(rounded.normal - normal).max() < 2 * ANGLE_STEP
    assert abs(height - offset) < 3e-4 * size
