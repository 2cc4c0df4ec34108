"""How well all pieces of a solid could be told as radii, for many places of one of its planes (DESIGN §3)."""

import numpy as np
from numba import njit

from hhsr.kernels.lookahead import CELLS, SUMS, misfit_of_cells, term_of


@njit(cache=True, nogil=True)
def _leaf_of(x, y, z, normals, offsets, children, moved, nx, ny, nz, offset):
    """Return the leaf that holds a point, plane number `moved` being (nx, ny, nz, offset) instead of its own.

    children: (k, 2) cuts, or −1 − leaf, below and above each plane; a layout without cuts is leaf 0.
    """
    at = 0 if children.shape[0] > 0 else -1
    while at >= 0:
        if at == moved:
            above = x * nx + y * ny + z * nz >= offset
        else:
            above = x * normals[at, 0] + y * normals[at, 1] + z * normals[at, 2] >= offsets[at]
        at = children[at, 1 if above else 0]
    return -1 - at


@njit(cache=True, nogil=True)
def leaves_of(points, normals, offsets, children):
    """Return (n,) the leaf that holds each of (n, 3) points."""
    out = np.empty(points.shape[0], np.int64)
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        out[i] = _leaf_of(x, y, z, normals, offsets, children, -1, 0.0, 0.0, 0.0, 0.0)
    return out


@njit(cache=True, nogil=True)
def misfits_of_places(points, slopes, gaps, centres, normals, offsets, children, moved, tried, heights, least, power):
    """Return (c,) the misfit of all leaves with plane number `moved` in each of c places.

    points, slopes: (m, 3) samples and their unit normals. gaps: (leaves, m) what a sample costs that a leaf's centre
    does not see, 0 where it sees it. centres: (leaves, 3). normals, offsets, children: the planes as they are.
    tried, heights: (c, 3), (c,) the places. least: samples that each leaf has to keep. A place that leaves a leaf
    with fewer, or its centre outside its region, costs inf.
    """
    leaves = centres.shape[0]
    out = np.empty(tried.shape[0])
    sums, count, term = np.empty((leaves, CELLS, SUMS)), np.empty(leaves, np.int64), np.empty(SUMS)
    for c in range(tried.shape[0]):
        nx, ny, nz, offset = tried[c, 0], tried[c, 1], tried[c, 2], heights[c]
        out[c] = np.inf
        stays = True
        for k in range(leaves):
            x, y, z = centres[k, 0], centres[k, 1], centres[k, 2]
            if _leaf_of(x, y, z, normals, offsets, children, moved, nx, ny, nz, offset) != k:
                stays = False
        if not stays:
            continue
        sums[:] = 0.0
        count[:] = 0
        total = 0.0
        for i in range(points.shape[0]):
            x, y, z = points[i, 0], points[i, 1], points[i, 2]
            k = _leaf_of(x, y, z, normals, offsets, children, moved, nx, ny, nz, offset)
            count[k] += 1
            if gaps[k, i] > 0.0:
                total += gaps[k, i]
            else:
                cell = term_of(x - centres[k, 0], y - centres[k, 1], z - centres[k, 2], slopes, i, term)
                for t in range(SUMS):
                    sums[k, cell, t] += term[t]
        if count.min() < least:
            continue
        for k in range(leaves):
            total += misfit_of_cells(sums[k], power)
        out[c] = total
    return out
