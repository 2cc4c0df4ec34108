"""One budget over all leaves: the gains of their centres merged into one order (DESIGN §3)."""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from hhsr.model import FloatArray, subset_numbers


def counts_within(
    gains: list[FloatArray], dictionary_size: int, budget: int, held: Sequence[int] | None = None
) -> list[int]:
    """Return how many centres each leaf gets so that weights and packed index sets cost at most `budget` numbers.

    gains: per leaf, (k,) what each further centre of its own order brings. The leaf whose next centre brings the most
    is served first; a leaf's gains are taken as falling (a later larger one is smoothed over those before it).
    held: per leaf, how many of its first centres it has in any case.
    """
    counts = list(held) if held is not None else [0] * len(gains)
    falling = [np.concatenate([np.zeros(k), _falling(g[k:])]) for g, k in zip(gains, counts, strict=True)]
    costs = [k + subset_numbers(dictionary_size, k) for k in counts]
    spent = sum(costs)
    heap = [(-float(f[k]), leaf) for leaf, (f, k) in enumerate(zip(falling, counts, strict=True)) if f.size > k]
    heapq.heapify(heap)
    while heap:
        _, leaf = heapq.heappop(heap)
        cost = counts[leaf] + 1 + subset_numbers(dictionary_size, counts[leaf] + 1)
        if spent - costs[leaf] + cost > budget:
            continue
        spent += cost - costs[leaf]
        costs[leaf] = cost
        counts[leaf] += 1
        if counts[leaf] < falling[leaf].size:
            heapq.heappush(heap, (-float(falling[leaf][counts[leaf]]), leaf))
    return counts


def _falling(gains: FloatArray) -> FloatArray:
    """Return the slopes of the upper hull of the summed gains: falling, and of the same total."""
    if gains.size == 0:
        return gains
    total = np.concatenate([[0.0], np.cumsum(gains)])
    hull = [0]
    for k in range(1, total.size):
        while len(hull) > 1 and (total[k] - total[hull[-1]]) * (hull[-1] - hull[-2]) >= (
            total[hull[-1]] - total[hull[-2]]
        ) * (k - hull[-1]):
            hull.pop()
        hull.append(k)
    slopes = [(total[b] - total[a]) / (b - a) for a, b in pairwise(hull)]
    return np.repeat(slopes, np.diff(hull))
