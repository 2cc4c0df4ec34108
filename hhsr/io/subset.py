"""A set of k centres out of M as one integer below C(M, k): the combinatorial number system."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]


def subset_bytes(total: int, chosen: int) -> int:
    """Return how many bytes tell which `chosen` of `total` are meant: ⌈log₂ C(total, chosen)⌉ bits, rounded up."""
    return -(-(math.comb(total, chosen) - 1).bit_length() // 8)


def rank_of_subset(index: IntArray, total: int) -> int:
    """Return Σ C(index_i, i + 1) of (k,) ascending indices below `total`: their rank among all k-subsets."""
    members = set(index.tolist())
    rank = 0

    def take(candidate: int, binomial: int) -> bool:
        nonlocal rank
        if candidate not in members:
            return False
        rank += binomial
        return True

    _descend(total, index.size, take)
    return rank


def subset_of_rank(rank: int, total: int, chosen: int) -> IntArray:
    """Return the (chosen,) ascending indices whose rank this is; 0 ≤ rank < C(total, chosen)."""
    rest = rank
    found: list[int] = []

    def take(candidate: int, binomial: int) -> bool:
        nonlocal rest
        if binomial > rest:
            return False
        rest -= binomial
        found.append(candidate)
        return True

    _descend(total, chosen, take)
    return np.array(found[::-1], dtype=np.int64)


def _descend(total: int, chosen: int, take: Callable[[int, int], bool]) -> None:
    """Offer total − 1, total − 2, … with C(candidate, members still to take) until `chosen` are taken.

    The binomial is carried along, exactly: computing each anew would cost a thousand times as much.
    """
    candidate, missing = total - 1, chosen
    binomial = math.comb(candidate, missing) if missing else 0
    while missing:
        if take(candidate, binomial):
            binomial = binomial * missing // candidate if candidate else 0
            missing -= 1
        else:
            binomial = binomial * (candidate - missing) // candidate
        candidate -= 1
