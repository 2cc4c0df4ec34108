"""Where to begin a search: a coarse grid whose cells name a facet near them, most often the nearest one.

Nothing is proven by it: a good beginning only makes a search short.
"""

import numpy as np

from hhsr.kernels.layout import SEED_CELLS, SEED_FRAME, SEEDS
from hhsr.kernels.unmanaged import entry, inlined, unmanaged


@entry
def fill_seeds(centres, low, side, out):
    """Fill (nx, ny, nz) int32 with the index of a facet (its centre: (m, 3)) near each cell's centre.

    Each cell that holds a facet's centre keeps the one nearest to its own; the others hear of theirs from neighbours,
    in two passes.
    """
    nx, ny, nz = out.shape
    out[:, :, :] = -1
    for q in range(centres.shape[0]):
        i = min(max(int((centres[q, 0] - low[0]) / side), 0), nx - 1)
        j = min(max(int((centres[q, 1] - low[1]) / side), 0), ny - 1)
        k = min(max(int((centres[q, 2] - low[2]) / side), 0), nz - 1)
        if out[i, j, k] < 0 or _away2(centres, q, low, side, i, j, k) < _away2(
            centres, np.int64(out[i, j, k]), low, side, i, j, k
        ):
            out[i, j, k] = q
    for way in range(2):
        for s in range(nx):
            i = s if way == 0 else nx - 1 - s
            for t in range(ny):
                j = t if way == 0 else ny - 1 - t
                for u in range(nz):
                    k = u if way == 0 else nz - 1 - u
                    best = np.int64(out[i, j, k])
                    least = _away2(centres, best, low, side, i, j, k) if best >= 0 else np.inf
                    for c in range(13):  # the neighbours that this pass has already seen
                        di, dj, dk = c // 9 - 1, c // 3 % 3 - 1, c % 3 - 1
                        if way == 1:
                            di, dj, dk = -di, -dj, -dk
                        a, b, d = i + di, j + dj, k + dk
                        if 0 <= a < nx and 0 <= b < ny and 0 <= d < nz and out[a, b, d] >= 0:
                            q = np.int64(out[a, b, d])
                            if q == best:
                                continue
                            away2 = _away2(centres, q, low, side, i, j, k)
                            if away2 < least:
                                best, least = q, away2
                    out[i, j, k] = best


@unmanaged
def _away2(centres, q, low, side, i, j, k):
    """Return the squared distance of a facet's centre to that of a cell."""
    x, y, z = low[0] + side * (i + 0.5), low[1] + side * (j + 0.5), low[2] + side * (k + 0.5)
    return (centres[q, 0] - x) ** 2 + (centres[q, 1] - y) ** 2 + (centres[q, 2] - z) ** 2


@inlined
def seed_at(blob, ints, x, y, z):
    """Return the facet named by the cell that holds a point of the tree's frame, or by the cell nearest to it."""
    c, f = ints[SEED_CELLS], ints[SEED_FRAME]
    nx, ny, nz = ints[c], ints[c + 1], ints[c + 2]
    inverse = blob[f + 3]
    i = int(min(max((x - blob[f]) * inverse, 0.0), nx - 1.0))
    j = int(min(max((y - blob[f + 1]) * inverse, 0.0), ny - 1.0))
    k = int(min(max((z - blob[f + 2]) * inverse, 0.0), nz - 1.0))
    return np.int64(blob.view(np.int32)[2 * ints[SEEDS] + (i * ny + j) * nz + k])
