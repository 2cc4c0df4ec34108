"""Candidate cutting planes, and the one with the most utility (PAPER §3.2, Eq. 8 and 9; DESIGN §1 for its slips)."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from hhsr.fitting.mutex import MutexPairs
from hhsr.model import FloatArray

LEAST_SHARE = 0.01


class Plane(NamedTuple):
    """normal: (3,) unit. offset: mm; the signed height of p is n·p − offset, ≥ 0 on the right."""

    normal: FloatArray
    offset: float

    def heights(self, points: FloatArray) -> FloatArray:
        """Return the signed heights (...) of (..., 3) points, mm."""
        return np.asarray(points @ self.normal - self.offset)


def candidate_planes(pairs: MutexPairs) -> tuple[FloatArray, FloatArray]:
    """Return normals (k, 3) and offsets (k,) of the planes that bisect each pair (Eq. 8).

    A plane and its opposite are the same cut: the normal's last component that is not 0 is made positive.
    """
    difference = pairs.points[:, 0] - pairs.points[:, 1]
    normals = difference / np.sqrt((difference**2).sum(axis=1))[:, None]
    sign = np.where(normals[:, 2] != 0, normals[:, 2], np.where(normals[:, 1] != 0, normals[:, 1], normals[:, 0]))
    normals = np.where(sign[:, None] < 0, -normals, normals)
    middle = pairs.points.mean(axis=1)
    return normals, np.einsum("ki,ki->k", normals, middle)


def utilities(pairs: MutexPairs, normals: FloatArray, offsets: FloatArray) -> tuple[FloatArray, NDArray[np.int64]]:
    """Return the utility U of Eq. 9 and the number of pairs cut, (k,) each, for every candidate plane.

    The factor (1 − min/max) is 1 where both sides are free of pairs; a pair counts |n·(X − Y)| / |X − Y|, as it has no
    direction.
    """
    first = pairs.points[:, 0] @ normals.T >= offsets
    second = pairs.points[:, 1] @ normals.T >= offsets
    cut = first != second
    on_right, on_left = (first & second).sum(axis=0), (~first & ~second).sum(axis=0)
    more, less = np.maximum(on_left, on_right), np.minimum(on_left, on_right)
    balance = 1.0 - np.divide(less, more, out=np.zeros(less.size), where=more > 0)
    difference = pairs.points[:, 0] - pairs.points[:, 1]
    unit = difference / np.sqrt((difference**2).sum(axis=1))[:, None]
    gain = np.einsum("jk,jk,j->k", np.abs(unit @ normals.T), cut.astype(np.float64), pairs.weights)
    return balance * gain, cut.sum(axis=0)


def ranked_planes(pairs: MutexPairs, points: FloatArray, most: int = 1) -> list[Plane]:
    """Return up to `most` planes, best utility first; ties by pairs cut, then by balance of area, then by index.

    Parameters
    ----------
    pairs : mutex pairs of the part.
    points : (n, 3) points spread over the part's surface by area.

    Empty where no plane cuts a pair and leaves surface on both sides (≥ 1 % of the points).
    """
    if pairs.weights.size == 0 or points.shape[0] == 0:
        return []
    normals, offsets = candidate_planes(pairs)
    utility, cut = utilities(pairs, normals, offsets)
    share = np.empty(offsets.size)
    for k in range(0, offsets.size, 256):
        share[k : k + 256] = (points @ normals[k : k + 256].T >= offsets[k : k + 256]).mean(axis=0)
    smaller = np.minimum(share, 1.0 - share)
    taken = (cut > 0) & (smaller >= LEAST_SHARE)
    # To twelve digits, so that rounding does not decide a tie.
    rounded = np.round(utility / max(float(utility.max()), 1e-300), 12)
    order = np.lexsort((np.arange(offsets.size), -smaller, -cut, -rounded, ~taken))
    return [Plane(normals[k], float(offsets[k])) for k in order[: min(most, int(taken.sum()))]]
