"""From a point on a seam along it: surface points nearer and nearer, down to the nearest one of the seam."""

from __future__ import annotations

import numpy as np
import pytest

from hhsr.compiled import compile_tree
from hhsr.kernels.descent import descend_from
from hhsr.kernels.layout import integers, tables
from hhsr.kernels.patch import BEST, FAR, FOOT, LENGTH2, SEARCH_SIZE, START, TOLERANCE
from hhsr.kernels.seam import slide_from
from hhsr.kernels.tree import into_tree
from hhsr.model import Cut, FloatArray, ModelLeaf, ScaleField, Superquadric, Tree, frozen

SPHERE = 30.0  # mm, both leaves' radius; their centres lie 20 mm apart on either side of x = 0


def two_balls() -> FloatArray:
    """Return the blob of two balls that a plane parts: the seam is a circle of radius √800 about the x axis."""
    ball = Superquadric(frozen(np.full(6, SPHERE)))
    left, right = (ModelLeaf(frozen([x, 0.0, 0.0]), frozen([]), ball, ScaleField.none()) for x in (-10.0, 10.0))
    return compile_tree(Tree(Cut(frozen([0.0, 0.0]), 0.0, 0.0, (), left, right), frozen(np.zeros(6)))).blob


@pytest.mark.parametrize("seed", range(5))
def test_a_slide_ends_at_the_seams_nearest_point(seed: int) -> None:
    blob, rng = two_balls(), np.random.default_rng(seed)
    ints = integers(blob)
    ring = np.sqrt(SPHERE**2 - 100.0)
    for _ in range(20):
        angle = rng.uniform(-np.pi, np.pi)
        start = np.array([0.0, ring * np.cos(angle), ring * np.sin(angle)])
        turn = angle + rng.uniform(-0.5, 0.5)
        away = rng.uniform(0.7, 1.4) * ring
        point = np.array([rng.uniform(-5, 5), away * np.cos(turn), away * np.sin(turn)])
        search = np.zeros(SEARCH_SIZE)
        search[START : START + 3] = into_tree(blob, ints, *point)
        search[BEST], search[TOLERANCE], search[LENGTH2] = np.linalg.norm(point - start), 0.01, 0.0
        begin = search[BEST]
        assert slide_from(blob, ints, *into_tree(blob, ints, *start), search)
        nearest = np.hypot(point[0], away - ring)
        assert nearest - 1e-3 <= search[BEST] <= begin
        assert search[BEST] <= nearest + 0.01
        if search[BEST] < begin:
            foot = search[FOOT : FOOT + 3]
            assert np.linalg.norm(foot - search[START : START + 3]) == pytest.approx(search[BEST], abs=1e-9)
            assert abs(foot[0]) < 1e-3
            assert np.hypot(foot[1], foot[2]) == pytest.approx(ring, abs=1e-3)


def test_off_a_seam_nothing_slides() -> None:
    blob = two_balls()
    search = np.zeros(SEARCH_SIZE)
    search[START : START + 3], search[BEST], search[TOLERANCE] = [45.0, 3.0, 0.0], 6.0, 0.01
    assert not slide_from(blob, integers(blob), 40.0, 0.0, 0.0, search)
    assert search[BEST] == 6.0


@pytest.mark.parametrize("seed", range(5))
def test_a_way_down_to_and_fro_between_two_leaves_ends_on_their_seam(seed: int) -> None:
    blob, rng = two_balls(), np.random.default_rng(seed)
    ints, tab = integers(blob), tables(blob)
    ring = np.sqrt(SPHERE**2 - 100.0)
    for _ in range(20):
        # From a point near the axis both balls are nearest beyond the cut; the seam is a valley.
        turn, height = rng.uniform(-np.pi, np.pi), rng.uniform(5.0, 0.8 * ring)
        reach = 0.9 * 10.0 * (1.0 - height / ring)
        point = np.array([rng.uniform(-reach, reach), height * np.cos(turn), height * np.sin(turn)])
        angle, side = turn + rng.uniform(-0.5, 0.5), rng.choice([-1.0, 1.0])
        away = rng.uniform(-0.3, 0.0)
        start = np.array([side * (10.0 + SPHERE * away), 0.0, 0.0])
        start[1:] = SPHERE * np.sqrt(1.0 - away**2) * np.array([np.cos(angle), np.sin(angle)])
        search = np.zeros(SEARCH_SIZE)
        search[START : START + 3] = into_tree(blob, ints, *point)
        search[BEST], search[TOLERANCE], search[LENGTH2] = FAR, 0.01, 0.0
        # Where it was gone along before, the way ends there and finds no point of the seam.
        assert not descend_from(blob, ints, tab, *into_tree(blob, ints, *start), np.bool_(False), search)
        assert search[BEST] == FAR or np.hypot(search[FOOT + 1], search[FOOT + 2]) != pytest.approx(ring, abs=1e-3)
        search[BEST] = FAR
        descend_from(blob, ints, tab, *into_tree(blob, ints, *start), np.bool_(True), search)
        nearest = np.hypot(point[0], height - ring)
        assert nearest - 1e-9 <= search[BEST] <= nearest + 0.001
        assert np.hypot(search[FOOT + 1], search[FOOT + 2]) == pytest.approx(ring, abs=1e-3)
