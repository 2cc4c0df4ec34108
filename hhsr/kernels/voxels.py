"""A grid of cubes about the solid, each proven inside, proven outside, or left to the formulas.

A voxel's byte is 0 where nothing is proven, else ± (its Chebyshev distance, in voxels, to the nearest such one):
positive inside.
So a segment leaps over what is decided, and most points need one byte.
"""

import numpy as np
from numba import njit

from hhsr.kernels.box_state import IN, MIXED, box_state
from hhsr.kernels.layout import VOXEL_BYTES, VOXEL_FRAME, VOXELS, integers, tables
from hhsr.kernels.tree import contains_point
from hhsr.kernels.triangle_build import STACK

BLOCK = 16  # voxels a side of the first cubes that are tried
NODES = 256


@njit(cache=True, nogil=True, error_model="numpy")
def fill_voxels(blob, low, side, counts, out):
    """Fill (nx, ny, nz) int8 of the cubes of a grid: 1 inside, −1 outside, 0 not proven."""
    ints, tab = integers(blob), tables(blob)
    nodes, stack = np.empty(NODES, dtype=np.int64), np.empty(STACK, dtype=np.int64)
    q, e = np.empty(3), np.empty(3)
    todo = np.empty((128, 4), dtype=np.int64)
    for bi in range(0, counts[0], BLOCK):
        for bj in range(0, counts[1], BLOCK):
            for bk in range(0, counts[2], BLOCK):
                todo[0, 0], todo[0, 1], todo[0, 2], todo[0, 3] = bi, bj, bk, BLOCK
                depth = 1
                while depth > 0:
                    depth -= 1
                    i, j, k, size = todo[depth, 0], todo[depth, 1], todo[depth, 2], todo[depth, 3]
                    if i >= counts[0] or j >= counts[1] or k >= counts[2]:
                        continue
                    half = 0.5 * side * size
                    x, y, z = low[0] + side * i + half, low[1] + side * j + half, low[2] + side * k + half
                    state = box_state(blob, ints, tab, x, y, z, half, nodes, stack, q, e)
                    if state == MIXED and size > 1:
                        size //= 2
                        for c in range(8):
                            todo[depth, 0], todo[depth, 1] = i + size * (c & 1), j + size * ((c >> 1) & 1)
                            todo[depth, 2], todo[depth, 3] = k + size * (c >> 2), size
                            depth += 1
                        continue
                    value = 0 if state == MIXED else (1 if state == IN else -1)
                    for a in range(i, min(i + size, counts[0])):
                        for b in range(j, min(j + size, counts[1])):
                            for c in range(k, min(k + size, counts[2])):
                                out[a, b, c] = value


@njit(cache=True, nogil=True, error_model="numpy")
def fill_leaps(voxels):
    """Turn the signs of (nx, ny, nz) voxels into signed Chebyshev distances to the nearest 0, in place; at most 127."""
    nx, ny, nz = voxels.shape
    for way in range(2):
        for s in range(nx):
            i = s if way == 0 else nx - 1 - s
            for t in range(ny):
                j = t if way == 0 else ny - 1 - t
                for u in range(nz):
                    k = u if way == 0 else nz - 1 - u
                    here = np.int64(voxels[i, j, k])
                    if here == 0:
                        continue
                    best = 127 if way == 0 else abs(here)
                    # The thirteen neighbours that this pass has already seen.
                    for c in range(13):
                        di, dj, dk = c // 9 - 1, c // 3 % 3 - 1, c % 3 - 1
                        if way == 1:
                            di, dj, dk = -di, -dj, -dk
                        a, b, d = i + di, j + dj, k + dk
                        if 0 <= a < nx and 0 <= b < ny and 0 <= d < nz:
                            best = min(best, abs(np.int64(voxels[a, b, d])) + 1)
                    voxels[i, j, k] = best if here > 0 else -best


@njit(cache=True, error_model="numpy")
def voxel_at(blob, ints, x, y, z):
    """Return the byte of the voxel that holds a point of the tree's frame; −1 outside the grid, 0 without a grid."""
    c = ints[VOXELS]
    if c == 0:
        return 0
    f = ints[VOXEL_FRAME]
    u, v, w = (x - blob[f]) * blob[f + 4], (y - blob[f + 1]) * blob[f + 4], (z - blob[f + 2]) * blob[f + 4]
    if not (0.0 <= u < ints[c] and 0.0 <= v < ints[c + 1] and 0.0 <= w < ints[c + 2]):
        return -1
    place = (int(u) * ints[c + 1] + int(v)) * ints[c + 2] + int(w)
    return np.int64(blob.view(np.int8)[8 * ints[VOXEL_BYTES] + place])


@njit(cache=True, error_model="numpy")
def leap(blob, ints, px, py, pz, dx, dy, dz, t):
    """Return (state, end): 1 inside, −1 outside, 0 not proven, of p + t·d and all that follows it up to `end`.

    Beyond the grid the state is −1 until the segment may enter it; `end` is infinite where nothing follows.
    """
    c, f = ints[VOXELS], ints[VOXEL_FRAME]
    side = blob[f + 3]
    x, y, z = px + t * dx, py + t * dy, pz + t * dz
    byte = voxel_at(blob, ints, x, y, z)
    ring = max(abs(byte) - 1, 0)
    end = np.inf
    for k in range(3):
        if k == 0:
            p, d, at = px, dx, x
        elif k == 1:
            p, d, at = py, dy, y
        else:
            p, d, at = pz, dz, z
        u = (at - blob[f + k]) * blob[f + 4]
        low, high = blob[f + k] + side * (int(u) - ring), blob[f + k] + side * (int(u) + 1 + ring)
        if u < 0.0 or u >= ints[c + k]:
            # Beyond the grid on this axis: outside until it comes in, or for good.
            if u < 0.0 and d > 0.0:
                return -1, (blob[f + k] - p) / d
            if u >= 0.0 and d < 0.0:
                return -1, (blob[f + k] + side * ints[c + k] - p) / d
            return -1, np.inf
        if d > 0.0:
            end = min(end, (high - p) / d)
        elif d < 0.0:
            end = min(end, (low - p) / d)
    return (1 if byte > 0 else (-1 if byte < 0 else 0)), end


@njit(cache=True, error_model="numpy")
def solid_contains(blob, ints, tab, root, x, y, z):
    """Return whether the solid of node `root` holds a point of the tree's frame: by its voxel, else by the formulas."""
    byte = voxel_at(blob, ints, x, y, z) if root == 0 else 0
    if byte != 0:
        return byte > 0
    return contains_point(blob, ints, tab, root, x, y, z)
