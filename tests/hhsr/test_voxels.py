"""The grid of voxels: what each plane claims of its voxel, answers on its borders, and the walk against the tree."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hhsr.kernels import layout as at
from hhsr.kernels import voxels as grid_at
from hhsr.kernels.stretch import excess, excess_along
from hhsr.kernels.surfel import BEND, DETAIL_SIZE, EXTRA, FINE, OFFSET, PLANE_SIZE, SURFEL_OWNER, THICK, TURN
from hhsr.kernels.tree import into_leaf, turn_into_leaf
from hhsr.model import FloatArray, rotation_matrix
from hhsr.segments import cross_segments
from hhsr.shape import Shape
from tests.hhsr.test_crossings import hard_segments
from tests.strategies import random_tree

KINDS = [(0, False, False), (2, False, False), (2, True, False), (2, False, True), (4, False, False)]


class Grid:
    """The grid of a shape, read back from its blob."""

    def __init__(self, shape: Shape) -> None:
        self.blob = shape.compiled.blob
        self.ints, self.words = self.blob.view(np.int64), self.blob.view(np.int32)
        start, frame = int(self.ints[at.VOXELS]), int(self.ints[at.VOXEL_FRAME])
        self.record = self.ints[start : start + grid_at.VOXEL_INTS]
        self.low, self.side = self.blob[frame : frame + 3], float(self.blob[frame + 3])
        self.bricks = self.record[:3]
        count = int(self.bricks.prod())
        table = self.words[int(self.record[grid_at.BRICKS]) :][: count * grid_at.BRICK_SIZE]
        self.table = table.reshape(*self.bricks, grid_at.BRICK_SIZE)
        self.slots = self.table[..., grid_at.BRICK_VOXELS] // 64  # −1: proven
        self.shorts = self.blob.view(np.int16)
        self.voxels = self.shorts[int(self.record[grid_at.VOXELS_AT]) :][: 64 * (self.slots.max() + 1)]
        self.tables = self.blob[int(self.ints[at.MAP_START]) :].view(np.float32)

    def surfels(self) -> list[tuple[FloatArray, FloatArray, FloatArray, FloatArray]]:
        """Return (centre of the voxel, plane, details, part) of every surfel of a leaf, those beside a cut too.

        part: (n, c), n·p ≤ c of the voxel's part that counts, in the tree's frame; 0 where it is all.
        """
        found = []
        for brick in np.argwhere(self.slots >= 0):
            slot = int(self.slots[tuple(brick)])
            for place, voxel in enumerate(self.voxels[64 * slot : 64 * slot + 64]):
                if not 0 <= voxel < grid_at.NO_SURFEL:
                    continue
                number = int(self.table[(*brick, grid_at.BRICK_SURFEL)]) + int(voxel)
                centre = self.low + self.side * (4 * brick + [place >> 4, (place >> 2) & 3, place & 3] + 0.5)
                _, details = self.parts(number)
                if details[SURFEL_OWNER] >= 0:
                    found.append((centre, *self.parts(number), np.zeros(4)))
                    continue
                node = int(self.ints[at.NODE_FLOATS]) + at.NODE_FLOAT_SIZE * (-1 - int(details[SURFEL_OWNER]))
                cut = self.blob[node : node + 4]
                found.append((centre, *self.parts(int(details[EXTRA])), cut))
                found.append((centre, *self.parts(int(details[EXTRA]) + 1), -cut))
        return found

    def parts(self, number: int) -> tuple[FloatArray, FloatArray]:
        """Return the plane (4,) and the details (4,) of a surfel."""
        plane = int(self.record[grid_at.PLANES]) + PLANE_SIZE * number
        details = int(self.record[grid_at.DETAILS]) + DETAIL_SIZE * number
        return self.shorts[plane : plane + PLANE_SIZE] / FINE, self.tables[details : details + DETAIL_SIZE]

    def leaf(self, owner: int) -> int:
        """Return the record of a model leaf."""
        return int(self.ints[int(self.ints[at.OWNER_INTS]) + at.OWNER_INT_SIZE * owner + at.OWNER_RECORD])


@pytest.mark.parametrize(("depth", "seed"), [(0, 0), (0, 1), (2, 2), (2, 5)])
def test_a_plane_holds_all_over_its_voxel(depth: int, seed: int) -> None:
    grid = Grid(Shape(random_tree(seed, depth)))
    rng = np.random.default_rng(seed)
    surfels = grid.surfels()
    assert len(surfels) > 1000
    bent = sides = 0
    for k in rng.choice(len(surfels), 400, replace=False):
        centre, plane, details, part = surfels[k]
        leaf = grid.leaf(int(details[SURFEL_OWNER]))
        u = rng.uniform(-0.5, 0.5, (12, 3))
        u[:8] = 0.5 * (np.array(np.unravel_index(np.arange(8), (2, 2, 2))).T * 2 - 1)  # the corners too
        for v in u:
            p = into_leaf(grid.blob, grid.ints, leaf, *(centre + grid.side * v))
            true = excess(grid.blob, grid.ints, leaf, *p)
            model = float(plane[:3].astype(float) @ v + plane[OFFSET])
            if not plane[:3].any():  # a side of a cut, proven whole: the part of the voxel on that side
                if part[:3] @ (centre + grid.side * v) <= part[3]:
                    assert (true > 0) == (model > 0)
                    sides += 1
                continue
            thick = float(details[THICK])
            assert abs(true - thick * model) <= thick
            if not np.isfinite(details[BEND]):
                continue
            # Slope and bend along a random way, the exact slope by the formula, the bend from slopes a step apart.
            bent += 1
            way = rng.normal(size=3)
            way /= np.sqrt(way @ way)
            d = turn_into_leaf(grid.blob, int(grid.ints[leaf + at.FRAME]), *(grid.side * way))
            inner = 0.98 * v
            slopes = []
            for step in (-5e-3, 5e-3):
                p = into_leaf(grid.blob, grid.ints, leaf, *(centre + grid.side * (inner + step * way)))
                slopes.append(excess_along(grid.blob, grid.ints, leaf, *p, *d)[1])
            assert abs(slopes[0] - thick * float(plane[:3].astype(float) @ way)) <= details[TURN]
            assert abs(slopes[1] - slopes[0]) <= details[BEND] * 1e-2 + 1e-9
    assert sides > 0 or depth == 0
    assert bent > 0 or depth == 0  # a single leaf may have exponents, which bound no bend


@pytest.mark.parametrize(("depth", "seed"), [(0, 0), (2, 2)])
def test_nothing_changes_in_the_cube_of_a_leap(depth: int, seed: int) -> None:
    grid = Grid(Shape(random_tree(seed, depth)))
    mixed = np.argwhere(grid.slots >= 0)
    voxels = grid.voxels.astype(int).reshape(-1, 4, 4, 4)
    states = np.where(voxels >= 0, 0, np.where(voxels & grid_at.IN_BIT, 1, -1))
    leaps = grid.table.view(np.int8)[..., :8]
    whole = np.where(leaps[..., 0] > 0, 1, -1).repeat(4, 0).repeat(4, 1).repeat(4, 2)
    for brick in mixed:
        i, j, k = 4 * brick
        whole[i : i + 4, j : j + 4, k : k + 4] = states[grid.slots[tuple(brick)]]
    longest = 0
    for octant in range(8):
        bits = grid_at.SHORT_BITS + grid_at.STEP_BITS * (voxels >> octant & 1)
        steps = voxels >> bits & grid_at.FARTHEST_STEP
        ways = [1 if octant >> axis & 1 else -1 for axis in range(3)]
        for brick in mixed[:: max(1, len(mixed) // 60)]:
            for place in np.ndindex(4, 4, 4):
                state = states[(grid.slots[tuple(brick)], *place)]
                if state == 0:
                    continue
                leap = 1 + steps[(grid.slots[tuple(brick)], *place)]
                at_voxel = 4 * brick + place
                cube = whole[
                    tuple(
                        slice(max(i - leap + 1, 0), i + 1) if way < 0 else slice(i, i + leap)
                        for i, way in zip(at_voxel, ways, strict=True)
                    )
                ]
                assert (cube == state).all()
                assert state < 0 or cube.size == leap**3  # beyond the grid all is outside
                longest = max(longest, leap)
    assert longest > 3


def border_points(shape: Shape, rng: np.random.Generator, count: int) -> np.ndarray:
    """Return LPS points on the borders, edges and corners of voxels near the surface, to the last bit of the grid."""
    grid = Grid(shape)
    near = np.argwhere(grid.slots >= 0)
    cell = 4 * near[rng.integers(len(near), size=count)] + rng.integers(0, 5, (count, 3))
    inner = rng.uniform(0, 1, (count, 3)) * (rng.random((count, 3)) < 0.5)
    local = grid.low + grid.side * (cell + inner)
    return local @ rotation_matrix(shape.tree.pose[:3]).T + shape.tree.pose[3:]


@pytest.mark.parametrize(("depth", "bands", "parts"), KINDS)
def test_points_on_borders_of_voxels(depth: int, bands: bool, parts: bool) -> None:
    shape = Shape(random_tree(3 + depth, depth, bands, parts))
    points = border_points(shape, np.random.default_rng(depth), 2000 if parts else 20_000)
    assert np.array_equal(shape.contains(points), shape.field(points) <= 0)


@pytest.mark.parametrize("seed", [2, 3, 5])
def test_one_plane_decides_for_both_sides_of_a_cut(seed: int) -> None:
    """Of voxels that a cut passes and of whole bricks: wherever it decides, close to the cut too."""
    shape = Shape(random_tree(seed, 2))
    grid, rng = Grid(shape), np.random.default_rng(seed)
    rotation, shift = rotation_matrix(shape.tree.pose[:3]), shape.tree.pose[3:]
    decided = 0
    for brick in np.argwhere(grid.slots >= 0):
        numbers = grid.voxels[64 * grid.slots[tuple(brick)] :][:64]
        planes = [(grid.low + grid.side * 4 * (brick + 0.5), 2.0, 2 * _first_word(grid, brick), None)]
        for place in np.flatnonzero((numbers >= 0) & (numbers < grid_at.NO_SURFEL)):
            number = int(grid.table[(*brick, grid_at.BRICK_SURFEL)]) + int(numbers[place])
            owner = int(grid.parts(number)[1][SURFEL_OWNER])
            if owner < 0:
                middle = grid.low + grid.side * (4 * brick + [place >> 4, (place >> 2) & 3, place & 3] + 0.5)
                planes.append((middle, 0.5, int(grid.record[grid_at.PLANES]) + PLANE_SIZE * number, owner))
        for middle, half, start, owner in planes:
            u = rng.uniform(-half, half, (20, 3))
            if owner is not None:  # half of them on the cut
                node = int(grid.ints[at.NODE_FLOATS]) + at.NODE_FLOAT_SIZE * (-1 - owner)
                n, c = grid.blob[node : node + 3], grid.blob[node + 3]
                u[:10] -= np.outer((u[:10] @ n) + (n @ middle - c) / grid.side, n)
            level = (grid.shorts[start : start + 3] @ u.T + grid.shorts[start + 3]) / FINE
            sure = (np.abs(level) > 1.0) & (np.abs(u) <= half).all(axis=1)
            points = (middle + grid.side * u[sure]) @ rotation.T + shift
            assert np.array_equal(shape.field(points) <= 0, level[sure] < 0)
            decided += int(sure.sum()) if owner is not None else 0
    assert decided > 200


def _first_word(grid: Grid, brick: np.ndarray) -> int:
    return int(grid.record[grid_at.BRICKS]) + grid_at.BRICK_SIZE * int(np.ravel_multi_index(tuple(brick), grid.bricks))


def without_grid(blob: np.ndarray) -> np.ndarray:
    """Return the blob as it was before it had a grid, read-only."""
    copy = blob.copy()
    copy.view(np.int64)[at.VOXELS] = 0
    copy.setflags(write=False)
    return copy


def follow(
    blob: np.ndarray, starts: np.ndarray, ends: np.ndarray, first: bool = False
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return (counts, whether segments begin inside, t)."""
    counts, places, begins = (np.empty(len(starts), dtype=kind) for kind in (np.int64, np.int64, np.bool_))
    t = cross_segments(blob, starts, ends, np.arange(len(starts)), first, 0.01, 0.001, counts, begins, places)
    assert len(t) == np.maximum(counts, 0).sum()
    found = [t[place : place + count] for place, count in zip(places, counts, strict=True) if count > 0]
    return counts, begins, np.concatenate([*found, np.empty(0)])


def compare(shape: Shape, starts: np.ndarray, ends: np.ndarray, in_planes: int = 0) -> None:
    """Assert that the walk of the voxels and the clipping of the tree find the same crossings.

    in_planes: how many segments may lie within cutting planes, where rounding chooses the side.
    """
    counts, begins, t = follow(shape.compiled.blob, starts, ends)
    twin_counts, twin_begins, twin_t = follow(without_grid(shape.compiled.blob), starts, ends)
    assert np.array_equal(begins, twin_begins)
    assert ((counts - twin_counts) % 2 == 0).all()
    length = np.sqrt(((ends - starts) ** 2).sum(axis=1))
    offset, twin_offset = np.cumsum(counts) - counts, np.cumsum(twin_counts) - twin_counts
    different = 0
    for i in range(len(starts)):
        own = t[offset[i] : offset[i] + counts[i]]
        twin = twin_t[twin_offset[i] : twin_offset[i] + twin_counts[i]]
        if counts[i] == twin_counts[i]:
            different += bool((np.abs(own - twin) * length[i] > 0.0021 + 1e-9 * length[i]).any())
        else:  # only pairs closer than the resolution may be there or not
            both = np.sort(np.concatenate([own, twin]))
            different += bool(np.diff(both).min() * length[i] > 0.0101)
    assert different <= in_planes
    has = counts > 0
    first_counts, _, first = follow(shape.compiled.blob, starts, ends, True)
    assert np.array_equal(first_counts, has.astype(np.int64))
    assert np.array_equal(first, t[offset[has]])


@pytest.mark.parametrize(("depth", "bands", "parts"), KINDS)
def test_the_walk_finds_what_the_tree_finds(depth: int, bands: bool, parts: bool) -> None:
    shape = Shape(random_tree(11 + depth, depth, bands, parts))
    starts, ends = hard_segments(shape, np.random.default_rng(depth), 400)
    compare(shape, starts, ends, in_planes=16 * (2**depth - 1))


@settings(max_examples=25)
@given(st.integers(0, 3), st.integers(0, 2**32 - 1), st.sampled_from([1e-3, 0.3, 5.0, 1e3]))
def test_the_walk_finds_what_the_tree_finds_near_the_surface(depth: int, drawn: int, length: float) -> None:
    shape = shape_of(depth)
    rng = np.random.default_rng(drawn)
    low, high = shape.bounds
    points = rng.uniform(low, high, (200, 3))
    cell = np.flatnonzero(np.abs(shape.signed_distance(points)) < 3.0)
    through = points[cell[:40]] if cell.size else points[:40]
    way = rng.normal(size=through.shape)
    way /= np.sqrt((way**2).sum(axis=1))[:, None]
    share = rng.uniform(0, 1, (len(through), 1))
    compare(shape, through - share * length * way, through + (1 - share) * length * way)


@cache
def shape_of(depth: int) -> Shape:
    """Return a shape of 2^depth leaves, compiled once."""
    return Shape(random_tree(21 + depth, depth))


@pytest.mark.parametrize("depth", [0, 2])
def test_segments_along_borders_and_through_corners_of_voxels(depth: int) -> None:
    shape = Shape(random_tree(31 + depth, depth))
    grid = Grid(shape)
    rng = np.random.default_rng(depth)
    cells = np.argwhere(grid.slots >= 0)[rng.integers(int((grid.slots >= 0).sum()), size=300)] * 4
    ways = np.array(
        [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [1, 0, -1], [1, 1, 1], [1, -1, 1], [2, 1, 0], [0, -1, 2]]
    )
    way = ways[rng.integers(len(ways), size=len(cells))].astype(float) * rng.choice([-1.0, 1.0], (len(cells), 1))
    starts, ends = grid.low + grid.side * (cells - 512 * way), grid.low + grid.side * (cells + 512 * way)
    rotation, shift = rotation_matrix(shape.tree.pose[:3]), shape.tree.pose[3:]
    compare(shape, starts @ rotation.T + shift, ends @ rotation.T + shift)


def test_a_single_call_is_the_batch() -> None:
    shape = shape_of(3)
    starts, ends = hard_segments(shape, np.random.default_rng(8), 100)
    batch, first = shape.crossings(starts, ends), shape.first_crossing(starts, ends)
    for i in range(len(starts)):
        one = shape.crossings(starts[i], ends[i])
        rows = slice(batch.offsets[i], batch.offsets[i + 1])
        assert np.array_equal(one.t, batch.t[rows])
        assert np.array_equal(one.points, batch.points[rows])
        assert np.array_equal(one.entering, batch.entering[rows])
        assert one.offsets.tolist() == [0, len(one.t)]
        assert one.valid.tolist() == [True]
        alone = shape.first_crossing(starts[i], ends[i])
        assert alone == first[i] or (np.isnan(alone) and np.isnan(first[i]))


def test_a_solid_far_smaller_than_a_millimetre_has_a_grid_too() -> None:
    tree = random_tree(21, 0)
    leaf = tree.root
    small = type(leaf)(  # type: ignore[call-arg]
        leaf.centre,
        leaf.rotation,
        type(leaf.superquadric)(
            leaf.superquadric.half_axes * 1e-3, leaf.superquadric.azimuth_logits, leaf.superquadric.elevation_logits
        ),
        leaf.scale_field,  # type: ignore[union-attr]
    )
    shape = Shape(type(tree)(small, tree.pose))
    rng = np.random.default_rng(0)
    points = rng.uniform(*shape.bounds, (5000, 3))
    assert np.array_equal(shape.contains(points), shape.field(points) <= 0)
    starts, ends = rng.uniform(*shape.bounds, (2, 200, 3))
    compare(shape, starts, ends)
