"""The bounds of a block's discs against distances to the discs themselves, of points drawn at random."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit

from hhsr.kernels.disc_bounds import BLOCK, DISC_SIZE, LOOSE, WIDE, bound_to_point, bound_to_segment
from hhsr.kernels.vectors import lowest_bit


def drawn(rng: np.random.Generator, far: float) -> tuple[np.ndarray, np.ndarray, np.ndarray, float]:
    """Return blocks (3·BLOCK,) float32, a point and a vector about them, and what float32 rounds there."""
    blocks = np.empty((3, DISC_SIZE, WIDE), dtype=np.float32)
    blocks[:, :3] = rng.normal(size=(3, 3, WIDE)) * 30.0
    normals = rng.normal(size=(3, 3, WIDE))
    blocks[:, 3:6] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    blocks[:, 6] = rng.uniform(0.0, 1.0, (3, WIDE)) ** 4
    blocks[:, 7] = rng.uniform(0.0, 8.0, (3, WIDE))
    point, vector = rng.normal(size=3) * far, rng.normal(size=3) * far
    loose = LOOSE * (2.0 * np.abs(point).max() + np.abs(vector).max() + 2.0 * float(np.abs(blocks[:, :3]).max()))
    return blocks.reshape(-1), point, vector, loose


def within(rng: np.random.Generator, disc: np.ndarray, count: int) -> np.ndarray:
    """Return points (count, 3) of a disc (8,): within its radius of its centre, its thickness of its plane."""
    n = disc[3:6] / np.linalg.norm(disc[3:6])
    aside = rng.normal(size=(count, 3))
    aside -= (aside @ n)[:, None] * n
    aside *= (disc[7] * rng.choice([1.0, 0.5], count) / np.linalg.norm(aside, axis=1))[:, None]
    return disc[:3] + aside + (disc[6] * rng.choice([-1.0, 0.0, 1.0], count))[:, None] * n


@pytest.mark.parametrize("far", [1.0, 30.0, 1e4])
def test_no_point_of_a_disc_is_nearer_than_its_bound(far: float) -> None:
    rng = np.random.default_rng(int(far))
    to_point, to_segment = np.empty(WIDE, dtype=np.float32), np.empty(WIDE, dtype=np.float32)
    for turn in range(12):
        blocks, point, vector, loose = drawn(rng, far)
        block = turn % 3
        most = float(rng.uniform(0.0, 4.0 * far * far))
        mask = bound_to_point(blocks, block, *point, loose, most, to_point)
        assert [c for c in range(WIDE) if mask >> c & 1] == [c for c in range(WIDE) if to_point[c] <= most * (1 + 1e-6)]
        mask = bound_to_segment(blocks, block, *point, *vector, loose, most, to_segment)
        assert [c for c in range(WIDE) if mask >> c & 1] == [
            c for c in range(WIDE) if to_segment[c] <= most * (1 + 1e-6)
        ]
        assert (to_segment <= to_point * (1 + 1e-4) + 20 * loose * far).all()
        discs = np.float64(blocks[BLOCK * block : BLOCK * (block + 1)]).reshape(DISC_SIZE, WIDE).T
        for c in range(WIDE):
            held = within(rng, discs[c], 60)
            away = np.linalg.norm(held - point, axis=1)
            assert to_point[c] <= away.min() ** 2 * (1 + 1e-6)
            t = np.clip((held - point) @ vector / (vector @ vector), 0.0, 1.0)[:, None]
            along = np.linalg.norm(held - point - t * vector, axis=1)
            assert to_segment[c] <= along.min() ** 2 * (1 + 1e-6)
            # And it is near: the height above the disc's plane, and how far beyond its border.
            n, r = discs[c, 3:6], point - discs[c, :3]
            height = abs(float(n @ r))
            beyond = max(float(np.sqrt(max(r @ r - height * height, 0.0))) - discs[c, 7], 0.0)
            true = np.hypot(max(height - discs[c, 6], 0.0), beyond)
            assert np.sqrt(to_point[c]) >= true * (1 - 1e-5) - 1e-3 * (1 + far / 30.0)


def test_a_block_so_far_away_that_squares_overflow_is_not_ruled_out() -> None:
    blocks, point, _, _ = drawn(np.random.default_rng(0), 1.0)
    bounds = np.empty(WIDE, dtype=np.float32)
    assert bound_to_point(blocks, 0, *point, 1e-3, 1e300, bounds) == (1 << WIDE) - 1


@njit
def _lowest(number):  # type: ignore[no-untyped-def]
    return lowest_bit(number)


def test_the_lowest_bit_of_a_mask() -> None:
    for mask in [1, 2, 3, 0x8000, 0xFFFF, 0xFFFFFFFF, *np.random.default_rng(0).integers(1, 2**32, 50)]:
        expected = next(k for k in range(64) if int(mask) >> k & 1)
        assert _lowest(np.int64(mask)) == lowest_bit(int(mask)) == expected
