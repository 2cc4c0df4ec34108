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
# Facets (hhsr.kernels.facets): how many, integer slot of their codes, integer slot of (levels; of each the
# number of its first block and of its discs; float32 slot and number of all blocks).
FACET_COUNT, FACET_CODES, FACET_LEVELS = 13, 14, 15
# Voxels (hhsr.kernels.voxels): integer slot of the grid's record, float slot of (lowest corner 3, side, 1/side); 0
# where there are none.
VOXELS, VOXEL_FRAME = 16, 17
# Seeds (hhsr.kernels.seeds): integer slot of (nx, ny, nz), float slot of (lowest corner 3, 1/side, widest coordinate),
# slot of the int32 numbers of facets.
SEED_CELLS, SEED_FRAME, SEEDS = 18, 19, 20
HEADER_SIZE = 21

# Nodes: 4 integers (kind, left, right, owner), 8 floats (normal 3, offset, half width).
CUT, MODEL, RETAINED, SLAB = 0, 1, 2, 3
NODE_INT_SIZE, NODE_FLOAT_SIZE = 4, 8

# Owners (leaves and slabs): the convex regions that part space, each bounded by planes n·p ≤ c.
OWNER_INT_SIZE = 6
OWNER_KIND, OWNER_RECORD, OWNER_PLANES, OWNER_PLANE_FLOATS, OWNER_NODE, OWNER_BOX = 0, 1, 2, 3, 4, 5

# Model leaf record, integers: where its numbers (float slots), lists (integer slots) and tables (float32 slots) lie.
HALF_AXES, AZIMUTH, AZIMUTH_COUNT, ELEVATION, ELEVATION_COUNT = 0, 1, 2, 3, 4
# The centres that are not 0 everywhere in a block of directions, copied for each block: float slot of all blocks' data,
# and integer slots of 6·8·8 + 1 offsets into it. A block holds 5 rows, each as long as it has centres, padded with
# zeros to a multiple of LANES: unit vector x, y, z; 1/(1 − cos σ); weight.
BLOCK_DATA, BLOCKS = 5, 7
CELL_BITS = 6  # log₂ of the base cells a face side
FRAME, ROTATED = 8, 9  # float slots: centre 3, rotation 9 (leaf to tree)
# Cube map: base cells a face side; integer slot of one word a base cell, `first cell · 16 + 8 · surface + k` where it
# is parted into 2^k × 2^k cells, and has surface in the leaf's region or not; float32 slots of the cells and of the
# pyramid of ranges.
CELLS, PARTING, CELL_TABLE, RANGE_TABLE = 10, 11, 12, 13
BEND_TABLE, BEND_SIZE = 15, 2  # float32 slot of the bend of each base cell, lowest and highest
BOX = 14  # float slots: box of the leaf in its own frame 6, least and greatest |p|∞ of its surface
LEAF_INT_SIZE = 16
BLOCK_ROWS = 5
LANES = 8
BLOCKS_PER_SIDE = 8

# A cell: |W − (value + slope_a·δa + slope_b·δb)| ≤ error; ∂²W at the centre, from which it differs by no more than
# kink + third·r at r from it. Where no ∂²W is known bend_aa is NaN, bend_ab and bend_bb are the spreads: how far the
# slopes stray. (Else these follow: `hhsr.kernels.maps.spreads_of`.)
CELL_SIZE = 9
VALUE, SLOPE_A, SLOPE_B, ERROR, KINK, THIRD, BEND_AA, BEND_AB, BEND_BB = 0, 1, 2, 3, 4, 5, 6, 7, 8
FINEST_PARTING = 4  # a facet's code has eight bits for the cell


@njit(cache=True, error_model="numpy")
def integers(blob):
    """Return the blob as 64-bit integers."""
    return blob.view(np.int64)


@njit(cache=True, error_model="numpy")
def tables(blob):
    """Return the float32 tables."""
    return blob[blob.view(np.int64)[MAP_START] :].view(np.float32)
