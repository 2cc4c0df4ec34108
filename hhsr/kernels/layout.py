"""Where everything lies in a compiled shape: one float64 blob, so that a call hands over a single array.

The blob's first slots are 64-bit integers (the header and the integer records), then float64 numbers, then float32
tables. `integers` and `tables` are views of it; all offsets in the records count slots of the view they point into.
"""

import numpy as np
from numba import njit

# Header, in integer slots.
MAP_START = 0  # float64 slot where the float32 tables begin
NODE_COUNT, NODE_INTS, NODE_FLOATS = 1, 2, 3
OWNER_COUNT, OWNER_INTS = 4, 5
EDGE_COUNT, EDGE_FLOATS = 6, 7
PLANE_COUNT, PLANE_FLOATS = 8, 9
POSE = 10  # float slot: rotation (9) and translation (3), tree frame to LPS
LOWEST, HIGHEST = 11, 12  # float slots of the box of the solid, tree frame
HEADER_SIZE = 16

# Nodes: 4 integers (kind, left, right, owner), 8 floats (normal 3, offset, half width).
CUT, MODEL, RETAINED, SLAB = 0, 1, 2, 3
NODE_INT_SIZE, NODE_FLOAT_SIZE = 4, 8

# Owners (leaves and slabs): the convex regions that part space, each bounded by planes n·p ≤ c.
OWNER_INT_SIZE = 6
OWNER_KIND, OWNER_RECORD, OWNER_PLANES, OWNER_PLANE_FLOATS, OWNER_NODE, OWNER_BOX = 0, 1, 2, 3, 4, 5

# Model leaf record, integers: where its numbers (float slots), lists (integer slots) and tables (float32 slots) lie.
HALF_AXES, AZIMUTH, AZIMUTH_COUNT, ELEVATION, ELEVATION_COUNT = 0, 1, 2, 3, 4
CENTRES, CENTRE_COUNT = 5, 6  # rows of 5: unit vector, 1/(1 − cos σ), weight
BLOCKS = 7  # 6·8·8 + 1 integer offsets, into the centres that are not 0 everywhere in a block of directions
FRAME, ROTATED = 8, 9  # float slots: centre 3, rotation 9 (leaf to tree)
CELLS, CELL_TABLE, RANGE_TABLE, SPHERE_TABLE = 10, 11, 12, 13
BOX = 14  # float slots: box of the leaf in its own frame 6, least and greatest |p|∞ of its surface
LEAF_INT_SIZE = 16
CENTRE_SIZE = 5
BLOCKS_PER_SIDE = 8
BLOCK_COUNT = 6 * BLOCKS_PER_SIDE * BLOCKS_PER_SIDE

# A cell of the finest level: |W − (value + slope_a·δa + slope_b·δb)| ≤ error, |∂W/∂a − slope_a| ≤ spread_a, same for b;
# its surface lies within `radius` (mm) of dir(a, b)/value.
CELL_SIZE = 8
VALUE, SLOPE_A, SLOPE_B, ERROR, SPREAD_A, SPREAD_B, RADIUS = 0, 1, 2, 3, 4, 5, 6


@njit(cache=True, error_model="numpy")
def integers(blob):
    """Return the blob as 64-bit integers."""
    return blob.view(np.int64)


@njit(cache=True, error_model="numpy")
def tables(blob):
    """Return the float32 tables."""
    return blob[blob.view(np.int64)[MAP_START] :].view(np.float32)
