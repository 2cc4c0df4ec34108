"""Random valid trees: leaves with and without knots and rotation, cuts with and without bands, retained parts."""

from __future__ import annotations

import numpy as np
import trimesh

from hhsr.model import (
    CentreGrid,
    Contour,
    Cut,
    FloatArray,
    ModelLeaf,
    Node,
    RetainedPart,
    ScaleField,
    Superquadric,
    Tree,
    frozen,
    normal_angles_of,
    plane_frame,
)

GRID = CentreGrid((60, 150, 380, 900), 2.5)


def random_leaf(rng: np.random.Generator, centre: FloatArray, size: float = 40.0, centres: int = 30) -> ModelLeaf:
    """Return a leaf of about `size` mm about a centre (3,): rotated or not, with knots or without."""
    index = np.sort(rng.choice(GRID.size, centres, replace=False))
    knots = rng.random() < 0.5
    return ModelLeaf(
        frozen(centre),
        frozen(rng.normal(size=3) * 0.5 if rng.random() < 0.5 else []),
        Superquadric(
            frozen(size * rng.uniform(0.6, 1.2, 6)),
            frozen(rng.normal(size=rng.integers(3, 7)) if knots else []),
            frozen(rng.normal(size=rng.integers(2, 6)) if knots else []),
        ),
        ScaleField(GRID, frozen(index, np.int64), frozen(rng.normal(size=centres) * 0.06)),
    )


def random_part(rng: np.random.Generator, centre: FloatArray, size: float = 30.0) -> RetainedPart:
    """Return a closed lumpy part about a centre (3,)."""
    ball = trimesh.creation.icosphere(subdivisions=2, radius=size)
    vertices = ball.vertices * rng.uniform(0.8, 1.2, (len(ball.vertices), 1)) * rng.uniform(0.7, 1.3, 3) + centre
    return RetainedPart(frozen(vertices), frozen(ball.faces, np.int64))


def random_node(rng: np.random.Generator, depth: int, centre: FloatArray, bands: bool, parts: bool) -> Node:
    """Return a node with 2^depth leaves about a centre (3,)."""
    size = 40.0 / 2.0 ** (depth / 3.0)
    if depth == 0:
        if parts and rng.random() < 0.5:
            return random_part(rng, centre, 0.75 * size)
        return random_leaf(rng, centre, size)
    normal = rng.normal(size=3)
    normal /= np.sqrt(normal @ normal)
    step = 0.45 * size * normal
    contours: tuple[Contour, ...] = ()
    width = 0.0
    if bands and rng.random() < 0.7:
        width = float(rng.uniform(0.3, 2.0))
        centre_2d = plane_frame(normal)[:2] @ centre + rng.normal(size=2)
        contours = (
            Contour(
                frozen(centre_2d),
                frozen(size * rng.uniform(0.6, 0.9, 4)),
                frozen(rng.normal(size=int(rng.choice([0, 1, 4])))),
                frozen(rng.normal(size=7) * 0.04),
            ),
        )
    return Cut(
        normal_angles_of(normal),
        float(normal @ centre + rng.normal() * 2.0),
        width,
        contours,
        random_node(rng, depth - 1, centre - step, bands, parts),
        random_node(rng, depth - 1, centre + step, bands, parts),
    )


def random_tree(seed: int, depth: int = 2, bands: bool = False, parts: bool = False) -> Tree:
    """Return a whole tree with 2^depth leaves in a random pose; equal seeds give equal trees."""
    rng = np.random.default_rng(seed)
    pose = np.concatenate([rng.normal(size=3) * 0.5, rng.normal(size=3) * 30.0])
    return Tree(random_node(rng, depth, np.zeros(3), bands, parts), frozen(pose))
