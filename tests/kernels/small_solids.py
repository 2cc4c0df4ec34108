"""Trees small enough to be compiled and asked without the compiler, shared by the tests of this folder."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import cache
from types import SimpleNamespace

import numba
import numpy as np
import pytest

from hhsr.compiled import leaf_maps, proofs, records
from hhsr.kernels import norm_bounds
from hhsr.model import (
    CentreGrid,
    Contour,
    Cut,
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
from hhsr.shape import Shape

X, Y, Z = np.eye(3)
POSE = np.array([0.3, -0.2, 0.5, 7.0, -3.0, 2.0])
GRID = CentreGrid((30, 120), 2.0)
FINE = CentreGrid((2000,), 2.0)
CUBE = np.array([[x, y, z] for x in (-5.0, 5.0) for y in (-5.0, 5.0) for z in (-5.0, 5.0)])
QUADS = ((0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3))
CUBE_FACES = np.array([f for a, b, c, d in QUADS for f in ((a, b, c), (a, c, d))])


def ball(radius: float, centre: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> ModelLeaf:
    """Return a leaf that is a ball."""
    return ModelLeaf(frozen(centre), frozen([]), Superquadric(frozen(np.full(6, radius))), ScaleField.none())


def lumpy(seed: int, centre: tuple[float, float, float] = (0.0, 0.0, 0.0), knots: bool = True) -> ModelLeaf:
    """Return a rotated leaf with unequal half axes and a dozen centres, with knots or without."""
    rng = np.random.default_rng(seed)
    index = np.sort(rng.choice(GRID.size, 12, replace=False))
    return ModelLeaf(
        frozen(centre),
        frozen([0.4, -0.3, 0.2] if knots else []),
        Superquadric(
            frozen([10.0, 8.0, 7.0, 9.0, 8.5, 6.5]),
            frozen([0.8, -0.6, 0.5, 0.1] if knots else []),
            frozen([0.5, -0.7, 0.4] if knots else []),
        ),
        ScaleField(GRID, frozen(index, np.int64), frozen(rng.normal(size=12) * 0.15)),
    )


def pitted() -> ModelLeaf:
    """Return a leaf with a pit so deep that its scale field is capped, and knots that make an edge."""
    base = Superquadric(frozen([10.0] * 6), frozen([-2.5]), frozen([-2.5]))
    return ModelLeaf(
        frozen([0.0, 0.0, 0.0]), frozen([]), base, ScaleField(FINE, frozen([430], np.int64), frozen([2.0]))
    )


def cube(grown: float = 1.0) -> RetainedPart:
    """Return the cube |x|, |y|, |z| ≤ 5 times a factor as a retained part."""
    return RetainedPart(frozen(CUBE * grown), frozen(CUBE_FACES, np.int64))


def nothing() -> RetainedPart:
    """Return the empty part."""
    return RetainedPart(frozen(np.zeros((0, 3))), frozen(np.zeros((0, 3)), np.int64))


def step(normal: np.ndarray, offset: float, left: Node, right: Node) -> Cut:
    """Return a cut without a band."""
    return Cut(normal_angles_of(normal), offset, 0.0, (), left, right)


def band(normal: np.ndarray, offset: float, half: float, lobes: tuple[Contour, ...], left: Node, right: Node) -> Cut:
    """Return a cut with a band."""
    return Cut(normal_angles_of(normal), offset, half, lobes, left, right)


def lobe(normal: np.ndarray, centre: np.ndarray, radius: float, wavy: bool) -> Contour:
    """Return a round or a wavy contour about a point (3,) of a plane."""
    return Contour(
        frozen(plane_frame(normal)[:2] @ centre),
        frozen(radius * np.array([1.0, 0.9, 1.1, 0.95]) if wavy else np.full(4, radius)),
        frozen([0.3, -0.4, 0.2, 0.1] if wavy else []),
        frozen([0.05, -0.1, 0.02, 0.0, 0.08] if wavy else []),
    )


def _neck() -> Node:
    normal = np.array([0.6, 0.0, 0.8])
    left, right = ball(9.0, (-3.0, 0.0, -4.0)), ball(7.0, (3.0, 0.0, 4.0))
    return band(normal, 0.0, 1.0, (lobe(normal, np.array([0.3, 0.2, 0.0]), 6.0, True),), left, right)


def _two_lobes() -> Node:
    legs = [CUBE * [0.6, 0.6, 1.0] + x * X for x in (-4.0, 4.0)]
    part = RetainedPart(frozen(np.concatenate(legs)), frozen(np.concatenate([CUBE_FACES, CUBE_FACES + 8]), np.int64))
    return band(Z, 0.0, 2.0, (lobe(Z, -4.0 * X, 2.5, False), lobe(Z, 4.0 * X, 2.0, False)), part, part)


def _nested() -> Node:
    contour = lobe(Y, np.array([0.0, 1.0, -2.0]), 5.0, True)
    lower = band(Y, 1.0, 0.5, (contour,), ball(8.0), lumpy(3, knots=False))
    return step(np.array([0.1, 0.2, 1.0]) / math.sqrt(1.05), 0.5, lower, step(X, -1.0, cube(1.4), ball(6.0)))


TREES: dict[str, Callable[[], Tree]] = {
    "ball": lambda: Tree(ball(10.0), frozen(POSE)),
    "lumpy": lambda: Tree(lumpy(1), frozen(POSE)),
    "smooth": lambda: Tree(lumpy(3, knots=False), frozen(np.zeros(6))),
    "pitted": lambda: Tree(pitted(), frozen(np.zeros(6))),
    "halves": lambda: Tree(step(X, 0.0, ball(10.0), ball(6.0)), frozen(np.zeros(6))),
    "corner": lambda: Tree(step(X, 0.0, nothing(), step(Y, 0.0, nothing(), cube())), frozen(np.zeros(6))),
    "neck": lambda: Tree(_neck(), frozen(POSE)),
    "lobes": lambda: Tree(_two_lobes(), frozen(np.zeros(6))),
    "nested": lambda: Tree(_nested(), frozen(POSE)),
    "empty": lambda: Tree(nothing(), frozen(np.zeros(6))),
}


def exp_of_c(x: float) -> float:
    """Return e^x as compiled code does: infinite where Python's own raises."""
    return math.exp(x) if x < 709.0 else math.inf


@pytest.fixture(autouse=True)
def arithmetic_of_c(monkeypatch: pytest.MonkeyPatch) -> None:
    """Without the compiler, let the bounds of the norm overflow to infinity, as compiled code does."""
    if numba.config.DISABLE_JIT:
        monkeypatch.setattr(norm_bounds, "math", SimpleNamespace(**{**vars(math), "exp": exp_of_c}))


@cache
def solid(name: str) -> Shape:
    """Return a shape, compiled once with coarse maps and voxels, so that it takes a moment without the compiler.

    What is proven holds for maps of any size; coarse ones leave more to the searches.
    """
    return coarse(TREES[name]())


def coarse(tree: Tree) -> Shape:
    """Return a tree's shape, compiled with coarse maps and voxels."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(records, "BASE_SIDE", 16)
        patch.setattr(leaf_maps, "CELLS_TOTAL", 3000)
        patch.setattr(proofs, "VOXELS_TOTAL", 600)
        shape = Shape(tree)
        assert shape.compiled.nbytes > 0
    return shape
