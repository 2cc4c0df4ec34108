"""The solid of a whole tree at a point: descend to the region that owns it, ask its owner (DESIGN §2)."""

import math

import numpy as np

from hhsr.kernels.cell import face_of, leaf_implicit
from hhsr.kernels.layout import (
    CUT,
    ERROR,
    FRAME,
    MODEL,
    NODE_FLOAT_SIZE,
    NODE_FLOATS,
    NODE_INT_SIZE,
    NODE_INTS,
    OWNER_INT_SIZE,
    OWNER_INTS,
    OWNER_KIND,
    OWNER_RECORD,
    POSE,
    RETAINED,
    ROTATED,
    SLOPE_A,
    SLOPE_B,
    VALUE,
    integers,
)
from hhsr.kernels.maps import cell_at
from hhsr.kernels.part import part_contains, part_field
from hhsr.kernels.slab import slab_contains, slab_field
from hhsr.kernels.unmanaged import entry, unmanaged


@unmanaged
def into_tree(blob, ints, x, y, z):
    """Return an LPS point in the tree's frame."""
    o = ints[POSE]
    dx, dy, dz = x - blob[o + 9], y - blob[o + 10], z - blob[o + 11]
    return (
        blob[o] * dx + blob[o + 3] * dy + blob[o + 6] * dz,
        blob[o + 1] * dx + blob[o + 4] * dy + blob[o + 7] * dz,
        blob[o + 2] * dx + blob[o + 5] * dy + blob[o + 8] * dz,
    )


@unmanaged
def out_of_tree(blob, ints, x, y, z):
    """Return a point of the tree's frame in LPS."""
    o = ints[POSE]
    return (
        blob[o] * x + blob[o + 1] * y + blob[o + 2] * z + blob[o + 9],
        blob[o + 3] * x + blob[o + 4] * y + blob[o + 5] * z + blob[o + 10],
        blob[o + 6] * x + blob[o + 7] * y + blob[o + 8] * z + blob[o + 11],
    )


@unmanaged
def into_leaf(blob, ints, leaf, x, y, z):
    """Return a point of the tree's frame in the leaf's frame."""
    o = ints[leaf + FRAME]
    x, y, z = x - blob[o], y - blob[o + 1], z - blob[o + 2]
    if ints[leaf + ROTATED] == 0:
        return x, y, z
    return turn_into_leaf(blob, o, x, y, z)


@unmanaged
def turn_into_leaf(blob, frame, x, y, z):
    """Return a vector of the tree's frame in the frame whose numbers start at `frame`."""
    return (
        blob[frame + 3] * x + blob[frame + 6] * y + blob[frame + 9] * z,
        blob[frame + 4] * x + blob[frame + 7] * y + blob[frame + 10] * z,
        blob[frame + 5] * x + blob[frame + 8] * y + blob[frame + 11] * z,
    )


@unmanaged
def turn_out_of_leaf(blob, frame, x, y, z):
    """Return a vector of a leaf's frame in the tree's frame."""
    return (
        blob[frame + 3] * x + blob[frame + 4] * y + blob[frame + 5] * z,
        blob[frame + 6] * x + blob[frame + 7] * y + blob[frame + 8] * z,
        blob[frame + 9] * x + blob[frame + 10] * y + blob[frame + 11] * z,
    )


@unmanaged
def owner_of(blob, ints, root, x, y, z):
    """Return the index of the owner, below node `root`, of the region that holds a point of the tree's frame."""
    node = root
    while True:
        i = ints[NODE_INTS] + NODE_INT_SIZE * node
        if ints[i] != CUT:
            return ints[i + 3]
        f = ints[NODE_FLOATS] + NODE_FLOAT_SIZE * node
        h = blob[f] * x + blob[f + 1] * y + blob[f + 2] * z - blob[f + 3]
        if abs(h) < blob[f + 4]:
            return ints[i + 3]
        node = ints[i + 2] if h >= 0.0 else ints[i + 1]


@unmanaged
def leaf_contains(blob, ints, tab, leaf, x, y, z):
    """Return whether a model leaf holds a point of its frame: by its map, where undecided by the exact formula."""
    if x == 0.0 and y == 0.0 and z == 0.0:
        return True
    face, a, b, m = face_of(x, y, z)
    o, ca, cb, _ = cell_at(ints, leaf, face, a, b)
    gap = 1.0 / m - (tab[o + VALUE] + tab[o + SLOPE_A] * (a - ca) + tab[o + SLOPE_B] * (b - cb))
    if gap > tab[o + ERROR]:
        return True
    if gap < -tab[o + ERROR]:
        return False
    return leaf_implicit(blob, ints, leaf, x, y, z) <= 0.0


@unmanaged
def owner_contains(blob, ints, tab, owner, x, y, z):
    """Return whether an owner's solid holds a point of the tree's frame, by the owner's own formula."""
    o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner
    kind, record = ints[o + OWNER_KIND], ints[o + OWNER_RECORD]
    if kind == MODEL:
        x, y, z = into_leaf(blob, ints, record, x, y, z)
        return leaf_contains(blob, ints, tab, record, x, y, z)
    if kind == RETAINED:
        return part_contains(blob, ints, record, x, y, z)
    return slab_contains(blob, ints, record, x, y, z)


@unmanaged
def contains_point(blob, ints, tab, root, x, y, z):
    """Return whether the solid of node `root` holds a point of the tree's frame; on the surface is inside."""
    return owner_contains(blob, ints, tab, owner_of(blob, ints, root, x, y, z), x, y, z)


@unmanaged
def field_point(blob, ints, x, y, z):
    """Return the implicit value at a point of the tree's frame: G of a leaf, gap/r in a slab, distance/extent."""
    o = ints[OWNER_INTS] + OWNER_INT_SIZE * owner_of(blob, ints, 0, x, y, z)
    kind, record = ints[o + OWNER_KIND], ints[o + OWNER_RECORD]
    if kind == MODEL:
        x, y, z = into_leaf(blob, ints, record, x, y, z)
        return leaf_implicit(blob, ints, record, x, y, z)
    if kind == RETAINED:
        return part_field(blob, ints, record, x, y, z)
    return slab_field(blob, ints, record, x, y, z)


@entry
def field_many(blob, points, out):
    """Fill (n,) implicit values of LPS points; NaN where not finite; return how many are not."""
    ints = integers(blob)
    bad = 0
    for i in range(points.shape[0]):
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        if not (math.isfinite(x) and math.isfinite(y) and math.isfinite(z)):
            out[i] = np.nan
            bad += 1
            continue
        x, y, z = into_tree(blob, ints, x, y, z)
        out[i] = field_point(blob, ints, x, y, z)
    return bad
