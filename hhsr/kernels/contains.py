"""Inside or outside, for LPS points: a voxel's byte or plane, else the owner's map, else the exact formula."""

import math

import numpy as np
from numba import njit

from hhsr.kernels.layout import VOXELS, integers, tables
from hhsr.kernels.tree import contains_point, into_tree
from hhsr.kernels.unmanaged import entry
from hhsr.kernels.voxels import voxel_state

INSIDE, OUTSIDE, INVALID = 1, 0, -1


@njit(cache=True, error_model="numpy")
def contains_one(blob, x, y, z):
    """Return 1 inside, 0 outside, −1 not finite, for an LPS point."""
    ints, tab = integers(blob), tables(blob)
    if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
        return INVALID
    x, y, z = into_tree(blob, ints, x, y, z)
    state = voxel_state(blob, ints, tab, blob.view(np.int16), blob.view(np.int32), x, y, z) if ints[VOXELS] != 0 else 0
    if state == 0:
        return INSIDE if contains_point(blob, ints, tab, 0, x, y, z) else OUTSIDE
    return INSIDE if state > 0 else OUTSIDE


@entry
def contains_many(blob, points, out):
    """Fill (n,) int8 with 1 inside, 0 outside, −1 not finite; return how many are not finite."""
    ints, tab = integers(blob), tables(blob)
    shorts, words = blob.view(np.int16), blob.view(np.int32)
    grid = ints[VOXELS] != 0
    bad = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if not math.isfinite(x + y + z):
            if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
                out[i] = INVALID
                bad += 1
                continue
        x, y, z = into_tree(blob, ints, x, y, z)
        state = voxel_state(blob, ints, tab, shorts, words, x, y, z) if grid else 0
        if state == 0:
            out[i] = INSIDE if contains_point(blob, ints, tab, 0, x, y, z) else OUTSIDE
        else:
            out[i] = INSIDE if state > 0 else OUTSIDE
    return bad
