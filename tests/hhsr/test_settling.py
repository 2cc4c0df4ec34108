"""What a distance is settled by: second derivatives and how far they change, discs, quadratics, seeds, orders."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from scipy.spatial import cKDTree

from hhsr.compiled import compile_tree
from hhsr.kernels import layout as at
from hhsr.kernels.cell import direction_of, inverse_radius
from hhsr.kernels.clipped_quadratic import clipped_is_clear, least_over_polygon
from hhsr.kernels.descent import descend_from
from hhsr.kernels.disc_bounds import BLOCK, LOOSE, WIDE, bound_to_point, bound_to_segment
from hhsr.kernels.facets import facet_cell
from hhsr.kernels.foot import jump_over, leaf_is_free
from hhsr.kernels.jet import inverse_radius_bend
from hhsr.kernels.layout import integers, tables
from hhsr.kernels.maps import jet_near, jet_of, rests_over
from hhsr.kernels.patch import BEST, FAR, LENGTH2, SEARCH_SIZE, START, TOLERANCE, VECTOR
from hhsr.kernels.polygon import ROOM, clip_in_chart
from hhsr.kernels.quadratic import least_over_square, square_is_clear
from hhsr.kernels.tree import turn_out_of_leaf
from hhsr.model import CentreGrid, FloatArray, ModelLeaf, ScaleField, Superquadric, Tree, frozen
from hhsr.shape import Shape
from tests.strategies import random_tree


def leaf(seed: int, supports: int, weight: float, knots: tuple[int, int] = (0, 0)) -> ModelLeaf:
    """Return a leaf with a hundred centres, of one support as fine as a grid of `supports`; exponents with knots."""
    rng = np.random.default_rng(seed)
    grid = CentreGrid((30, supports), 2.5)
    index = np.sort(rng.choice(grid.size, min(100, grid.size // 2), replace=False))
    field = ScaleField(grid, frozen(index, np.int64), frozen(rng.normal(size=len(index)) * weight))
    base = Superquadric(frozen(rng.uniform(40, 90, 6)), *(frozen(rng.normal(size=n)) for n in knots))
    return ModelLeaf(frozen([3.0, -2.0, 5.0]), frozen([]), base, field)


LEAVES = [
    leaf(0, 190, 0.05), leaf(1, 1200, 0.2), leaf(2, 8000, 0.4), leaf(3, 190, 0.05, (4, 3)), leaf(4, 1200, 0.1, (1, 5)),
    leaf(5, 190, 0.05, (6, 0)),
]  # fmt: skip


def facets(one: ModelLeaf, count: int, rng: np.random.Generator) -> Iterator[tuple[FloatArray, int, tuple[int, ...]]]:
    """Yield (blob, record, (slot, face, a, b, half)) of facets drawn from a leaf's."""
    blob = compile_tree(Tree(one, frozen(np.zeros(6)))).blob
    ints = integers(blob)
    start, record = ints[at.FACET_CODES], ints[ints[at.OWNER_INTS] + at.OWNER_RECORD]
    for q in rng.integers(ints[at.FACET_COUNT], size=count):
        yield blob, record, facet_cell(ints, record, ints[start + q])


def surface(blob: FloatArray, record: int, face: int, a: FloatArray, b: FloatArray) -> FloatArray:
    """Return (n, 3) the surface points in directions (a, b), leaf's frame."""
    ints = integers(blob)
    return np.array(
        [
            np.array(direction_of(face, x, y)) / inverse_radius(blob, ints, record, face, x, y)
            for x, y in zip(a, b, strict=True)
        ]
    )


@pytest.mark.parametrize("one", LEAVES)
def test_second_derivatives_are_exact_and_change_no_more_than_proven(one: ModelLeaf) -> None:
    rng = np.random.default_rng(3)
    seen = 0
    for blob, record, (slot, face, a, b, half) in facets(one, 60, rng):
        ints, tab = integers(blob), tables(blob)
        w, wa, wb, waa, wab, wbb = inverse_radius_bend(blob, ints, record, face, a, b)
        if w == 0.0:
            continue
        step = 1e-5
        for da, db in ((step, 0.0), (0.0, step), (step, step)):
            ahead = inverse_radius(blob, ints, record, face, a + da, b + db)
            behind = inverse_radius(blob, ints, record, face, a - da, b - db)
            middle = inverse_radius(blob, ints, record, face, a, b)
            assert middle == pytest.approx(w, rel=1e-12)
            slope = (ahead - behind) / 2
            assert slope == pytest.approx(wa * da + wb * db, abs=1e-3 * step * (abs(wa) + abs(wb) + w))
            bend = ahead - 2 * middle + behind
            assert bend == pytest.approx(
                waa * da * da + 2 * wab * da * db + wbb * db * db, abs=2e-2 * step**2 * (abs(waa) + abs(wbb) + 5 * w)
            )
        kink, third = float(tab[slot + at.KINK]), float(tab[slot + at.THIRD])
        if not np.isfinite(third):
            continue
        # Not on the cell's border: the half axes, and with them ∂²W, may change there.
        last = None
        for u, v in np.concatenate([rng.uniform(-1, 1, (20, 2)), [[1, 1], [-1, 1], [1, 0], [0, -1]]]) * (0.9999 * half):
            other = np.array(inverse_radius_bend(blob, ints, record, face, a + u, b + v))
            if other[0] == 0.0:
                continue
            change = np.linalg.norm([[other[3] - waa, other[4] - wab], [other[4] - wab, other[5] - wbb]], 2)
            assert change <= kink + third * np.hypot(u, v) + 1e-9 * w
            if last is not None:  # between any two points it may change twice as fast
                rest = other - last[0]
                change = np.linalg.norm([[rest[3], rest[4]], [rest[4], rest[5]]], 2)
                assert change <= 2.0 * (kink + third * np.hypot(*(np.array([u, v]) - last[1]))) + 1e-9 * w
            last = other, np.array([u, v])
            seen += 1
    assert seen > 200


@pytest.mark.parametrize("one", LEAVES)
def test_a_square_is_called_clear_only_where_it_is(one: ModelLeaf) -> None:
    rng = np.random.default_rng(4)
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 9)] * 2), -1).reshape(-1, 2)
    called = 0
    for blob, record, (slot, face, a, b, half) in facets(one, 120, rng):
        ints, tab = integers(blob), tables(blob)
        jet = inverse_radius_bend(blob, ints, record, face, a, b)
        kink, third = float(tab[slot + at.KINK]), float(tab[slot + at.THIRD])
        if jet[0] == 0.0 or not np.isfinite(third):
            continue
        points = surface(blob, record, face, a + half * grid[:, 0], b + half * grid[:, 1])
        middle = points[len(points) // 2]
        search = np.zeros(SEARCH_SIZE)
        away = rng.normal(size=3)
        away *= rng.choice([0.05, 1.0, 20.0, 300.0]) / np.linalg.norm(away)
        search[START : START + 3] = middle + away
        if rng.uniform() < 0.5:  # a segment, passing or ending near
            vector = rng.normal(size=3) * rng.choice([0.1, 5.0, 80.0])
            search[START : START + 3] -= rng.uniform(-0.2, 1.2) * vector
            search[VECTOR : VECTOR + 3], search[LENGTH2] = vector, vector @ vector
        rest = points - search[START : START + 3]
        t = np.zeros(len(points))
        if search[LENGTH2] > 0:
            t = np.clip(rest @ search[VECTOR : VECTOR + 3] / search[LENGTH2], 0, 1)
        nearest = np.linalg.norm(rest - t[:, None] * search[VECTOR : VECTOR + 3], axis=1).min()
        for share in (0.3, 0.9, 0.999, 1.0, 1.0 + 1e-9, 1.1):
            clear, da, db = square_is_clear(search, share * nearest, face, a, b, half, *jet, kink, third)
            assert max(abs(da), abs(db)) <= half * (1 + 1e-12)
            assert not (clear and share > 1.0)
            called += clear
    assert called > 100  # not by calling nothing clear


@pytest.mark.parametrize("one", LEAVES)
def test_the_table_holds_the_jet_of_a_surface_as_near_as_said(one: ModelLeaf) -> None:
    """To 2e-7·W, what float32 leaves: along a ray that is 1e-6 of the distance and less."""
    seen = 0
    for blob, record, (slot, face, a, b, half) in facets(one, 80, np.random.default_rng(8)):
        ints, tab = integers(blob), tables(blob)
        exact = np.array(inverse_radius_bend(blob, ints, record, face, a, b))
        table = np.array(jet_of(tab, slot, half))
        if np.isnan(table[0]):
            continue
        assert abs(table[0] - exact[0]) <= 2e-7 * exact[0]
        assert np.abs(table[1:3] - exact[1:3]).max() * 2 * half <= 2e-7 * exact[0]
        assert np.abs(table[3:] - exact[3:]).max() <= 1e-7 * np.abs(exact[3:]).sum() + 1e-9 * exact[0]
        da, db = 0.3 * half, -0.8 * half
        near = np.array(jet_near(tab, ints, record, face, a + da, b + db))
        exact = np.array(inverse_radius_bend(blob, ints, record, face, a + da, b + db))
        rest = float(tab[slot + at.KINK]) + half * float(tab[slot + at.THIRD])
        assert abs(near[0] - exact[0]) <= min(0.5 * rest * half**2 + 2e-7 * exact[0], near[6])
        seen += 1
    assert seen > 60


@pytest.mark.parametrize(("one", "known"), list(zip(LEAVES, (10, 5, 0, 5, 5, 5), strict=True)))
def test_a_clipped_square_is_called_clear_only_where_it_is(one: ModelLeaf, known: int) -> None:
    """By cuts through the square, its corners and its neighbourhood, one to three at a time."""
    rng = np.random.default_rng(9)
    grid = np.stack(np.meshgrid(*[np.linspace(-1, 1, 31)] * 2), -1).reshape(-1, 2)
    called = refused = more = sharp = 0
    for blob, record, (slot, face, a, b, half) in facets(one, 60, rng):
        tab = tables(blob)
        kink, third = float(tab[slot + at.KINK]), float(tab[slot + at.THIRD])
        jet = jet_of(tab, slot, half)
        if not np.isfinite(third) or np.isnan(jet[0]):
            continue
        points = surface(blob, record, face, a + half * grid[:, 0], b + half * grid[:, 1])
        middle = points[len(points) // 2]
        planes = []
        for _ in range(rng.integers(1, 4)):
            normal = rng.normal(size=3)
            normal /= np.linalg.norm(normal)
            planes.append([*normal, normal @ (points[rng.integers(len(points))] + rng.normal(size=3) * 0.1)])
        held = points[(points @ np.array(planes)[:, :3].T <= np.array(planes)[:, 3]).all(axis=1)]
        search = np.zeros(SEARCH_SIZE)
        away = rng.normal(size=3)
        search[START : START + 3] = middle + away * rng.choice([0.05, 1.0, 20.0]) / np.linalg.norm(away)
        nearest = np.linalg.norm(held - search[START : START + 3], axis=1).min() if len(held) else np.inf
        whole = np.linalg.norm(points - search[START : START + 3], axis=1).min()
        corners, spare = np.empty((ROOM, 3)), np.empty((ROOM, 3))
        most = nearest - 0.02 * half / jet[0]
        for radius in (
            0.5 * whole, whole, 0.5 * (whole + min(nearest, 2 * whole)), most, nearest * 1.0001, nearest * 1.1
        ):  # fmt: skip
            if not np.isfinite(radius):
                continue
            clear, da, db = clipped_is_clear(
                np.concatenate(planes), 0, len(planes), search, radius, face, a, b, half, *jet, kink, third, 0.0,
                corners, spare,
            )  # fmt: skip
            assert max(abs(da), abs(db)) <= half * (1 + 1e-9)
            assert not (clear and radius > nearest)
            called, refused = called + clear, refused + (not clear)
            more += clear and radius > whole * 1.001
            sharp += clear and radius == most and most > whole
    assert called > 60
    assert refused > 20
    assert more > 10  # the cut's own doing
    assert sharp > known  # by lines alone, of the first three 8, 3 and 0


@pytest.mark.parametrize("one", LEAVES)
def test_a_way_down_seldom_ends_farther_than_it_began(one: ModelLeaf) -> None:
    """Points deep inside, where much of the surface is about as far, from surface points of a face near them."""
    rng = np.random.default_rng(11)
    blob = compile_tree(Tree(one, frozen(np.zeros(6)))).blob
    ints, tab = integers(blob), tables(blob)
    record = ints[ints[at.OWNER_INTS] + at.OWNER_RECORD]
    centre, found, farther = one.centre, 0, 0
    for face in range(6):
        points = surface(blob, record, face, *rng.uniform(-0.9, 0.9, (2, 300)))
        for inside in points[:60] * rng.uniform(0.0, 0.7, (60, 1)):
            start = points[np.linalg.norm(points - inside, axis=1).argmin()]
            search = np.zeros(SEARCH_SIZE)
            search[START : START + 3], search[BEST], search[TOLERANCE] = inside + centre, FAR, 0.01
            descend_from(blob, ints, tab, *(start + centre), np.bool_(True), search)
            found += search[BEST] < FAR
            farther += FAR > search[BEST] > np.linalg.norm(start - inside) + 1e-3
    assert found > 200
    assert farther < 20  # half of those from rough leaves, where steps too far are taken as they are


@pytest.mark.parametrize("one", LEAVES)
def test_second_derivatives_change_no_more_over_many_cells(one: ModelLeaf) -> None:
    rng = np.random.default_rng(6)
    seen = 0
    for blob, record, (_, face, a, b, _) in facets(one, 80, rng):
        ints, tab = integers(blob), tables(blob)
        half = min(rng.choice([0.01, 0.05, 0.12]), 1.0 - max(abs(a), abs(b)))
        kink, third = rests_over(tab, ints, record, face, a - half, a + half, b - half, b + half)
        jet = np.array(inverse_radius_bend(blob, ints, record, face, a, b))
        if not np.isfinite(third) or jet[0] == 0.0:
            continue
        kink += jump_over(blob, ints, record, face, a, b, half, jet[0])
        for u, v in rng.uniform(-half, half, (30, 2)):
            other = np.array(inverse_radius_bend(blob, ints, record, face, a + u, b + v))
            if other[0] == 0.0 or other[0] > 1.5 * jet[0]:
                continue
            rest = other - jet
            assert np.linalg.norm([[rest[3], rest[4]], [rest[4], rest[5]]], 2) <= kink + third * np.hypot(u, v) + 1e-12
            seen += 1
    assert seen > 150


@pytest.mark.parametrize("one", LEAVES)
def test_a_ball_is_called_free_only_where_it_is(one: ModelLeaf) -> None:
    """Points about the surface and about the borders of faces and the planes where half axes change sides."""
    rng = np.random.default_rng(7)
    blob = compile_tree(Tree(one, frozen(np.zeros(6)))).blob
    ints, tab = integers(blob), tables(blob)
    record = ints[ints[at.OWNER_INTS] + at.OWNER_RECORD]
    side = np.linspace(-1, 1, 150)
    a, b = (x.ravel() for x in np.meshgrid(side, side))
    points = np.concatenate([surface(blob, record, face, a, b) for face in range(6)])
    tree = cKDTree(points)
    spots = points[rng.integers(len(points), size=500)]
    spots[:100, 0] = spots[:100, 1]
    spots[100:150, 2] = 1e-3
    spots += rng.normal(size=spots.shape) * rng.choice([0.05, 0.5, 4.0], (len(spots), 1))
    local, spare, called = np.zeros(SEARCH_SIZE), np.empty((ROOM, 3)), 0
    for p, nearest in zip(spots, tree.query(spots)[0], strict=True):
        for share in (0.3, 0.8, 0.95, 1.0001, 1.05):
            free = leaf_is_free(blob, ints, tab, record, *p, share * nearest, 0.01, local, spare)
            assert not (free and share > 1.0)
            called += free
    assert called > 150


def test_the_least_of_a_quadratic_over_a_square() -> None:
    rng = np.random.default_rng(5)
    x, y = np.meshgrid(*[np.linspace(-1, 1, 201)] * 2)
    for _ in range(300):
        c, ca, cb, aa, ab, bb = rng.normal(size=6)
        half = rng.choice([1e-3, 1.0, 40.0])
        u, v = half * x, half * y
        least, a, b = least_over_square(c, ca, cb, aa, ab, bb, half)
        sampled = (c + ca * u + cb * v + aa * u * u + 2 * ab * u * v + bb * v * v).min()
        assert least <= sampled + 1e-12 * (1 + half) ** 2
        assert least == pytest.approx(
            c + ca * a + cb * b + aa * a * a + 2 * ab * a * b + bb * b * b, abs=1e-9 * (1 + half) ** 2
        )
        assert least >= sampled - 0.02 * half * (abs(ca) + abs(cb) + 4 * half * (abs(aa) + abs(ab) + abs(bb)))


def test_the_least_of_a_quadratic_over_a_polygon() -> None:
    rng = np.random.default_rng(6)
    x, y = np.meshgrid(*[np.linspace(-1, 1, 301)] * 2)
    for _ in range(200):
        c, ca, cb, aa, ab, bb = rng.normal(size=6)
        corners, spare = np.zeros((ROOM, 3)), np.empty((ROOM, 3))
        corners[:4, :2] = [[-1, -1], [1, -1], [1, 1], [-1, 1]]
        size, held = 4, np.full(x.shape, True)
        for nx, ny, place in rng.normal(size=(rng.integers(0, 4), 3)):
            size = clip_in_chart(corners, size, spare, nx, ny, place)
            held &= nx * x + ny * y <= place
            if size == 0:
                break
        assert size > 0 or not held.any()
        if size == 0 or not held.any():
            continue
        sampled = (c + ca * x + cb * y + aa * x * x + 2 * ab * x * y + bb * y * y)[held].min()
        least, a, b = least_over_polygon(c, ca, cb, aa, ab, bb, corners, size)
        assert least <= sampled + 1e-12
        assert least == pytest.approx(c + ca * a + cb * b + aa * a * a + 2 * ab * a * b + bb * b * b, abs=1e-9)
        assert least >= sampled - 0.05 * (abs(ca) + abs(cb) + 2 * (abs(aa) + abs(ab) + abs(bb)))


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_discs_hold_their_facets_at_every_level(seed: int) -> None:
    """Bounds of discs never exceed the distance to a surface point of a facet below them."""
    rng = np.random.default_rng(seed)
    blob = compile_tree(random_tree(seed, depth=2)).blob
    ints, tab = integers(blob), tables(blob)
    levels, codes = ints[at.FACET_LEVELS], ints[at.FACET_CODES]
    first, count = ints[levels + 1 + 2 * ints[levels] : levels + 3 + 2 * ints[levels]]
    blocks = tab[first : first + count * BLOCK]
    bounds = np.empty(WIDE, dtype=np.float32)
    for q in rng.integers(ints[at.FACET_COUNT], size=60):
        code = ints[codes + q]
        owner = ints[at.OWNER_INTS] + at.OWNER_INT_SIZE * (code >> 24)
        record = ints[owner + at.OWNER_RECORD]
        _, face, a, b, half = facet_cell(ints, record, code)
        s = surface(blob, record, face, a + half * rng.uniform(-1, 1, 6), b + half * rng.uniform(-1, 1, 6))
        planes = blob[ints[owner + at.OWNER_PLANE_FLOATS] :][: 4 * ints[owner + at.OWNER_PLANES]].reshape(-1, 4)
        s = s[(s @ planes[:, :3].T <= planes[:, 3]).all(axis=1)]
        frame = ints[record + at.FRAME]
        s = np.array([turn_out_of_leaf(blob, frame, *p) for p in s]).reshape(-1, 3) + blob[frame : frame + 3]
        for p in s:
            query = p + rng.normal(size=3) * rng.choice([0.01, 3.0, 60.0, 1e6])
            vector = rng.normal(size=3) * rng.choice([1.0, 100.0])
            loose = LOOSE * (2 * np.abs(query).max() + np.abs(vector).max() + 2 * np.abs(p).max() + 200.0)
            place = q
            for level in range(ints[levels]):
                block = ints[levels + 1 + 2 * level] + place // WIDE
                mask = bound_to_point(blocks, block, *query, loose, 1e30, bounds)
                true = np.linalg.norm(p - query)
                assert bounds[place % WIDE] <= true * true * (1 + 1e-6)
                assert mask >> (place % WIDE) & 1
                t = np.clip((p - query) @ vector / (vector @ vector), 0, 1)
                true = np.linalg.norm(p - query - t * vector)
                bound_to_segment(blocks, block, *query, *vector, loose, 1e30, bounds)
                assert bounds[place % WIDE] <= true * true * (1 + 1e-6)
                place //= WIDE


def test_a_point_beyond_what_single_precision_holds_has_its_distance() -> None:
    shape = Shape(Tree(LEAVES[0], frozen(np.zeros(6))))
    for far in (1e8, 1e12, 1e25):
        point = np.array([far, 0.3 * far, -0.2 * far])
        nearest, away = shape.closest_point(point)
        assert away == pytest.approx(np.linalg.norm(point), abs=200.0, rel=1e-12)
        assert np.abs(nearest).max() < 200
